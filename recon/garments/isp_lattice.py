"""Fine grids ask the surface map at every other point and interpolate what lies between, by cubics.

Only where all points of a stencil lie in the panel: outside of it the surface map was never taught anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

CELLS = 128
"""Cells of the lattice along the domain's side: up to this resolution nothing is interpolated. Cloth of our data has no
folds that its cubics would miss: 0.01 mm on average at a resolution of 256."""


@dataclass(frozen=True)
class Lattice:
    """Points of a fine grid that follow from those that the network was asked about."""

    rows: Tensor
    """(N,) rows of the lattice's nodes among the points asked about."""
    nodes: Tensor
    """(N,) their place on the lattice, row by row."""
    between: Tensor
    """(J,) places of the interpolated points on the fine grid, row by row."""
    weights: Tensor
    """(R + 1, CELLS + 1) cubics along one axis: the fine grid from the lattice."""

    def interpolate(self, values: Tensor) -> Tensor:
        """Values (M, C) of the points asked about -> (J, C), differentiable in the values."""
        if not len(self.between):
            return values[:0]
        size, channels = CELLS + 1, values.shape[1]
        grid = values.new_zeros(size * size, channels).index_copy(0, self.nodes, values[self.rows])
        weights = self.weights.to(values.dtype)
        down = (weights @ grid.view(size, -1)).view(-1, size, channels)
        return (weights @ down).view(-1, channels)[self.between]


def lattice(points: NDArray, used: NDArray[np.uint8], resolution: int) -> tuple[NDArray[np.bool_], Lattice]:
    """Which of the distinct inner points (N, 2) to ask the network about, (N,) bool, and how the others follow.

    Args:
        points: domain coordinates; most lie on the grid of ``resolution``.
        used: bits of the panels that each belongs to.
        resolution: the grid's cells along the domain's side; 0: ask about all points.

    Rows of the lattice's nodes are indices of ``points``; points between come in their order.
    """
    step = resolution // CELLS
    if step < 2 or resolution % CELLS:
        none = torch.zeros(0, dtype=torch.long)
        return np.ones(len(points), bool), Lattice(none, none, none, torch.zeros(0, CELLS + 1))
    place = (points + 1) * (resolution / 2)
    near = np.round(place).astype(np.int64)
    off = np.abs(place - near) > 1e-3
    on_grid = ~(off[:, 0] | off[:, 1])
    beside = near % step
    node = on_grid & (beside[:, 0] == 0) & (beside[:, 1] == 0)
    at = near // step
    panels = np.zeros((CELLS + 1, CELLS + 1), np.uint8)
    panels[at[node, 0], at[node, 1]] = used[node]
    between = on_grid & ~node
    between[between] = (used[between] & ~_whole(panels)[at[between, 0], at[between, 1]]) == 0
    size = resolution + 1
    nodes, fine = at[node] @ [CELLS + 1, 1], near[between] @ [size, 1]
    weights = torch.as_tensor(cubic_weights(resolution))
    rows = torch.as_tensor(np.nonzero(node)[0])
    return ~between, Lattice(rows, torch.as_tensor(nodes), torch.as_tensor(fine), weights)


def _whole(panels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits of the panels to which all 16 nodes around each lattice cell belong; cells beyond the frame have none."""
    for axis in (0, 1):
        before, beyond = np.roll(panels, 1, axis), np.roll(panels, -1, axis)
        panels = before & panels & beyond & np.roll(panels, -2, axis)
    panels[[0, -2, -1]] = panels[:, [0, -2, -1]] = 0
    return panels


def cubic_weights(resolution: int) -> NDArray[np.float32]:
    """(R + 1, CELLS + 1) Lagrange weights of the four lattice points around each grid point, the middle two nearest.

    Towards the frame, where two points are missing on one side, the last four serve.
    """
    place = np.arange(resolution + 1) * (CELLS / resolution)
    first = (place.astype(np.int64) - 1).clip(0, CELLS - 3)
    t = place - first - 1
    before, after, beyond = t + 1, t - 1, t - 2
    four = [-t * after * beyond / 6, before * after * beyond / 2, -before * t * beyond / 2, before * t * after / 6]
    weights = np.zeros((resolution + 1, CELLS + 1), np.float32)
    for k, share in enumerate(four):
        weights[np.arange(resolution + 1), first + k] = share
    return weights
