"""Smooth functions of points in space: asked at the corners of the lattice cells around the points, and read between.

Where a mesh is finer than the function, many points share a cell, and what a network would say of each follows from
eight corners: one sparse product (trilinear interpolation). Only cells that hold points have corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

LARGEST = 30_000_000
"""Lattices of more cells than this, for points of a scene and not of a garment, are not laid out."""


@dataclass(frozen=True)
class Nodes:
    """Corners of a lattice around points, and how the points lie between them."""

    at: Tensor
    """(M, 3) the corners [m]."""
    rows: Tensor
    """(N, 8) the corners of each point's cell."""
    shares: Tensor
    """(N, 8) what each counts; sums to 1."""

    @classmethod
    def around(cls, points: Tensor, width: float, most: float = 0.8) -> Nodes | None:
        """The corners around points (N, 3), ``width`` apart [m]; None where they are more than ``most`` N."""
        x = points.detach().cpu().numpy().astype(np.float32)
        if not len(x) or not np.isfinite(x).all():
            return None
        low = np.floor(x.min(0) / width)
        place = x / np.float32(width) - low.astype(np.float32)
        cell = place.astype(np.int64)
        counts = cell.max(0) + 2
        if counts.prod() > LARGEST:
            return None
        strides = np.array([counts[1] * counts[2], counts[2], 1])
        corners = np.stack(np.meshgrid((0, 1), (0, 1), (0, 1), indexing="ij"), -1).reshape(8, 3)
        first = cell @ strides
        used = np.zeros(counts.prod(), bool)
        used[first] = True
        alone = np.flatnonzero(used)  # many points share a cell: its corners are marked once
        for step in corners @ strides:
            used[alone + step] = True
        found = np.flatnonzero(used)
        if len(found) > most * len(x):
            return None
        row = np.empty(len(used), np.int32)
        row[found] = np.arange(len(found), dtype=np.int32)
        part = (place - cell).astype(np.float32)
        shares = np.empty((len(x), 8), np.float32)
        for k, corner in enumerate(corners):
            a, b, c = (part[:, i] if corner[i] else 1 - part[:, i] for i in range(3))
            shares[:, k] = a * b * c
        at = (np.stack(np.unravel_index(found, counts), 1) + low) * width
        rows = row[first[:, None] + corners @ strides]
        return cls(torch.as_tensor(at).to(points), torch.as_tensor(rows), torch.as_tensor(shares).to(points))

    @cached_property
    def _matrix(self) -> sp.csr_matrix:
        starts = np.arange(0, self.rows.numel() + 1, 8, dtype=np.int32)
        entries = self.shares.cpu().numpy().ravel(), self.rows.numpy().ravel(), starts
        return sp.csr_matrix(entries, shape=(len(self.rows), len(self.at)))

    def __call__(self, values: Tensor) -> Tensor:
        """Values (M, C) at the corners -> (N, C) at the points, differentiable in the values."""
        if not values.is_cuda and not (torch.is_grad_enabled() and values.requires_grad):
            return torch.from_numpy(self._matrix @ values.detach().numpy())
        rows = self.rows.to(values.device).long()
        return (values[rows] * self.shares.to(values)[..., None]).sum(1)
