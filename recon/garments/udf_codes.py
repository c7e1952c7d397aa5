"""The code of a surface: learned ones that fit it, and descent from there (DrapeNet Eq. 1 with the networks held).

An encoder's code of a garment unlike what it learned from can lie far from all that the decoder knows; then descent
ends in rags. So learned codes are asked as well, and a prior keeps what descends among them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from recon.garments.latents import LatentPrior

NEAR, FAR = 0.03, (0.12, 0.4)
"""Deviations of places beside the surface [m]: those that say where it ends, and those that say that there is no more
of it elsewhere: no sleeves on a vest."""


@runtime_checkable
class Fields(Protocol):
    """What a code is found with: ``UdfDecoder``, or another that has distance fields of codes; points are those of its
    fields' space."""

    all_codes: Tensor

    def field(self, latent: Tensor, half: bool = False): ...


@dataclass(frozen=True)
class CodeSearch:
    """How a code is refined."""

    steps: int = 60
    """Steps of descent."""
    rate: float = 0.03
    """Adam's first step; it falls to a tenth."""
    places: int = 1500
    """Points on the surface in each step, half as many beside it."""
    far: float = 0.0
    """Share of those beside it that are further off."""
    stay: float = 1e-3
    """Weight of the squared distance from where it began."""
    prior: float = 0.0
    """Weight of the squared Mahalanobis distance from the learned codes, per dimension."""


@dataclass(frozen=True)
class Places:
    """Places on a surface and beside it, with the distances that a field should have there."""

    on: Tensor
    """(N, 3) [m]."""
    beside: Tensor
    """(M, 3) [m]."""
    wanted: Tensor
    """(M,) distances there [m]."""
    reach: float
    """Distances end here [m]."""

    @staticmethod
    def draw(points: Tensor, tree: cKDTree, reach: float, how: CodeSearch, generator: torch.Generator) -> Places:
        """Of the surface points (P, 3) that ``tree`` holds."""
        pick = points[torch.randint(len(points), (how.places,), generator=generator)]
        half = how.places // 2
        away = torch.full((half, 1), NEAR)
        for k, far in enumerate(FAR):
            away[k : round(how.far * half) : len(FAR)] = far
        beside = pick[:half] + away * torch.randn(half, 3, generator=generator)
        wanted = torch.as_tensor(tree.query(beside.numpy())[0], dtype=pick.dtype).clamp(max=reach)
        return Places(pick, beside, wanted, reach)

    def misfit(self, field) -> Tensor:
        """() how far a field is from the surface's, in units of δ: both on the surface and beside it."""
        return (field(self.on).mean() + (field(self.beside) - self.wanted).abs().mean()) / self.reach


def best_start(decoder: Fields, codes: Tensor, points: Tensor, reach: float) -> tuple[Tensor, float]:
    """The one of ``codes`` (n, z) whose field fits surface points (P, 3) [m] best, and its misfit."""
    generator = torch.Generator().manual_seed(1)
    places = Places.draw(points, cKDTree(points.numpy()), reach, CodeSearch(places=400, far=0.5), generator)
    with torch.no_grad():
        misfits = torch.stack([places.misfit(decoder.field(code)) for code in codes])
    best = int(misfits.argmin())
    return codes[best], float(misfits[best])


def refined(decoder: Fields, latent: Tensor, points: Tensor, reach: float, how: CodeSearch) -> Tensor:
    """The code (Z,) near ``latent`` whose field is smallest at surface points (P, 3) [m] and large elsewhere.

    Distances at the points fall; that the surface ends where they end is told by places beside the points.
    """
    generator, tree = torch.Generator().manual_seed(0), cKDTree(points.cpu().numpy())
    prior = LatentPrior.of(decoder.all_codes) if how.prior else None
    z = latent.detach().clone().requires_grad_()
    adam = torch.optim.Adam([z], lr=how.rate)
    best, least = latent.detach(), float("inf")
    for step in range(how.steps):
        for group in adam.param_groups:
            group["lr"] = how.rate * (1 - 0.9 * step / how.steps)
        places = Places.draw(points, tree, reach, how, generator)
        loss = places.misfit(decoder.field(z)) + how.stay * (z - latent.detach()).square().mean()
        if prior is not None:
            loss = loss + how.prior * prior.energy(z)
        adam.zero_grad()
        loss.backward()
        adam.step()
        if float(loss.detach()) < least:
            best, least = z.detach().clone(), float(loss.detach())
    return best
