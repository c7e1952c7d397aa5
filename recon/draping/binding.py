"""How a garment at rest follows the body: skinning weights and shape directions per vertex, taken from the body.

A *feature* row is the body's knowledge at one of its vertices: 24 skinning weights and 3 S shape directions. Every
method blends feature rows of body vertices for points in the neutral body's T-pose space.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
from scipy.spatial import cKDTree
from torch import Tensor

WIDTH = 0.5
"""k of GAPS Eq. 5."""
NEAREST = 0.01
"""Points nearer to the body than this count as this far away [m]: on the skin Eq. 5's kernel would have no width."""
JOINTS = 24
"""The first features are the skinning weights of so many joints."""
NEIGHBOURS = 8
"""k of the k-nearest method."""
SMOOTHING = 60
"""Rounds of the Laplacian-smoothed method."""
CELLS = ((0.0, 0.015, 48), (0.03, 0.05, 96), (0.06, 0.10, 96), (0.12, 0.25, 96), (0.24, float("inf"), 96))
"""For points up to so far from the body (second, [m]), body vertices are summed up in cells of this size (first, [m])
and so many of the nearest (third) take part: the kernel is as wide as the distance, and so are the cells."""
SLACK = 1.0
"""How far weights spread along the cloth, in units of its distance from the body, where it hangs loose."""


@dataclass(frozen=True)
class Cells:
    """Body vertices summed up in the cells of a grid."""

    tree: cKDTree
    count: np.ndarray
    """(M,) vertices in each cell."""
    features: np.ndarray
    """(M, C) their mean features."""


@dataclass(frozen=True)
class BodyField:
    """What a neutral body knows at its vertices."""

    vertices: Tensor
    """(V, 3) neutral T-pose vertices [m]."""
    features: Tensor
    """(V, 24 + 3 S): skinning weights, then shape directions row-major over (3, S)."""

    @classmethod
    def of(cls, body) -> BodyField:
        """The field of a ``recon.bodies`` body."""
        rest = body.rest(torch.zeros(1, body.n_shape, device=body.weights.device)).vertices[0]
        return cls(rest, torch.cat([body.weights, body.shape_dirs.flatten(1)], 1))

    @cached_property
    def cells(self) -> tuple[Cells, ...]:
        """The vertices in cells of each size of ``CELLS``; the first are the vertices themselves."""
        return tuple(self._in_cells(size) for size, _, _ in CELLS)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) -> (N,) distance to the nearest body vertex [m]."""
        return self.cells[0].tree.query(points)[0]

    def _in_cells(self, size: float) -> Cells:
        vertices, features = self.vertices.cpu().double().numpy(), self.features.cpu().float().numpy()
        if size == 0:
            return Cells(cKDTree(vertices), np.ones(len(vertices)), features)
        _, cell, count = np.unique(np.floor(vertices / size), axis=0, return_inverse=True, return_counts=True)
        cell = cell.reshape(-1)
        mean = sp.csr_matrix((1 / count[cell], (cell, np.arange(len(cell)))), shape=(len(count), len(cell)))
        return Cells(cKDTree(mean @ vertices), count.astype(np.float64), (mean @ features).astype(np.float32))


def nearest(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features of the nearest body vertex (SNUG's choice)."""
    _, at = field.cells[0].tree.query(points.detach().cpu().numpy())
    return field.features[torch.as_tensor(at, device=points.device)]


