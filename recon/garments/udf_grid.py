"""Where an unsigned distance field may be close to zero: a coarse-to-fine grid (DrapeNet §3.1 with MeshUDF's cells).

Only cells that a surface may cross are ever looked at, and only corners of those get a gradient: at 256 cells a side
that is about one point in a hundred of the cube.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Field = Callable[[Tensor], Tensor]
"""Points (N, 3) [m] -> unsigned distances (N,) [m], differentiable in the points.

A field may also have a method ``slope(points)`` -> distances (N,) and gradients (N, 3), where it has them for less than
automatic differentiation; both are detached.
"""

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
"""(8, 3) corners of a cell; the first four run round its bottom, the others above them."""
HALF_DIAGONAL = 3**0.5 / 2
COARSEST = 24
"""Fewest cells along the longest side with which the search begins."""


@dataclass(frozen=True)
class Box:
    """The part of space in which a surface is looked for."""

    low: tuple[float, float, float]
    """[m]."""
    high: tuple[float, float, float]
    """[m]."""

    @staticmethod
    def around(points: Tensor, margin: float = 0.03) -> Box:
        """The bounding box of points (N, 3), ``margin`` [m] wider on all sides."""
        low, high = points.detach().amin(0) - margin, points.detach().amax(0) + margin
        return Box((float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2])))


@dataclass(frozen=True)
class Band:
    """The corners of all cells that a surface may cross."""

    at: NDArray[np.int64]
    """(N, 3) corners in whole cells from ``low``."""
    low: NDArray[np.float64]
    """(3,) [m]."""
    cell: float
    """Side of a cell [m]."""
    distance: NDArray[np.float64]
    """(N,) [m]."""
    slope: NDArray[np.float64]
    """(N, 3) unit gradients; zero where the field has none."""
    corners: NDArray[np.int64]
    """(C, 8) the cells, as rows of ``at`` in the order of ``CORNERS``."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) [m]."""
        return self.low + self.at * self.cell


def slope(field: Field, points: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) and gradients (N, 3) of a field at points (N, 3), detached."""
    known = getattr(field, "slope", None)
    if known is not None:
        return known(points)
    with torch.enable_grad():
        x = points.detach().requires_grad_()
        distance = field(x)
        (gradient,) = torch.autograd.grad(distance.sum(), x)
    return distance.detach(), gradient


def find_band(
    field: Field, box: Box, resolution: int, steepness: float = 1.1, floor: float = 0.0, slopes: bool = True
) -> Band:
    """All cells of a grid of ``resolution`` cells along the box's longest side that a surface may cross.

    Args:
        field: see :data:`Field`.
        box: what is searched.
        resolution: cells along the longest side; cells are cubes.
        steepness: bound on the length of the field's gradient; more than 1 for learned fields.
        floor: distance that the field may still show on the surface [m]; 0 for exact fields.
        slopes: ask for gradients, too; else they are zero.
    """
    low, extent = np.array(box.low), np.array(box.high) - np.array(box.low)
    cell = float(extent.max()) / resolution
    halvings = max(0, int(np.log2(max(resolution, COARSEST) / COARSEST)))
    shape = np.ceil(extent / (cell * 2**halvings) - 1e-9).astype(np.int64)
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1).reshape(-1, 3)
    with torch.no_grad():
        for level in range(halvings, 0, -1):
            side = cell * 2**level
            near = _values(field, low + (cells + 0.5) * side) < steepness * HALF_DIAGONAL * side + floor
            cells = (2 * cells[near, None] + CORNERS).reshape(-1, 3)
        at, corners = _nodes(cells, shape * 2**halvings)
        distance = _values(field, low + at * cell)
        reach = steepness * HALF_DIAGONAL * cell + floor
        by_cell = distance[corners]
        keep = (by_cell.min(1) < reach) & (by_cell.max(1) < 2 * reach)
        used, corners = np.unique(corners[keep], return_inverse=True)
        at, corners = at[used], corners.reshape(-1, 8)
    if not slopes:
        return Band(at, low, cell, distance[used], np.zeros((len(at), 3)), corners)
    _, gradient = slope(field, torch.as_tensor(low + at * cell, dtype=torch.float32))
    steep = gradient.double().numpy()
    steep = steep / np.maximum(np.linalg.norm(steep, axis=1, keepdims=True), 1e-9)
    return Band(at, low, cell, distance[used], steep, corners)


def _values(field: Field, points: NDArray) -> NDArray[np.float64]:
    return field(torch.as_tensor(points, dtype=torch.float32)).double().numpy()


def _nodes(cells: NDArray, shape: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct corners (N, 3) of cells (C, 3) in a grid of ``shape`` cells, and the cells as rows of them (C, 8)."""
    stride = np.array([(shape[1] + 1) * (shape[2] + 1), shape[2] + 1, 1])
    key = (cells @ stride)[:, None] + CORNERS @ stride
    row = np.full(int(np.prod(shape + 1)), -1, np.int32)
    row[key.ravel()] = 0
    flat = np.flatnonzero(row == 0)
    row[flat] = np.arange(len(flat), dtype=np.int32)
    at = np.stack(np.unravel_index(flat, shape + 1), 1)
    return at.astype(np.int64), row[key].astype(np.int64)
