"""Stage per garment of a scan, outermost first: retrieval, then code, pose and shape descend (DrapeNet Eq. 13).

The garment's distance to the scan is two-way. What lies beneath another garment can't be seen: points of an inner
garment that are nearer to an outer one's scan than to their own count for nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.codes import Decoding, retrieved
from pipelines.fit_body import to_body
from pipelines.fit_garment import Layer, Models
from pipelines.fit_scan_body import PARAMETERS, ScanBodyFit, SurfaceLoss, evenly
from recon.cloth.contact import BodyContact
from recon.descend import Descended, Descent, descend
from recon.garments.latents import LatentPrior, Neighbourhood, of_variants
from recon.losses import depth_penalty
from recon.types import Scan, UserError


@dataclass(frozen=True)
class ScanGarmentFit:
    """Settings of one garment's stage; weights are unitless."""

    points: int = 1500
    """Scan points of the garment that it is compared with."""
    levels: tuple[tuple[float, int, int], ...] = ((0.06, 48, 30), (0.03, 80, 40))
    """(distance at which points stop pulling harder [m], decoding resolution, most steps) from coarse to fine."""
    final_resolution: int = 104
    """Decoding resolution of the garment that the stage ends with."""
    retrieval_resolution: int = 40
    """Decoding resolution of the codes that retrieval compares."""
    retrieval_round: int = 36
    """Codes that retrieval's first round compares; its second compares as many neighbours of the best."""
    starts: int = 2
    """How many of the best retrieved codes get a first, coarse descent; the best goes on."""
    refresh: int = 5
    """Steps for which a garment's topology is kept while its code descends."""
    latent_rate: float = 0.06
    """Step size of the code in standard deviations of the learned codes."""
    mahalanobis: float = 0.002
    """Weight of the squared Mahalanobis distance from the mean of the codes that the name allows, per dimension."""
    neighbourhood: float = 0.004
    """Weight of the squared distance from the nearest learned codes, in units of the distance between those."""
    contact: float = 0.03
    """Weight of missing clearance between garment and body."""
    clearance: float = 0.004
    """Wanted clearance [m]."""
    body: float = 0.5
    """Weight of the body stage's loss."""
    body_points: int = 800
    """Scan points that it takes part with."""
    body_rate: float = 0.2
    """Step sizes of the body, relative to the body stage's: it only settles."""
    descent: Descent = field(default_factory=lambda: Descent(patience=15))
    """Shared settings of the levels; ``steps`` is taken from ``levels``."""


