"""Fine grids ask the surface map at every other point and interpolate what lies between, by cubics.

Only where all points of a stencil lie in the panel: outside of it the surface map was never taught anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

CELLS = 128
"""Cells of the lattice along the domain's side: up to this resolution nothing is interpolated. Cloth of our data has no
folds that its cubics would miss: 0.01 mm on average at a resolution of 256."""


@dataclass(frozen=True)
class Stencils:
    """Weighted sums that give the points between from those that the network was asked about."""

    nodes: Tensor
    """(J, 16) rows."""
    weights: Tensor
    """(J, 16)."""

    def interpolate(self, values: Tensor) -> Tensor:
        """Values (N, C) of the points asked about -> (J, C), differentiable in the values."""
        if not len(self.nodes):
            return values[:0]
        return F.embedding_bag(self.nodes, values, per_sample_weights=self.weights, mode="sum")


def lattice_stencils(points: NDArray, used: NDArray[np.uint8], resolution: int) -> tuple[NDArray, Stencils]:
    """Which of the distinct inner points (N, 2) to ask the network about, (N,) bool, and how the others follow.

    Args:
        points: domain coordinates; most lie on the grid of ``resolution``.
        used: bits of the panels that each belongs to.
        resolution: the grid's cells along the domain's side; 0: ask about all points.

    Nodes of the stencils are indices of ``points``.
    """
    step = resolution // CELLS
    none = Stencils(torch.zeros(0, 16, dtype=torch.long), torch.zeros(0, 16))
    if step < 2 or resolution % CELLS:
        return np.ones(len(points), bool), none
    place = (points + 1) * (resolution / 2)
    near = np.round(place).astype(np.int64)
    off = np.abs(place - near) > 1e-3
    on_grid = ~(off[:, 0] | off[:, 1])
    size = resolution + 1 + 4 * step
    near = near + 2 * step  # stencils may reach over the domain's frame
    at = np.full((size, size), -1)
    at[tuple(near[on_grid].T)] = np.nonzero(on_grid)[0]
    panels = np.zeros((size, size), np.uint8)
    panels[tuple(near[on_grid].T)] = used[on_grid]
    beside = near % step
    between = np.nonzero(on_grid & ((beside[:, 0] | beside[:, 1]) > 0))[0]
    corner = near[between] // step * step
    between, corner = between[whole := _whole(panels, corner, used[between], step)], corner[whole]
    reach = step * np.arange(-1, 3)
    nodes = at[(corner[:, 0, None] + reach)[:, :, None], (corner[:, 1, None] + reach)[:, None]].reshape(-1, 16)
    asked = np.ones(len(points), bool)
    asked[between] = False
    share = cubic_weights((near[between] % step) / step)
    weights = (share[:, 0, :, None] * share[:, 1, None]).reshape(-1, 16)
    return asked, Stencils(torch.as_tensor(nodes), torch.as_tensor(weights))


def _whole(panels: NDArray, corner: NDArray, used: NDArray, step: int) -> NDArray[np.bool_]:
    """Whether all 16 nodes around each lattice cell ``corner`` (J, 2) belong to the panels ``used`` (J,)."""
    common = panels[::step, ::step]
    for axis in (0, 1):
        before, beyond = np.roll(common, 1, axis), np.roll(common, -1, axis)
        common = before & common & beyond & np.roll(common, -2, axis)
    return (used & ~common[corner[:, 0] // step, corner[:, 1] // step]) == 0


def cubic_weights(t: NDArray) -> NDArray:
    """(..., 4) Lagrange weights of four equally spaced points for a place t in [0, 1] between the middle two."""
    before, after, beyond = t + 1, t - 1, t - 2
    return np.stack(
        [-t * after * beyond / 6, before * after * beyond / 2, -before * t * beyond / 2, before * t * after / 6], -1
    )
