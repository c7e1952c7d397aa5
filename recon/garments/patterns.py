"""Parametric sewing patterns: draw sizes, cut the panels, sew them into a garment around the body.

>>> parameters = sample("tshirt", seed, measures)
>>> pattern = cut("tshirt", parameters)
>>> garment = weld(pattern, measures)       # a "pillow" around the body, ready to be simulated

Border labels: ``border_labels[i]`` names the border edge that STARTS at point i when the panel's border is walked
counter-clockwise in the panel's plane (:func:`border_loops` does the walk). So every border edge has exactly one
label, and the end of a seam is the next edge's first point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from recon.garments import patterns_shapes as shapes
from recon.garments import patterns_sizes as sizes
from recon.garments.patterns_body import Measures
from recon.garments.patterns_mesh import Edge, area, triangulate
from recon.garments.patterns_place import BodyRelief, place
from recon.types import TWO_PANELS, Garment, Mesh, behind

EDGE_LENGTH = 0.0135
"""Wanted edge length of the triangles [m]."""
QUANTUM = 5e-5
"""Panel points are whole multiples of this, as the data set stores them [m]."""
MAX_VERTICES = 3500
"""Large garments get longer edges, so that about this many vertices suffice."""

KIND_OF_VARIANT = {
    "tank": "top", "tshirt": "top", "shirt": "top", "jacket": "top", "skirt": "skirt", "trousers": "trousers",
    "shorts": "trousers", "dress": "dress", "tshirt6": "shirt6", "shirt6": "shirt6",
}  # fmt: skip
SEAM_NAMES = {
    "top": ("open", "side_left", "side_right", "shoulder_left", "shoulder_right", "sleeve_under_left",
            "sleeve_under_right"),
    "dress": ("open", "side_left", "side_right", "shoulder_left", "shoulder_right", "sleeve_under_left",
              "sleeve_under_right"),
    "skirt": ("open", "side_left", "side_right"),
    "trousers": ("open", "side_left", "side_right", "inseam_left", "inseam_right"),
    "shirt6": ("open", "side_left", "side_right", "shoulder_left", "shoulder_right", "sleeve_under_left",
               "sleeve_under_right", "sleeve_over_left", "sleeve_over_right", "armhole_front_left",
               "armhole_front_right", "armhole_back_left", "armhole_back_right"),
}  # fmt: skip
PANEL_NAMES = {"shirt6": ("front", "back", "sleeve_front_left", "sleeve_back_left", "sleeve_front_right",
                          "sleeve_back_right")}  # fmt: skip
"""Panels of the kinds that have more than two (ISP appendix C, Fig. 28)."""
_CUTS = {
    "top": shapes.bodice,
    "dress": shapes.bodice,
    "skirt": shapes.skirt,
    "trousers": shapes.trousers,
    "shirt6": shapes.set_in,
}
_SIZES: dict[str, Callable[[np.random.Generator, Measures], sizes.Parameters]] = {
    **{name: partial(sizes.top, name) for name in ("tank", "tshirt", "shirt", "jacket")},
    "dress": sizes.dress,
    "skirt": sizes.skirt,
    **{name: partial(sizes.trousers, name) for name in ("trousers", "shorts")},
    "tshirt6": partial(sizes.set_in, "tshirt"),
    "shirt6": partial(sizes.set_in, "shirt"),
}
"""By variant: what draws its sizes from a generator and measures."""


@dataclass(frozen=True)
class Pattern:
    """Flat panels, meshed, with labelled borders; all share one plane."""

    variant: str
    """Key of ``KIND_OF_VARIANT``."""
    parameters: dict[str, float]
    """The named sizes it was cut from [m]."""
    points: NDArray
    """(P, 2) panel points [m]; x to the wearer's left, y up, aligned with the T-posed body."""
    faces: NDArray
    """(F, 3) counter-clockwise seen from OUTSIDE the garment: clockwise in the plane on the back panel."""
    panel_of_face: NDArray
    """(F,) index into ``panel_names``."""
    panel_of_point: NDArray
    """(P,) the same."""
    labels: NDArray
    """(P,) -1 inside, else the label of the border edge that starts here (counter-clockwise in the plane)."""
    seams: NDArray
    """(S, 2) points of two panels that are sewn together, the earlier panel's first."""
    held: NDArray
    """(H,) points of a waistband that the body holds up."""

    @property
    def kind(self) -> str:
        """Key of ``recon.garments.KINDS``."""
        return KIND_OF_VARIANT[self.variant]

    @property
    def seam_names(self) -> tuple[str, ...]:
        """Names of the labels."""
        return SEAM_NAMES[self.kind]

    @property
    def panel_names(self) -> tuple[str, ...]:
        """Names of the panels."""
        return PANEL_NAMES.get(self.kind, TWO_PANELS)

    @property
    def side_of_point(self) -> NDArray:
        """(P,) 0 before the body, 1 behind it."""
        return np.array([int(behind(name)) for name in self.panel_names])[self.panel_of_point]


def sample(variant: str, rng: np.random.Generator | int, measures: Measures) -> dict[str, float]:
    """Sizes of a random garment of this variant for this body: plain named floats, to be changed and cut again."""
    rng = np.random.default_rng(rng) if isinstance(rng, int) else rng
    drawn = _SIZES[variant](rng, measures)
    return {name: float(value) for name, value in drawn.items()}