class TwoWay:
    """The two-way robust Chamfer distance between a surface and one garment's points in the scan."""

    def __init__(self, scan: Scan, name: str, outer: tuple[str, ...], count: int):
        """``outer``: the garments outside of this one; ``count``: points asked for their distance to the surface."""
        own, above = scan.of(name), scan.of(*outer) if outer else scan.points[:0]
        self.all = own
        self.points = own[evenly(own, count)]
        self.tree = cKDTree(own.cpu().numpy())
        self.above = cKDTree(above.cpu().numpy()) if len(above) else None

    def nearest(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """For (V, 3) points of the surface: the nearest scan points (V, 3), and (V,) whether they could be seen."""
        at = x.detach().cpu().numpy()
        distance, index = self.tree.query(at)
        seen = torch.ones(len(x), dtype=torch.bool, device=x.device)
        if self.above is not None:
            hidden = self.above.query(at)[0] < distance
            seen = torch.as_tensor(~hidden, device=x.device)
        return self.all[torch.as_tensor(index, device=x.device)], seen

    def __call__(self, x: Tensor, faces: Tensor, reach: float) -> Tensor:
        """() robust mean of squared distances both ways, each at most 1; differentiable in x (V, 3).

        Points further than ``reach`` [m] stop pulling harder.
        """
        target, seen = self.nearest(x)
        weight = vertex_areas(x.detach(), faces) * seen
        there = (weight * robust((x - target).square().sum(1), reach)).sum() / weight.sum().clamp_min(1e-9)
        back = BodyContact(x, faces).signed_distance(self.points).square()  # an open surface: the sign says nothing
        return there + robust(back, reach).mean()


def robust(square: Tensor, reach: float) -> Tensor:
    """Geman-McClure: d² / (d² + reach²)."""
    return square / (square + reach**2)


def vertex_areas(x: Tensor, faces: Tensor) -> Tensor:
    """(V,) a third of the area of the faces around each vertex [m²]."""
    a, b, c = x[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    return x.new_zeros(len(x)).index_add(0, faces.reshape(-1), area.repeat_interleave(3))


class ScanGarmentLoss:
    """The loss of one garment's descent at one level."""

    def __init__(self, name: str, outer: list[Layer], scan: Scan, models: Models, settings: ScanGarmentFit, level: int):
        self.models, self.settings = models, settings
        self.reach, resolution, _ = settings.levels[level]
        decoder = models.decoders[name]
        allowed = decoder.codes[of_variants(decoder.variants, models.variants[name])]
        self.prior, self.known = LatentPrior.of(allowed), Neighbourhood.of(allowed)
        self.decoding = Decoding(decoder, resolution, settings.refresh)
        self.distance = TwoWay(scan, name, tuple(layer.name for layer in outer), settings.points)
        self.on_body = SurfaceLoss(scan, models.body, ScanBodyFit(), settings.body_points)

    def __call__(self, values: dict[str, Tensor]) -> Tensor:
        s, models = self.settings, self.models
        posed = models.body.pose(to_body(values))
        try:
            garment = self.decoding(values["latent"])
        except UserError:  # the code left what garments look like: descend goes back to the best
            return values["latent"].sum() * float("nan")
        mine = models.draper.drape(garment, posed).vertices[0]
        contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
        loss = self.distance(mine, garment.mesh.faces, self.reach)
        loss = loss + s.contact * depth_penalty(contact.signed_distance(mine), s.clearance)
        loss = loss + s.mahalanobis * self.prior.energy(values["latent"])
        loss = loss + s.neighbourhood * self.known.energy(values["latent"])
        return loss + s.body * self.on_body.of(values, contact)


def retrieve(
    name: str, values: dict[str, Tensor], outer: list[Layer], scan: Scan, models: Models, settings: ScanGarmentFit, tick
) -> Tensor:
    """(n,) codes by their draped distance to the garment's points, best first."""
    decoder, reach = models.decoders[name], settings.levels[0][0]
    distance = TwoWay(scan, name, tuple(layer.name for layer in outer), settings.points // 3)
    posed = models.body.pose(to_body(values))

    def score(index: int) -> float:
        garment = decoder.decode(decoder.codes[index], settings.retrieval_resolution)
        x = models.draper.drape(garment, posed).vertices[0]
        return 1 - float(distance(x, garment.mesh.faces, reach)) / 2

    with torch.no_grad():
        allowed = of_variants(decoder.variants, models.variants[name])
        return retrieved(decoder.codes, allowed, score, settings.retrieval_round, tick)


def fit_scan_garment(
    name: str,
    values: dict[str, Tensor],
    outer: list[Layer],
    scan: Scan,
    models: Models,
    settings: ScanGarmentFit,
    tick: Callable[[int, float], None] | None = None,
) -> tuple[dict[str, Tensor], Layer]:
    """Find the code of one garment; the body settles with it.

    Args:
        name: the garment, one of ``scan.names``.
        values: the body as ``fit_scan_body`` returns it.
        outer: the layers outside, outermost first.

    Returns:
        The settled body, and the layer.
    """
    decoder = models.decoders[name]
    scale = decoder.codes.std(0).mean().item()
    sizes = {k: v * settings.body_rate for k, v in PARAMETERS.items()} | {"latent": settings.latent_rate * scale}
    starts = retrieve(name, values, outer, scan, models, settings, tick)[: settings.starts]
    best: Descended | None = None
    for number, (_, _, steps) in enumerate(settings.levels):
        loss = ScanGarmentLoss(name, outer, scan, models, settings, number)
        plan = replace(settings.descent, steps=steps, rate=0.6**number)
        tries = [{**values, "latent": decoder.codes[i]} for i in starts] if best is None else [best.values]
        ends = [descend(t, sizes, loss, plan, tick) for t in tries]
        best = min(ends, key=lambda e: e.loss)
    assert best is not None, "a fit needs at least one level"
    found = {k: best.values[k] for k in PARAMETERS}
    with torch.no_grad():
        garment = decoder.decode(best.values["latent"], settings.final_resolution)
    return found, Layer(name, garment)
