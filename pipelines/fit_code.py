"""Find the latent code that explains some evidence: the search that pattern, mesh, points and silhouette share.

A code descends by L-BFGS in whitened coordinates (units of the learned codes' spread), towards least

    evidence(z) + prior · Mahalanobis(z) + gap · seam gap + strain · stretch of the surface map

The last two need no evidence: whatever the code, both sides of a seam meet and cloth at rest is hardly stretched. They
and the prior keep a code among clothes where the evidence leaves it free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from recon.garments.isp import IspDecoder
from recon.garments.latents import LatentPrior
from recon.garments.sewing import sewn_to
from recon.types import Garment, UserError

HOPELESS = 1e3
"""Energy of a code that describes no garment."""
FARTHEST = 3.5
"""No coordinate of a code is sought further from the mean than this [standard deviations]."""
TRUST = 0.5
"""Nor further than this in one round: borders follow a code only so far before the garment must be cut anew."""
FIRST_STEP = 0.3
"""Length of a round's first step where a shorter one changed nothing [standard deviations]."""
DIFFERENCE = 0.02
"""Step of the finite differences that tell stretch [domain units]."""


@dataclass(frozen=True)
class CodeFit:
    """How a code is searched."""

    starts: int = 3
    """Learned codes that a first round begins from; the best goes on."""
    rounds: int = 7
    """How often topology and matches are made anew."""
    steps: int = 12
    """L-BFGS steps a round."""
    prior: float = 3e-3
    """Weight of the Mahalanobis distance from the learned codes."""
    gap: float = 0.01
    """Weight of the seams' gap, per 1 % of the domain's half side."""
    strain: float = 0.02
    """Weight of the surface map's stretch."""
    seed: int = 0
    """Of all sampling."""


@runtime_checkable
class Evidence(Protocol):
    """What a code is held against."""

    def renew(self, latent: Tensor) -> None:
        """Called at the start of each round: match anew. UserError: the code describes no garment."""
        ...

    def __call__(self, latent: Tensor) -> Tensor:
        """Energy of the code (z,), differentiable: about the misfit in units of 1 % of the garment's size."""
        ...


class Sewable:
    """What holds for every garment: seams meet, and cloth at rest is not stretched (no evidence needed)."""

    def __init__(self, decoder: IspDecoder, settings: CodeFit, places: int = 200, seams: int = 100):
        self.decoder, self.settings = decoder, settings
        self.places, self.seams = places, seams
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.inside = self.seam = torch.zeros(0, 2)
        self.panel = self.seam_panels = torch.zeros(0, dtype=torch.long)

    def renew(self, garment: Garment) -> None:
        """Take the points to look at from a garment near the code: within panels, and along seams."""
        to_domain = self.decoder.nets.to_domain
        points = to_domain(garment.panel_points.detach())
        middles = points[garment.panel_faces].mean(1)
        pick = torch.randint(len(middles), (self.places,), generator=self.generator)
        self.inside, self.panel = middles[pick], garment.panel_of_face[pick]
        sewn = (garment.border_labels > 0).nonzero()[:, 0]
        some = torch.randint(max(len(sewn), 1), (self.seams if len(sewn) else 0,), generator=self.generator)
        self.seam = points[sewn[some]]
        partner = torch.as_tensor(sewn_to(garment.vertex_of_point.numpy()))
        self.seam_panels = garment.panel_of_point[torch.stack([sewn[some], partner[sewn[some]]], 1)]

    def __call__(self, latent: Tensor) -> Tensor:
        """Weighted energy of a code (z,); near a learned garment's about the weights' sum / 10."""
        nets, n, m = self.decoder.nets, len(self.inside), len(self.seam)
        step = DIFFERENCE * torch.eye(2, dtype=latent.dtype)
        x = torch.cat([self.inside, self.inside + step[0], self.inside + step[1], self.seam])
        places = nets.lift(nets.surface.run_folded(nets.surface.fold(latent), x), x)
        corner = places[: 3 * n].unflatten(0, (3, n))[:, torch.arange(n), self.panel]
        u, v = (corner[1] - corner[0]) / DIFFERENCE, (corner[2] - corner[0]) / DIFFERENCE
        green = 0.5 * torch.stack([u.square().sum(1) - 1, v.square().sum(1) - 1, 2**0.5 * (u * v).sum(1)])
        energy = self.settings.strain * (green.square().sum(0) + 1e-4).sqrt().mean()
        if m:
            one, other = places[3 * n :][torch.arange(m)[:, None], self.seam_panels].unbind(1)
            apart = ((one - other).square().sum(1) + 1e-8).sqrt().mean()
            energy = energy + 100 * self.settings.gap * apart
        return energy


