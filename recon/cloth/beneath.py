"""What lies beneath a garment: how deep its cloth is in a layer or in the body, and which way out (ISP Eq. 10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.cloth.constraints import open_rim
from recon.cloth.contact import BodyContact
from recon.types import Mesh

MARGIN = 0.004
"""epsilon of Eq. 10: distance that an outer layer keeps from the one beneath [m]."""
REACH = 0.08
"""Layers deeper in each other than this are not recognised [m]."""
SKIN_REACH = 0.02
"""The same for a closed surface, the body: deeper between arm and trunk the nearest way out tears the cloth [m]."""
SAME_WAY = (0.2, 0.7)
"""A vertex belongs over a face only if their normals agree by this cosine, near it and far from it: a sleeve beside the
hip covers nothing, and the hem that hangs between the legs does not lie on the other thigh."""
DEEP = (0.02, 0.06)
"""What near and far mean there [m]."""
ON_RIM = 1e-3
"""Barycentric weight below which a corner has no part in a closest point."""


def vertex_normals(x: Tensor, faces: Tensor) -> Tensor:
    """(..., V, 3) positions -> (..., V, 3) unit normals, weighted by area."""
    a, b, c = (x[..., faces[:, k], :] for k in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    out = torch.zeros_like(x)
    for k in range(3):
        out = out.index_add(-2, faces[:, k], normal)
    return out * out.square().sum(-1, keepdim=True).clamp_min(1e-24).rsqrt()


def rim_of(faces: Tensor, count: int) -> Tensor:
    """(V,) bool, which of ``count`` vertices lie on open borders."""
    return torch.as_tensor(open_rim(faces.cpu().numpy(), count), device=faces.device)


@dataclass(frozen=True)
class Beneath:
    """A layer that others lie over, in one pose."""

    contact: BodyContact
    normals: Tensor
    """(V, 3)."""
    rim: Tensor
    """(V,) bool, vertices on open borders."""

    @classmethod
    def of(cls, x: Tensor, faces: Tensor, rim: Tensor | None = None) -> Beneath:
        """From vertices (V, 3) [m] and faces; ``rim`` (V,) where it is known already."""
        if rim is None:
            rim = rim_of(faces, len(x))
        return cls(BodyContact(x.detach(), faces), vertex_normals(x.detach(), faces), rim)

    @classmethod
    def all_of(cls, layer: Mesh, rim: Tensor | None = None) -> list[Beneath]:
        """One for each pose of a layer (B, V, 3)."""
        rim = rim_of(layer.faces, layer.vertices.shape[1]) if rim is None else rim
        return [cls.of(x, layer.faces, rim) for x in layer.vertices]

    def closest(self, x: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """For points (N, 3) and their own normals: closest points and normals there (N, 3), whether they count (N,).

        Beside an open border there are no sides, far away is not beneath, and what faces another way is another part.
        """
        face, weights, _ = self.contact.closest(x.detach())
        corners = self.contact.faces[face]
        on = (self.contact.vertices[corners] * weights[..., None]).sum(1)
        normal = F.normalize((self.normals[corners] * weights[..., None]).sum(1), dim=-1)
        counts = ~(self.rim[corners] | (weights < ON_RIM)).all(1)
        far = (x.detach() - on).norm(dim=1)
        counts &= far < (REACH if self.rim.any() else SKIN_REACH)
        share = ((far - DEEP[0]) / (DEEP[1] - DEEP[0])).clamp(0, 1)
        counts &= (normals.detach() * normal).sum(1) > SAME_WAY[0] + share * (SAME_WAY[1] - SAME_WAY[0])
        return on, normal, counts

    def lack(self, x: Tensor, normals: Tensor, margin: float = MARGIN) -> tuple[Tensor, Tensor]:
        """How far each point is from being ``margin`` above (N,) [m], differentiable in x, and the way out (N, 3)."""
        on, normal, counts = self.closest(x, normals)
        return torch.where(counts, (margin + ((on - x) * normal).sum(1)).clamp_min(0), 0.0), normal


def repulsion(x: Tensor, faces: Tensor, beneath: Sequence[Beneath], margin: float = MARGIN) -> Tensor:
    """Forces (B, V, 3) [m] of Eq. 9 on an outer layer (B, V, 3) by what lies beneath in each pose, margin included."""
    normals = vertex_normals(x, faces)
    found = [b.lack(p, n, margin) for p, n, b in zip(x, normals, beneath, strict=True)]
    return torch.stack([lack[:, None] * out for lack, out in found])


def deepest(layers: Sequence[Beneath], x: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Of the layers' surfaces beside points (V, 3) the one that each is deepest beneath: point, normal or none."""
    found = [layer.closest(x, normals) for layer in layers]
    on, out = (torch.stack([f[k] for f in found]) for k in (0, 1))
    counts = torch.stack([f[2] for f in found])
    depth = torch.where(counts, ((on - x) * out).sum(-1), -torch.inf)
    which = depth.argmax(0)
    each = torch.arange(len(x))
    return on[which, each], out[which, each] * counts[which, each, None]
