"""A garment's code for DrapeNet: what any mesh at rest has, whichever decoder it came from or none."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from recon.cloth.contact import BodyContact
from recon.types import Mesh

FARTHEST = 0.15
"""Distances from the fixed points count up to this [m]."""


class RestCode(nn.Module):
    """z: unsigned distances of a garment at rest from fixed points, in the learned garments' principal components."""

    points: Tensor
    mean: Tensor
    components: Tensor

    def __init__(self, points: int = 256, size: int = 32):
        super().__init__()
        self.register_buffer("points", torch.zeros(points, 3))
        self.register_buffer("mean", torch.zeros(points))
        self.register_buffer("components", torch.zeros(size, points))

    def distances(self, mesh: Mesh) -> Tensor:
        """(P,) how far each fixed point is from the surface, up to ``FARTHEST`` [m]; no gradient."""
        x = mesh.vertices.detach()
        with torch.no_grad():
            return BodyContact(x, mesh.faces).signed_distance(self.points).abs().clamp(max=FARTHEST)

    def know(self, meshes: Sequence[Mesh], generator: torch.Generator) -> None:
        """Choose points on the meshes and a little off them, and the components of their distances."""
        everything = torch.cat([m.vertices.detach() for m in meshes])
        chosen = torch.randperm(len(everything), generator=generator)[: len(self.points)]
        noise = 0.03 * torch.randn(len(self.points), 3, generator=generator)
        self.points.copy_(everything[chosen] + noise)
        rows = torch.stack([self.distances(m) for m in meshes])
        self.mean.copy_(rows.mean(0))
        _, spread, axes = torch.linalg.svd(rows - self.mean, full_matrices=False)
        size = min(len(self.components), len(axes))
        deviation = spread[:size].clamp_min(1e-6) / len(rows) ** 0.5
        self.components.zero_()
        self.components[:size] = axes[:size] / deviation.clamp_min(0.05 * deviation[0])[:, None]

    def forward(self, mesh: Mesh) -> Tensor:
        """(z,) the code of a mesh at rest on the neutral body, about one in each component; clamped to three."""
        return (self.components @ (self.distances(mesh) - self.mean)).clamp(-3, 3)
