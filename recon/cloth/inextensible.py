"""Inextensibility that gives way only where the body needs room (GAPS Eq. 1-4, 15, 16).

Cloth that does not stretch moves each one-ring rigidly, ``y_j = R x_j + t``; then the ring's covariance keeps its
singular values (Eq. 3), so each template value is a root of the characteristic polynomial of the deformed covariance
(Eq. 4). The neighbourhood of a vertex is the set of vertices that share an edge with it, itself not included; borders
have what they have. Rings of fewer than two neighbours say nothing.

Determinants of a covariance are sixth powers of edge lengths, 1e-12 for a shirt: they are written out (no
factorisation that fails on flat rings), in doubles, and divided by the ring's own size, so that one strength serves
any mesh. At edges of 10 mm the paper's ``ki = 2e8`` is a ``strength`` of about 2.5e-5 J here.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

EPOCHS = 100
"""The epoch at which the stretch factor has been let out fully (Eq. 16)."""


@dataclass(frozen=True)
class OneRings:
    """The one-rings of a template."""

    neighbours: Tensor
    """(V, K) long, padded with the vertex itself."""
    count: Tensor
    """(V,) long, how many of them are neighbours."""
    singular: Tensor
    """(V, 3) double, singular values of the template's covariances, descending [m²]."""
    size: Tensor
    """(V,) double, half their sum [m²]; 0 where a ring says nothing."""

    @classmethod
    def of(cls, vertices: Tensor, faces: Tensor) -> OneRings:
        """From a template: vertices (V, 3) [m], faces (F, 3)."""
        neighbours, count = one_rings(faces, len(vertices))
        raw = cls(neighbours, count, vertices.new_zeros(0, 3), vertices.new_zeros(0))
        singular = torch.linalg.svdvals(covariances(raw, vertices.detach()))
        size = singular.sum(1) / 2
        return cls(neighbours, count, singular, torch.where((count > 1) & (size > 1e-10), size, 0.0))


def one_rings(faces: Tensor, vertices: int) -> tuple[Tensor, Tensor]:
    """Neighbours (V, K), padded with the vertex itself, and how many there are (V,)."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = torch.cat([ends, ends.flip(1)])
    ends = ends[ends[:, 0] != ends[:, 1]].unique(dim=0)  # sorted by the first
    count = torch.bincount(ends[:, 0], minlength=vertices)
    first = torch.cumsum(count, 0) - count
    place = torch.arange(len(ends), device=faces.device) - first[ends[:, 0]]
    width = max(int(count.max()) if len(count) else 0, 1)
    out = torch.arange(vertices, device=faces.device)[:, None].repeat(1, width)
    out[ends[:, 0], place] = ends[:, 1]
    return out, count


def covariances(rings: OneRings, x: Tensor) -> Tensor:
    """(..., V, 3) positions -> (..., V, 3, 3) covariances of their one-rings, doubles [m²] (Eq. 2)."""
    width = rings.neighbours.shape[1]
    inside = (torch.arange(width, device=x.device) < rings.count[:, None])[..., None].double()
    around = x.double()[..., rings.neighbours, :] * inside
    share = 1 / rings.count.clamp_min(1).double()[:, None]
    away = (around - (around.sum(-2) * share)[..., None, :]) * inside
    return torch.einsum("...ka,...kb->...ab", away, away) * share[..., None]


def determinant(matrix: Tensor) -> Tensor:
    """(..., 3, 3) -> (...): written out, so that its gradient is a polynomial and never fails."""
    a, b, c = matrix.unbind(-2)
    return (a * torch.linalg.cross(b, c)).sum(-1)


def relaxation(depth: Tensor, epoch: float) -> Tensor:
    """The stretch factor k_ext of each vertex (Eq. 16): 1 without contact, let out slowly where cloth is too deep.

    Args:
        depth: (...) lack of distance from the body, ``max(eps - d, 0)`` [m].
        epoch: of the training; the paper lets out over 100.
    """
    return 1 + (10 * depth.detach()).clamp(max=0.03) * min(epoch, EPOCHS)


def inextensibility(rings: OneRings, x: Tensor, factor: Tensor | float = 1.0) -> Tensor:
    """Eq. 15 without its weight: (..., V, 3) positions -> (...) sum over rings and singular values.

    Each determinant is divided by the ring's size to the third. ``factor`` (..., V): k_ext.
    """
    c = covariances(rings, x)
    sound = rings.size > 0
    size = torch.where(sound, rings.size, torch.ones_like(rings.size))
    eye = torch.eye(3, dtype=torch.float64, device=x.device)
    wanted = rings.singular * (factor[..., None].double() if isinstance(factor, Tensor) else factor)  # (..., V, 3)
    off = c[..., None, :, :] - wanted[..., None, None] * eye  # (..., V, 3, 3, 3)
    terms = determinant(off / size[:, None, None, None]).abs().sum(-1)
    return torch.where(sound, terms, 0.0).sum(-1)


def edge_lengths_kept(rings: OneRings, template: Tensor, x: Tensor) -> Tensor:
    """Eq. 1, the naive variant that the paper compares with: (..., V, 3) -> (...) [m²], each edge from both ends."""
    width = rings.neighbours.shape[1]
    inside = torch.arange(width, device=x.device) < rings.count[:, None]

    def lengths(points: Tensor) -> Tensor:
        square = (points[..., rings.neighbours, :] - points[..., None, :]).square().sum(-1)
        return torch.where(inside & (square > 1e-18), square, 1.0).sqrt()

    return torch.where(inside, (lengths(template) - lengths(x)).square(), 0.0).sum((-1, -2))
