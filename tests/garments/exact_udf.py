"""A distance-field decoder whose fields are known exactly: skirts as tubes around the hips, one code entry a size."""

from __future__ import annotations

import torch
from torch import Tensor

from recon.garments.udf import Known, LatentField, UdfDecoder
from recon.garments.udf_net import UdfNets, UdfShape

SHAPE = UdfShape("lower", (-0.45, 0.35, -0.45), (0.45, 1.15, 0.45), code=2)
RADIUS, MIDDLE, HALF, SLOPE = 0.2, 0.82, 0.18, 0.05
"""Of the skirt of code 0 [m]: radius, height of its middle, half its length; and metres an entry of one changes."""


class TubeField(LatentField):
    """The exact unsigned distance of a tube round y: the code's first entry widens it, its second lengthens it."""

    sided = None

    def __init__(self, latent: Tensor):
        self.radius, self.half = RADIUS + SLOPE * latent[0], HALF + SLOPE * latent[1]

    def __call__(self, points: Tensor) -> Tensor:
        """(N, 3) [m] -> (N,) [m]."""
        beside = (points[:, [0, 2]].square().sum(1) + 1e-12).sqrt() - self.radius
        beyond = torch.relu((points[:, 1] - MIDDLE).abs() - self.half)
        return (beside.square() + beyond.square() + 1e-14).sqrt()

    def slope(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N,) and gradients (N, 3), detached."""
        with torch.enable_grad():
            x = points.detach().requires_grad_()
            distance = self(x)
            (gradient,) = torch.autograd.grad(distance.sum(), x)
        return distance.detach(), gradient


class TubeDecoder(UdfDecoder):
    """Skirts of two sizes, with everything that a learned decoder does but the network."""

    def __init__(self, count: int = 9):
        side = torch.linspace(-1, 1, round(count**0.5))
        codes = torch.cartesian_prod(side, side)
        super().__init__(UdfNets(SHAPE), codes, [Known("skirt", "skirt", {}) for _ in codes], "skirt")

    def field(self, latent: Tensor, half: bool = False) -> TubeField:
        """The exact field of a code (2,)."""
        return TubeField(latent)


class SidedTube(TubeField):
    """The same tube, that also tells across from beside."""

    def sides(self, points: Tensor) -> Tensor:
        """(N, 3) [m] -> (N, 2) [m]."""
        across = (points[:, [0, 2]].square().sum(1) + 1e-12).sqrt() - self.radius
        return torch.stack([across, torch.relu((points[:, 1] - MIDDLE).abs() - self.half)], 1)

    def sides_slope(self, points: Tensor, column: int) -> tuple[Tensor, Tensor]:
        """One of both (N,) and its gradient (N, 3), detached."""
        with torch.enable_grad():
            x = points.detach().requires_grad_()
            one = self.sides(x)[:, column]
            (gradient,) = torch.autograd.grad(one.sum(), x)
        return one.detach(), gradient
