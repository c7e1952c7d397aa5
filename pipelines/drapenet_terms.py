"""What DrapeNet's draping learns besides physics: L_pin (Eq. 8), and the body's points under two garments (Eq. 11)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from recon.bodies import Body
from recon.cloth.beneath import Beneath, rim_of, vertex_normals
from recon.types import Garment, Mesh

COVERED = 0.08
"""A body point further than this from a garment at rest is not covered by it [m]."""
OVER = 0.7
"""Nor is one that has the garment beside it: cosine between the way there and its normal."""


def pinned(moved: Tensor, side: float) -> Tensor:
    """L_pin of Eq. 8: displacements (B, V, 3) -> (B,); mostly the vertical ones pay."""
    return (moved.square() * moved.new_tensor([side, 1.0, side])).sum((1, 2))


def trunk(garment: Garment, body: Body) -> Tensor:
    """(V,) vertices whose closest body vertex belongs to the trunk (§7.2)."""
    rest = body.rest(body.neutral().shape).vertices[0]
    nearest_vertex = cKDTree(rest.numpy()).query(garment.mesh.vertices.detach().numpy())[1]
    return body.region_mask("torso")[torch.as_tensor(nearest_vertex)].nonzero().flatten()


@dataclass(frozen=True)
class Covered:
    """Body points under both garments (C of Eq. 11), and the garments' vertices over them at rest."""

    points: Tensor
    """(C,) body vertices."""
    top: Tensor
    """(C, K) vertices of the top."""
    bottom: Tensor
    """(C, K) vertices of the bottom."""

    @classmethod
    def of(cls, body: Body, top: Mesh, bottom: Mesh, neighbours: int = 8) -> Covered:
        """From both garments at rest on the neutral body."""
        rest = body.rest(body.neutral().shape).vertices[0]
        tried = body.region_mask("torso", "legs").nonzero().flatten()
        normal = vertex_normals(rest, body.faces)[tried]
        over, chosen = [], torch.ones(len(tried), dtype=torch.bool)
        for mesh in (top, bottom):
            x = mesh.vertices.detach()
            distance, index = cKDTree(x.numpy()).query(rest[tried].numpy(), k=neighbours)
            at = torch.as_tensor(index)
            away = torch.nn.functional.normalize(x[at[:, 0]] - rest[tried], dim=1)
            chosen &= (torch.as_tensor(distance[:, 0]) < COVERED) & ((away * normal).sum(1) > OVER)
            over.append(at)
        return cls(tried[chosen], over[0][chosen], over[1][chosen])


def nearest(points: Tensor, x: Tensor, over: Tensor) -> Tensor:
    """(B, C) distance of points (B, C, 3) to the nearest of their vertices x[over], over (C, K) [m]."""
    return (x[:, over] - points[:, :, None]).square().sum(-1).amin(-1).clamp_min(1e-12).sqrt()


def outside(x: Tensor, faces: Tensor, over: Mesh, apart: float) -> Tensor:
    """() how far covered vertices (B, V, 3) are from being ``apart`` inside of the garment over them, in the mean [m].

    The covering garment (B, N, 3) is held; who lies beside its borders, or faces another way, is not covered by it.
    """
    total, rim = x.new_zeros(()), rim_of(over.faces, over.vertices.shape[1])
    for lower, upper in zip(x, over.vertices, strict=True):
        on, out, counts = Beneath.of(upper, over.faces, rim).closest(lower, vertex_normals(lower.detach(), faces))
        away = (apart + ((lower - on) * out).sum(1)).clamp_min(0)
        total = total + torch.where(counts, away, 0.0).sum() / counts.sum().clamp_min(1)
    return total / len(x)