def k_nearest(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features of the k nearest body vertices, weighted by inverse distance."""
    distance, at = field.cells[0].tree.query(points.detach().cpu().numpy(), k=NEIGHBOURS)
    share = 1 / torch.as_tensor(distance, dtype=points.dtype, device=points.device).clamp_min(1e-6)
    share = share / share.sum(1, keepdim=True)
    return (field.features[torch.as_tensor(at, device=points.device)] * share[..., None]).sum(1)


def smoothed(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) nearest features, Laplacian-smoothed along the garment's mesh (NCS's choice); needs the faces."""
    if faces is None:
        raise ValueError("smoothed binding: found no faces; wanted the garment's faces")
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = torch.cat([ends, ends.flip(1)]).unique(dim=0)
    count = torch.zeros(len(points), 1).to(points).index_add(0, ends[:, 0], torch.ones(len(ends), 1).to(points))
    found = nearest(field, points)
    for _ in range(SMOOTHING):
        around = torch.zeros_like(found).index_add(0, ends[:, 0], found[ends[:, 1]])
        found = torch.where(count > 0, 0.5 * found + 0.5 * around / count.clamp_min(1), found)
    return found


def gaps(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features by the participation of the whole body, as the paper has it (GAPS Eq. 5-7).

    phi(r) = exp(-r^2 / (k m^2)) of r = distance - m, m the distance to the nearest body vertex: tight cloth follows the
    skin beneath it, loose cloth a wide region. The kernel is as wide as m, so for loose cloth nearby body vertices are
    first summed up in cells that grow with m; weights differ from the full sum by 0.004 in the mean, 0.09 at most.
    """
    x = points.detach().cpu().double().numpy()
    m = field.distance(x)
    out = np.empty((len(x), field.features.shape[1]), np.float32)
    low = -1.0
    for cells, (_, high, count) in zip(field.cells, CELLS, strict=True):
        here = np.flatnonzero((m > low) & (m <= high))
        low = high
        if not len(here):
            continue
        reach = min(count, len(cells.count))
        distance, at = cells.tree.query(x[here], k=reach)
        beyond = distance - np.minimum(m[here], distance[:, 0])[:, None]
        share = cells.count[at] * np.exp(-(beyond**2) / (WIDTH * np.maximum(m[here], NEAREST)[:, None] ** 2))
        share /= share.sum(1, keepdims=True)
        rows = np.arange(len(here) + 1) * reach
        matrix = sp.csr_matrix(
            (share.astype(np.float32).ravel(), at.ravel(), rows), shape=(len(here), len(cells.count))
        )
        out[here] = matrix @ cells.features
    return torch.as_tensor(out).to(points)


def rbf(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features by GAPS' participation, their weights settled along the cloth (``settle``): the default."""
    return settle(field, gaps(field, points), points, faces)


def settle(field: BodyField, features: Tensor, points: Tensor, faces: Tensor | None) -> Tensor:
    """(N, C) features whose skinning weights are evened out along the cloth where it hangs loose.

    Half way between the legs of a skirt the participation turns from one leg to the other within about m, the distance
    to the body, and a step would stretch that strip several times over. Weights f become g with
    g - div(l^2 grad g) = f on the cloth, l = SLACK m: tight cloth keeps its weights, a skirt passes from leg to leg
    over its whole width, and the legs of trousers, apart on the cloth, stay apart. Without faces nothing changes.
    """
    if faces is None or len(faces) == 0:
        return features
    x, f = points.detach().cpu().double().numpy(), faces.cpu().numpy()
    stiffness, mass = cloth_operators(x, f, ((SLACK * field.distance(x)) ** 2)[f].mean(1))
    matrix = (sp.diags(mass) + stiffness).tocsr().astype(np.float32)
    weights = features[:, :JOINTS].detach().cpu().float().numpy()
    active = np.flatnonzero(weights.max(0) > 1e-3)  # a skirt has no hands
    out = features.clone()
    settled = _conjugate_gradients(matrix, mass.astype(np.float32)[:, None] * weights[:, active], weights[:, active])
    out[:, torch.as_tensor(active)] = out[:, torch.as_tensor(active)] + torch.as_tensor(
        settled - weights[:, active]
    ).to(points)
    return out


def _conjugate_gradients(matrix: sp.csr_matrix, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solutions of matrix x = right, column by column at once, Jacobi-preconditioned; weights to about 0.01."""
    inverse = 1 / matrix.diagonal()[:, None]
    x = start.copy()
    residual = right - matrix @ x
    z = inverse * residual
    p, rz = z.copy(), (residual * z).sum(0)
    enough = 1e-4 * (right * inverse * right).sum(0).max()
    for _ in range(60):
        if rz.max() < enough:
            break
        q = matrix @ p
        step = rz / np.maximum((p * q).sum(0), 1e-30)
        x += step * p
        residual -= step * q
        z = inverse * residual
        previous, rz = rz, (residual * z).sum(0)
        p = z + rz / np.maximum(previous, 1e-30) * p
    return x


def cloth_operators(x: np.ndarray, faces: np.ndarray, factor: np.ndarray) -> tuple[sp.csr_matrix, np.ndarray]:
    """Stiffness (N, N) of -div(factor grad) with linear elements, factor (F,) [m2], and lumped mass (N,) [m2].

    Cotangents below 0.05 are raised to it: every row stays an average of its neighbours, whatever the triangles.
    """
    n = len(x)
    corner = x[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.maximum(np.linalg.norm(normal, axis=1), 1e-12) / 2
    rows, columns, values = [], [], []
    for k in range(3):
        i, j = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        w = factor * np.maximum((a * b).sum(1) / (4 * area), 0.05)
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        values += [-w, -w, w, w]
    stiffness = sp.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=n)
    return stiffness, np.maximum(mass, 1e-9)


METHODS: dict[str, Callable[[BodyField, Tensor, Tensor | None], Tensor]] = {
    "rbf": rbf,
    "gaps": gaps,
    "nearest": nearest,
    "k_nearest": k_nearest,
    "smoothed": smoothed,
}
"""Name -> (field, points (N, 3), garment faces or None) -> (N, C) features."""
