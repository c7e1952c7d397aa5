"""What the learned codes say about new ones: mean, prior, sampling, retrieval and editing directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class LatentPrior:
    """A normal distribution around the learned codes (not around zero: learned codes sit on a shell)."""

    mean: Tensor
    """(z,)."""
    factor: Tensor
    """(z, z) lower Cholesky factor of the covariance."""

    @staticmethod
    def of(codes: Tensor, shrink: float = 0.1) -> LatentPrior:
        """Fit to codes (n, z); the covariance is pulled by ``shrink`` towards an isotropic one: few codes suffice."""
        mean = codes.mean(0)
        away = (codes - mean).double()
        covariance = away.T @ away / max(len(codes) - 1, 1)
        level = covariance.diagonal().mean().clamp_min(1e-8)
        isotropic = level * torch.eye(len(mean), dtype=torch.float64, device=codes.device)
        covariance = (1 - shrink) * covariance + shrink * isotropic
        return LatentPrior(mean, torch.linalg.cholesky(covariance).to(codes.dtype))

    def energy(self, z: Tensor) -> Tensor:
        """Squared Mahalanobis distance per dimension: (..., z) -> (...); about 1 for a typical garment."""
        white = torch.linalg.solve_triangular(self.factor, (z - self.mean)[..., None], upper=False)
        return white.squeeze(-1).square().mean(-1)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, z) random codes."""
        white = torch.randn(count, len(self.mean), generator=generator, dtype=self.mean.dtype)
        return self.mean + white.to(self.mean.device) @ self.factor.T


@dataclass(frozen=True)
class Neighbourhood:
    """How far a code is from what was learned: between learned codes that are far apart, a decoder knows nothing."""

    codes: Tensor
    """(n, z) learned codes."""
    scale: float
    """Median distance of a learned code from its nearest neighbour."""

    @staticmethod
    def of(codes: Tensor) -> Neighbourhood:
        """Of codes (n, z)."""
        if len(codes) < 2:
            return Neighbourhood(codes, float(codes.norm().clamp_min(1e-6)))
        apart = torch.cdist(codes, codes).fill_diagonal_(float("inf")).min(1).values
        return Neighbourhood(codes, float(apart.median().clamp_min(1e-6)))

    def energy(self, z: Tensor) -> Tensor:
        """Squared distance from the nearest learned codes (a soft minimum) in units of ``scale``: (z,) -> ()."""
        square = (self.codes - z).square().sum(1) / self.scale**2
        return -torch.logsumexp(-square, 0)


def mahalanobis(latent: Tensor, codes: Tensor) -> Tensor:
    """Mean squared Mahalanobis distance per dimension of latents (..., z) from the learned codes (n, z): (...)."""
    return LatentPrior.of(codes).energy(latent)


def spread(codes: Tensor, count: int, among: Tensor | None = None) -> Tensor:
    """Indices of up to ``count`` codes that cover the learned ones (farthest points first from the most central one).

    ``among`` (K,) restricts the choice. The first index is the code nearest to the mean of the choice.
    """
    choice = torch.arange(len(codes), device=codes.device) if among is None else among
    points = codes[choice]
    picked = [int((points - points.mean(0)).square().sum(1).argmin())]
    distance = (points - points[picked[0]]).square().sum(1)
    while len(picked) < min(count, len(choice)):
        picked.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[picked[-1]]).square().sum(1))
    return choice[picked]


def of_variants(variants: Sequence[str], wanted: Sequence[str]) -> Tensor:
    """(K,) indices of the codes whose variant is among ``wanted``; all codes if none is."""
    found = [k for k, name in enumerate(variants) if name in wanted]
    return torch.tensor(found or range(len(variants)), dtype=torch.long)


def nearest(codes: Tensor, z: Tensor, count: int = 1) -> Tensor:
    """(count,) indices of the learned codes closest to z (z,), nearest first."""
    return (codes - z).square().sum(1).topk(min(count, len(codes)), largest=False).indices


def editing_direction(codes: Tensor, values: Tensor, ridge: float = 1e-2) -> Tensor:
    """The direction (z,) in code space along which a measure grows by one unit per unit step, the rest kept.

    values: (n,) the measure of each learned garment (a pattern parameter such as sleeve length [m]). The direction is
    the change of the mean code with the measure: it stays among the learned codes, unlike the gradient of a
    regression.
    """
    x, y = codes - codes.mean(0), values - values.mean()
    scale = y.square().mean()
    return (x * y[:, None]).mean(0) / (scale * (1 + ridge)).clamp_min(1e-12)
