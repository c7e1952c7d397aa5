"""A made garment to develop and test against: two trapezoid panels sewn at the sides into an elliptic tube."""

from __future__ import annotations

import math

import torch

from recon.types import Garment, Mesh

SEAMS = ("open", "side_l", "side_r")


def tube(
    bottom: float = 0.30, top: float = 0.24, height: float = 0.5, opening: float = 0.0, cells: int = 24
) -> Garment:
    """A tube of half widths ``bottom`` and ``top`` [m]; an ``opening`` [m] cuts the front open, as a jacket's."""
    points, spots, faces, sides, labels = [], [], [], [], []

    def patch(left: float, right: float, panel: int) -> None:
        start = len(points)
        for j in range(cells + 1):
            v = j / cells
            half = bottom + (top - bottom) * v
            for i in range(cells + 1):
                x = (left + (right - left) * i / cells) * half
                angle = x / half * math.pi / 2
                radius = 2 * half / math.pi
                y = v * height - height / 2
                points.append((x, y + 0.1))
                spots.append((radius * math.sin(angle), y + 0.1, (1 - 2 * panel) * 0.8 * radius * math.cos(angle)))
                at_side = (i == cells and right == 1) - (i == 0 and left == -1)
                rim = i in (0, cells) or j in (0, cells)
                labels.append(1 if at_side > 0 else 2 if at_side < 0 else 0 if rim else -1)
        for j in range(cells):
            for i in range(cells):
                a = start + j * (cells + 1) + i
                b, c, d = a + 1, a + cells + 2, a + cells + 1
                for tri in ((a, b, c), (a, c, d)):
                    faces.append(tri if panel == 0 else (tri[0], tri[2], tri[1]))
                    sides.append(panel)

    gap = opening / (bottom + top)
    for span in [(-1, -gap), (gap, 1)] if opening else [(-1, 1)]:
        patch(*span, 0)
    patch(-1, 1, 1)
    key: dict[tuple[float, ...], int] = {}
    vertex = []
    for k, (spot, label) in enumerate(zip(spots, labels, strict=True)):
        name = (round(spot[0], 6), round(spot[1], 6)) if label > 0 else (float(k), -9.0, 0.0)
        vertex.append(key.setdefault(name, len(key)))
    vertex_of_point = torch.tensor(vertex)
    vertices = torch.zeros(len(key), 3)
    vertices[vertex_of_point] = torch.tensor(spots)
    panel_faces = torch.tensor(faces)
    return Garment(
        kind="skirt",
        mesh=Mesh(vertices, vertex_of_point[panel_faces]),
        panel_points=torch.tensor(points),
        panel_faces=panel_faces,
        panel_of_face=torch.tensor(sides),
        vertex_of_point=vertex_of_point,
        border_labels=torch.tensor(labels),
        seam_names=SEAMS,
        variant="jacket" if opening else "skirt",
    )


def family(count: int, seed: int = 0) -> list[Garment]:
    """Tubes of random measures, every third one open in front."""
    g = torch.Generator().manual_seed(seed)
    r = torch.rand(count, 3, generator=g).tolist()
    return [tube(0.26 + 0.1 * a, 0.2 + 0.05 * b, 0.35 + 0.3 * c, 0.05 * (k % 3 == 2)) for k, (a, b, c) in enumerate(r)]