@dataclass(frozen=True)
class FoundCode:
    """Where a search ended."""

    latent: Tensor
    """(z,)."""
    energy: float
    """At the end, all terms."""
    start: int
    """Row of the starts that led there."""


def find_code(
    decoder: IspDecoder,
    evidence: Evidence,
    starts: Tensor,
    settings: CodeFit,
    tick: Callable[[int, float], None] | None = None,
) -> FoundCode:
    """The code of least energy that is found from the codes ``starts`` (K, z).

    Raises:
        UserError: no start leads to a garment.
    """
    scores = [_score(evidence, latent) for latent in starts]
    order = np.argsort(scores)[: settings.starts].tolist()
    tries = [_round(decoder, evidence, starts[k], settings) for k in order]
    number = min(range(len(tries)), key=lambda k: tries[k][1])
    latent, energy = tries[number]
    for step in range(1, settings.rounds):  # only the most promising goes on
        if tick:
            tick(step, energy)
        found, after = _round(decoder, evidence, latent, settings)
        if after < HOPELESS:
            latent, energy = found, after
    if energy >= HOPELESS:
        raise UserError(f"{decoder.kind}: no start leads to the evidence; is it a garment of another kind?")
    return FoundCode(latent, energy, order[number])


def _score(evidence: Evidence, latent: Tensor) -> float:
    try:
        with torch.no_grad():
            evidence.renew(latent)
            return float(evidence(latent))
    except UserError:
        return HOPELESS


def _round(decoder: IspDecoder, evidence: Evidence, latent: Tensor, settings: CodeFit) -> tuple[Tensor, float]:
    """One round of L-BFGS in the codes' whitened coordinates, topology and matches as at its start."""
    prior = LatentPrior.of(decoder.codes)
    sewable = Sewable(decoder, settings)
    try:
        with torch.no_grad():
            evidence.renew(latent)
            sewable.renew(decoder.decode(latent, 48))
    except UserError:
        return latent, HOPELESS

    best, least = latent, HOPELESS

    def energy(white: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, least
        w = torch.as_tensor(white, dtype=latent.dtype).requires_grad_()
        z = prior.mean + prior.factor @ w
        try:
            value = evidence(z) + settings.prior * w.square().mean() + sewable(z)
        except ValueError:  # a trial step so long that nothing like a garment is left
            return HOPELESS, np.zeros_like(white)
        if not bool(value.isfinite()):
            return HOPELESS, np.zeros_like(white)
        (gradient,) = torch.autograd.grad(value, w)
        if float(value.detach()) < least:
            best, least = z.detach(), float(value.detach())
        return float(value.detach()), gradient.double().numpy()

    away = (latent - prior.mean)[:, None]
    white = torch.linalg.solve_triangular(prior.factor, away, upper=False)[:, 0].double().numpy()
    with torch.enable_grad():
        bounds = [(max(w - TRUST, min(w, -FARTHEST)), min(w + TRUST, max(w, FARTHEST))) for w in white]
        options = {"maxiter": settings.steps, "maxfun": round(1.3 * settings.steps), "maxcor": 20, "maxls": 8}
        found = minimize(energy, white, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        size = float(np.linalg.norm(found.jac))
        if not found.nit and size:  # a first step as long as the gradient ends on a silhouette's plateau
            scale = FIRST_STEP / size

            def scaled(white: np.ndarray) -> tuple[float, np.ndarray]:
                value, gradient = energy(white)
                return scale * value, scale * gradient

            minimize(scaled, white, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return best, least
