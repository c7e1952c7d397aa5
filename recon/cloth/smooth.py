"""Smoothed coordinates for descending on free vertices: one stiff step moves a neighbourhood, not a spike.

Descending on ``u = (I + k L) x`` instead of ``x`` (L the mesh's combinatorial Laplacian) preconditions the gradient
(Nicolet et al. 2021, "Large Steps in Inverse Rendering of Geometry", Eq. 7-9).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import splu
from torch import Tensor


class SmoothCoordinates:
    """The linear change of variables u <-> x of one mesh, factorised once."""

    def __init__(self, faces: Tensor, n_vertices: int, stiffness: float = 10.0):
        """Args: faces (F, 3); number of vertices; k of ``I + k L`` (larger moves wider neighbourhoods)."""
        f = faces.cpu().numpy()
        rows, cols = _edges(f)
        ones = np.ones(len(rows))
        adjacency = sp.coo_matrix((ones, (rows, cols)), shape=(n_vertices, n_vertices)).tocsr()
        adjacency.data[:] = 1.0
        laplacian = sp.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
        self._matrix = (sp.identity(n_vertices) + stiffness * laplacian).tocsc()
        self._factor = splu(self._matrix)

    def encode(self, x: Tensor) -> Tensor:
        """(V, D) positions -> (V, D) smoothed coordinates."""
        u = self._matrix @ x.detach().cpu().double().numpy()
        return torch.from_numpy(u).to(x)

    def decode(self, u: Tensor) -> Tensor:
        """(V, D) smoothed coordinates -> positions; differentiable."""
        return _Solve.apply(u, self._factor)


def _edges(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both directions of every face's edges."""
    a, b = f.ravel(), np.roll(f, -1, axis=1).ravel()
    return np.concatenate([a, b]), np.concatenate([b, a])


class _Solve(torch.autograd.Function):
    """x = M^-1 u for a symmetric M: the backward pass is the same solve."""

    @staticmethod
    def forward(ctx, u: Tensor, factor) -> Tensor:
        ctx.factor = factor
        return torch.from_numpy(factor.solve(u.detach().cpu().double().numpy())).to(u)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        return torch.from_numpy(ctx.factor.solve(gradient.cpu().double().numpy())).to(gradient), None