def cut(variant: str, parameters: dict[str, float], edge_length: float | None = None) -> Pattern:
    """Cut and mesh the panels.

    ``edge_length`` [m]: by default ``EDGE_LENGTH``, or more where the garment would pass ``MAX_VERTICES``.
    Raises ``ValueError`` where the sizes give no clean panel.
    """
    kind = KIND_OF_VARIANT[variant]
    outline = _CUTS[kind](parameters)
    if edge_length is None:
        total = sum(area(_loop(piece)) for pieces in outline.values() for piece in pieces)
        edge_length = max(EDGE_LENGTH, float(np.sqrt(total / (0.866 * MAX_VERTICES))))
    names = SEAM_NAMES[kind]
    parts, faces, panel_f, panel_p, labels, held = [], [], [], [], [], []
    runs: dict[str, list[NDArray]] = {}
    offset = 0
    for panel, title in enumerate(PANEL_NAMES.get(kind, TWO_PANELS)):
        for piece in outline[title]:
            mesh = triangulate(piece, edge_length)
            label = np.full(len(mesh.points), -1, np.int64)
            for edge, run in zip(piece, mesh.edges):
                label[run[:-1]] = names.index(edge.label)
                if edge.label != "open":
                    runs.setdefault(edge.label, []).append(run + offset)
                if edge.held:
                    held.append(run + offset)
            parts.append(mesh.points)
            faces.append((mesh.faces[:, [0, 2, 1]] if behind(title) else mesh.faces) + offset)
            panel_f.append(np.full(len(mesh.faces), panel))
            panel_p.append(np.full(len(mesh.points), panel))
            labels.append(label)
            offset += len(mesh.points)
    points = np.round(np.concatenate(parts) / QUANTUM) * QUANTUM
    seams = np.unique(np.concatenate([_sewn(points, *both) for both in runs.values()]), axis=0)
    return Pattern(
        variant, dict(parameters), points, np.concatenate(faces), np.concatenate(panel_f), np.concatenate(panel_p),
        np.concatenate(labels), seams, np.unique(np.concatenate(held)) if held else np.zeros(0, np.int64),
    )  # fmt: skip


def _sewn(points: NDArray, one: NDArray, other: NDArray) -> NDArray:
    """(S, 2) the points of two runs that lie on each other; the other may run the opposite way.

    ``ValueError``: they differ.
    """
    if len(one) == len(other):
        for run in (other, other[::-1]):
            if np.abs(points[one] - points[run]).max() < 1.5 * QUANTUM:
                points[run] = points[one]  # resampled from its other end, a point may be rounded to the next quantum
                return np.stack([one, run], 1)
    raise ValueError("the two sides of a seam differ")


def _loop(piece: list[Edge]) -> NDArray:
    return np.concatenate([e.line[:-1] for e in piece])


def weld(pattern: Pattern, measures: Measures, relief: BodyRelief | None = None) -> Garment:
    """Sew the panels (one vertex per seam point) and blow them up around the body, front before it, back behind it."""
    vertex_of_point = welded(len(pattern.points), pattern.seams)
    placed = place(pattern, measures, relief or BodyRelief.of(measures))
    count = np.bincount(vertex_of_point)
    vertices = np.stack([np.bincount(vertex_of_point, placed[:, k]) for k in range(3)], 1) / count[:, None]
    return Garment(
        kind=pattern.kind,
        mesh=Mesh(torch.tensor(vertices, dtype=torch.float32), torch.tensor(vertex_of_point[pattern.faces])),
        panel_points=torch.tensor(pattern.points, dtype=torch.float32),
        panel_faces=torch.tensor(pattern.faces),
        panel_of_face=torch.tensor(pattern.panel_of_face),
        vertex_of_point=torch.tensor(vertex_of_point),
        border_labels=torch.tensor(pattern.labels),
        seam_names=pattern.seam_names,
        variant=pattern.variant,
        panel_names=pattern.panel_names,
    )


def welded(count: int, seams: NDArray) -> NDArray:
    """(count,) vertex of each panel point after the pairs ``seams`` (S, 2) were made one; vertices in points' order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(seams)), (seams[:, 0], seams[:, 1])), shape=(count, count))
    _, group = connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[group]


def border_loops(garment: Garment) -> list[tuple[int, NDArray, NDArray]]:
    """The panels' borders as ``(panel, points, labels)``: closed loops of points, counter-clockwise in the plane.

    ``labels[i]`` belongs to the edge from ``points[i]`` to ``points[i + 1]`` (cyclic).
    """
    faces, panel = garment.panel_faces.cpu().numpy(), garment.panel_of_face.cpu().numpy()
    labels = garment.border_labels.cpu().numpy()
    loops = []
    for side, title in enumerate(garment.panel_names):
        f = faces[panel == side][:, ::-1] if behind(title) else faces[panel == side]
        edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
        known = {(a, b) for a, b in edges.tolist()}
        following = {a: b for a, b in known if (b, a) not in known}
        while following:
            start = min(following)
            loop = [start]
            while (nxt := following.pop(loop[-1])) != start:
                loop.append(nxt)
            points = np.array(loop)
            loops.append((side, points, labels[points]))
    return loops
