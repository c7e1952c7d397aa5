"""Functions over the plane of a garment's panels, front and back: what ISP's draping networks read and write.

Panels of one kind of garment share a plane (``Garment.panel_points``), so a map over it, one for the front panel and
one for the back, says something at every point of any garment of the kind, whatever its mesh (ISP §3.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.types import Garment

COARSE = 150.0
"""Eigenvalue [1/m²] of waves half a metre long: as smooth as cloth on a body mostly is."""
SPACING = 0.01
"""Distance of the nodes of a displacement map [m]."""
FLAT_SCALE = 5.0
"""Factor that brings the distance between panel and body [m] to about one."""


@dataclass(frozen=True)
class Box:
    """The part of the panels' plane that maps cover."""

    low: tuple[float, float]
    """x and y of its lower corner, panel coordinates [m]."""
    high: tuple[float, float]
    """x and y of its upper corner [m]."""

    @classmethod
    def around(cls, points: Tensor, margin: float = 0.05) -> Box:
        """The box of panel points (P, 2), symmetric in x, ``margin`` [m] wider on each side."""
        half = float(points[:, 0].abs().max()) + margin
        y = points[:, 1]
        return cls((-half, float(y.min()) - margin), (half, float(y.max()) + margin))

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def unit(self, points: Tensor) -> Tensor:
        """Panel points (..., 2) [m] -> the unit square; points outside go to its border."""
        low, size = points.new_tensor(self.low), points.new_tensor(self.size)
        return ((points - low) / size).clamp(0, 1)


def modes(box: Box, count: int) -> Tensor:
    """(M, 2) half waves along x and y of the ``count`` smoothest cosines over a box, smoothest first."""
    width, height = box.size
    most = 2 * math.ceil(math.sqrt(count * max(width / height, height / width)))
    i, j = (k.flatten() for k in torch.meshgrid(torch.arange(most), torch.arange(most), indexing="ij"))
    order = torch.argsort((i / width) ** 2 + (j / height) ** 2, stable=True)[:count]
    return torch.stack([i[order], j[order]], 1)


def levels(box: Box, which: Tensor) -> Tensor:
    """(M,) heights of the cosines ``which`` (M, 2): fine ones are scaled down.

    Stretching costs a wave its eigenvalue: divided by the root of it, all coefficients are about as stiff, and learning
    is not held up by the finest.
    """
    frequency = math.pi * which / torch.tensor(box.size)
    return torch.where(which > 0, 2**0.5, 1.0).prod(1) / (1 + frequency.square().sum(1) / COARSE).sqrt()


def map_size(box: Box) -> tuple[int, int]:
    """Nodes along x and y of a map over a box."""
    width, height = (math.ceil(n / SPACING) + 1 for n in box.size)
    return width, height


def compose(box: Box, which: Tensor, coefficients: Tensor) -> Tensor:
    """Coefficients (..., M) of the cosines ``which`` (M, 2), at their levels -> maps (..., nx, ny) over a box."""
    return Cosines(box, which)(coefficients)


class Cosines:
    """Sums of the cosines ``which`` (M, 2) over a box: what does not depend on their coefficients, made once."""

    def __init__(self, box: Box, which: Tensor):
        which = which.cpu()
        self.counts = [int(k) + 1 for k in which.amax(0)]
        self.at = which[:, 0] * self.counts[1] + which[:, 1]
        self.levels = levels(box, which)
        self.waves = [
            torch.cos(math.pi * torch.linspace(0, 1, nodes)[:, None] * torch.arange(count))
            for nodes, count in zip(map_size(box), self.counts, strict=True)
        ]

    def __call__(self, coefficients: Tensor) -> Tensor:
        """Coefficients (..., M) -> maps (..., nx, ny)."""
        whole = coefficients.new_zeros(*coefficients.shape[:-1], self.counts[0] * self.counts[1])
        at, high = self.at.to(coefficients.device), self.levels.to(coefficients)
        whole = whole.index_copy(-1, at, coefficients * high).unflatten(-1, self.counts)
        return self.waves[0].to(coefficients) @ whole @ self.waves[1].to(coefficients).T


def around(box: Box, cells: tuple[int, int], points: Tensor, panel: Tensor) -> tuple[Tensor, Tensor]:
    """The four nodes around panel points (P, 2): rows (P, 4) of (2, nx, ny) maps flattened, and their shares (P, 4)."""
    nx, ny = cells
    at = box.unit(points) * points.new_tensor([nx - 1, ny - 1])
    base = torch.minimum(at.detach().floor(), points.new_tensor([nx - 2, ny - 2])).clamp_min(0)
    part = at - base
    first = (panel * nx + base[:, 0].long()) * ny + base[:, 1].long()
    rows = first[:, None] + torch.tensor([0, 1, ny, ny + 1], device=points.device)
    x, y = part[:, :1], part[:, 1:]
    return rows, torch.cat([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y], 1)


@dataclass(frozen=True)
class Welding:
    """How points of the panels make vertices: a vertex at a seam is the mean of its points."""

    vertex_of_point: Tensor
    """(P,)."""
    share: Tensor
    """(V, 1) one over the number of points of each vertex."""

    @classmethod
    def of(cls, garment: Garment) -> Welding:
        """From a garment's panels."""
        count = torch.bincount(garment.vertex_of_point, minlength=garment.mesh.vertices.shape[-2])
        return cls(garment.vertex_of_point, 1 / count.clamp_min(1).to(garment.mesh.vertices)[:, None])

    def __call__(self, values: Tensor) -> Tensor:
        """(..., P, C) at panel points -> (..., V, C) at vertices."""
        out = values.new_zeros(*values.shape[:-2], len(self.share), values.shape[-1])
        return out.index_add(-2, self.vertex_of_point, values) * self.share.to(values)


def point_areas(garment: Garment) -> Tensor:
    """(P,) a third of the flat triangles around each panel point [m²]."""
    a, b, c = garment.panel_points[garment.panel_faces].unbind(1)
    u, v = b - a, c - a
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs() / 6
    return area.new_zeros(len(garment.panel_points)).index_add(
        0, garment.panel_faces.flatten(), area.repeat_interleave(3)
    )


def splat(box: Box, cells: tuple[int, int], points: Tensor, panel: Tensor, values: Tensor) -> Tensor:
    """Sums of values (P, C) at panel points, spread over the nearest nodes: (2, nx, ny, C), differentiable in all."""
    rows, shares = around(box, cells, points, panel)
    out = values.new_zeros(2 * cells[0] * cells[1], values.shape[1])
    for k in range(4):
        out = out.index_add(0, rows[:, k], shares[:, k, None] * values)
    return out.view(2, *cells, -1)


def rest_features(garment: Garment, box: Box, cells: tuple[int, int]) -> Tensor:
    """(2 nx ny 4,) where the panels are and how far the cloth at rest is from their plane; hardly depends on the mesh.

    What ISP's code says about a garment, read off the garment itself: a draping network that knows it needs no code,
    and keeps its meaning when a decoder is trained anew.
    """
    points, area = garment.panel_points, point_areas(garment)
    away = garment.mesh.vertices[garment.vertex_of_point]
    away = FLAT_SCALE * torch.cat([away[:, :2] - points, away[:, 2:]], 1)
    node = box.size[0] * box.size[1] / ((cells[0] - 1) * (cells[1] - 1))
    values = torch.cat([torch.ones_like(away[:, :1]), away], 1) * (area / node)[:, None]
    return splat(box, cells, points, garment.side_of_point, values).flatten()
