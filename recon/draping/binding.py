"""How a garment at rest follows the body: per garment vertex, skinning weights and shape directions taken from the body.

A *feature* row is the body's knowledge at one of its vertices: 24 skinning weights and 3 S shape directions. Every method
blends feature rows of body vertices for points in the neutral body's T-pose space.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

WIDTH = 0.5
"""k of GAPS Eq. 5."""
NEAREST = 0.01
"""Points nearer to the body than this count as this far away [m]: on the skin Eq. 5's kernel would have no width."""
NEIGHBOURS = 8
"""k of the k-nearest method."""
SMOOTHING = 60
"""Rounds of the Laplacian-smoothed method."""


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


def nearest(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features of the nearest body vertex (SNUG's choice)."""
    _, at = cKDTree(field.vertices.cpu().numpy()).query(points.detach().cpu().numpy())
    return field.features[torch.as_tensor(at, device=points.device)]


def k_nearest(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features of the k nearest body vertices, weighted by inverse distance."""
    distance, at = cKDTree(field.vertices.cpu().numpy()).query(points.detach().cpu().numpy(), k=NEIGHBOURS)
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


def rbf(field: BodyField, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """(N, C) features by the participation of the whole body (GAPS Eq. 5-7), the default.

    phi(r) = exp(-r^2 / (k m^2)) of r = distance - m, m the distance to the nearest body vertex: tight cloth follows the
    skin beneath it, loose cloth a wide region.
    """
    out = []
    for chunk in points.detach().split(2048):
        distance = torch.cdist(chunk, field.vertices)
        m = distance.min(1, keepdim=True).values
        share = torch.exp(-((distance - m) ** 2) / (WIDTH * m.clamp_min(NEAREST) ** 2))
        out.append(share @ field.features / share.sum(1, keepdim=True))
    return torch.cat(out)


METHODS: dict[str, Callable[[BodyField, Tensor, Tensor | None], Tensor]] = {
    "rbf": rbf,
    "nearest": nearest,
    "k_nearest": k_nearest,
    "smoothed": smoothed,
}
"""Name -> (field, points (N, 3), garment faces or None) -> (N, C) features."""
