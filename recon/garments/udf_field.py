"""Exact unsigned distance fields of triangle meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from recon.cloth.contact import BodyContact
from recon.types import Mesh


class MeshField:
    """The unsigned distance of a mesh as a ``recon.garments.udf_grid.Field``, differentiable in points and vertices."""

    def __init__(self, mesh: Mesh):
        """``mesh``: open or closed, vertices (V, 3) [m]."""
        self.mesh = mesh
        self._contact = BodyContact(mesh.vertices, mesh.faces)

    def closest(self, points: Tensor) -> Tensor:
        """(N, 3) the surface's points that are closest to points (N, 3); differentiable in the vertices."""
        face, weights, _ = self._contact.closest(points)
        return (self.mesh.vertices[self.mesh.faces[face]] * weights[..., None]).sum(1)

    def __call__(self, points: Tensor) -> Tensor:
        """(N,) distances [m]."""
        return ((points - self.closest(points)).square().sum(1) + 1e-20).sqrt()

    def slope(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N,) and unit gradients (N, 3), detached; the gradient is zero on the surface."""
        with torch.no_grad():
            away = points - self.closest(points)
            distance = away.norm(dim=1)
            return distance, away / distance[:, None].clamp_min(1e-9)
