"""Stage per garment, outermost first: retrieval over the learned codes, then code, pose and camera descend together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated

import cv2
import numpy as np
import torch
import torch.nn.functional as F
import tyro
from torch import Tensor

from pipelines.codes import Decoding, retrieved
from pipelines.evidence import level
from pipelines.fit_body import BodyFit, evidence_loss, to_body, to_camera
from recon.bodies import Body
from recon.cloth.contact import BodyContact
from recon.descend import Descent, descend
from recon.draping import Draper
from recon.garments import GarmentDecoder
from recon.garments.latents import LatentPrior, Neighbourhood, of_variants
from recon.losses import chamfer_pull, depth_penalty, hard_iou, soft_iou_loss
from recon.types import Camera, Garment, Photo, PosedBody, UserError


@dataclass(frozen=True)
class GarmentFit:
    """Settings of one garment's stage; weights are unitless."""

    levels: tuple[tuple[int, int], ...] = ((112, 35), (224, 30))
    """(pixels on the longer side, most steps) from coarse to fine."""
    resolution: int = 96
    """Decoding resolution while the code descends."""
    final_resolution: int = 104
    """Decoding resolution of the garment that the stage ends with."""
    retrieval_resolution: int = 48
    """Decoding resolution of the codes that retrieval compares."""
    retrieval_pixels: int = 96
    """Longer side of retrieval's silhouettes."""
    retrieval_round: int = 60
    """Codes that retrieval's first round compares; its second compares as many neighbours of the best."""
    alike: float = 0.05
    """Beneath other garments, codes that overlap the mask less than the best by no more than this count as alike: what
    is hidden begins as in the middle of them, neither sleeveless nor long-sleeved under a jacket."""
    starts: int = 2
    """How many of the best retrieved codes get a first, coarse descent; the best goes on."""
    refresh: int = 5
    """Steps for which a garment's topology is kept while its code descends."""
    latent_rate: float = 0.06
    """Step size of the code in standard deviations of the learned codes."""
    mahalanobis: float = 0.01
    """Weight of the squared Mahalanobis distance from the mean of the codes that the name allows, per dimension."""
    neighbourhood: float = 0.02
    """Weight of the squared distance from the nearest learned codes, in units of the distance between those."""
    pull: float = 2.0
    """Weight of the distance-field pull, faded out as the overlap grows."""
    contact: float = 0.3
    """Weight of missing clearance between garment and body."""
    clearance: float = 0.004
    """Wanted clearance [m]."""
    anchor: float = 0.5
    """Weight that keeps body and camera near what the body stage found (unit: 0.1 rad, 0.02 m, 0.1 log, 0.5 shape)."""
    outer: float = 0.5
    """Weight of each outer layer's overlap, relative to this garment's."""
    body: Annotated[BodyFit, tyro.conf.Suppress] = field(default_factory=BodyFit)
    """What landmarks and priors still ask of body and camera while they settle; ``fit_evidence`` sets it."""
    descent: Descent = field(default_factory=lambda: Descent(patience=12))
    """Shared settings of the levels; ``steps`` is taken from ``levels``."""


@dataclass(frozen=True)
class Layer:
    """One fitted garment."""

    name: str
    garment: Garment
    """Rest pose, welded."""
    coded: Tensor | None = None
    """(V, 3) where code and draper alone put it on the body [m]; known from the refine stage on."""


@dataclass(frozen=True)
class Models:
    """Everything learned or measured that the stages use."""

    body: Body
    draper: Draper
    decoders: dict[str, GarmentDecoder]
    """Garment name -> decoder of its kind."""
    variants: dict[str, tuple[str, ...]]
    """Garment name -> variants of the kind that the name allows."""
    renderer_of: Callable
    """(faces, labels, n_vertices) -> label renderer."""

    @property
    def skinning(self) -> Draper:
        """What carries cloth between poses and onto other bodies: the skinning that the draper corrects, or itself."""
        return getattr(self.draper, "skinning", self.draper)


SPILL = 0.03
"""How far beyond an outer garment's mask retrieval lets an inner one be seen [of the silhouettes' longer side]."""
BODY_SIZES = {"shape": 0.01, "pose": 0.006, "translation": 0.003, "log_focal": 0.002, "pitch": 0.002}
"""Step sizes of body and camera while a code descends: they only settle."""
ANCHOR_UNITS = {"shape": 0.5, "pose": 0.1, "translation": 0.02, "log_focal": 0.1, "pitch": 0.05}


def photo_size(photo: Photo) -> tuple[int, int]:
    """(height, width) of the photo in pixels."""
    return photo.rgb.shape[0], photo.rgb.shape[1]


def silhouette(pixels: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> Tensor:
    """(h, w) bool: the union of projected triangles, without occlusion; (V, 2) pixels, (F, 3) faces."""
    image = np.zeros(size, np.uint8)
    corners = np.round(pixels[faces] * 16).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(image, triangle, 1, shift=4)
    return torch.from_numpy(image) > 0


def retrieve(
    name: str, values: dict[str, Tensor], photo: Photo, models: Models, settings: GarmentFit, tick=None
) -> Tensor:
    """(n,) codes by the overlap of their draped silhouettes with the mask, best first (see ``codes.retrieved``).

    Pixels under an outer garment's mask, and others close to it, count neither for nor against, like hair and hands.
    """
    decoder = models.decoders[name]
    with torch.no_grad():
        score = cache(_silhouette_score(name, values, photo, models, settings))
        allowed = of_variants(decoder.variants, models.variants[name])
        found = retrieved(decoder.codes, allowed, score, settings.retrieval_round, tick)
        if name == next(iter(photo.garments)):  # nothing of the outermost is hidden
            return found
        return middle_first(decoder.codes, found, torch.tensor([score(int(i)) for i in found]), settings.alike)


def hidden(outer: Tensor, own: Tensor, reach: int) -> Tensor:
    """(h, w) in [0, 1]: what masks (L, h, w) of outer garments hide of the one with mask ``own`` (h, w).

    Up to ``reach`` pixels beside them as well, but for its own mask: a sleeve that looks out beyond the jacket's by a
    little, because body and cloth are not settled yet, is no reason to leave it away.
    """
    if not len(outer):
        return torch.zeros_like(own)
    over = outer.sum(0).clamp(0, 1)
    around = F.max_pool2d(over[None], 2 * reach + 1, 1, reach)[0]
    return torch.where(own > 0.5, over, around)


def middle_first(codes: Tensor, found: Tensor, scores: Tensor, alike: float) -> Tensor:
    """Indices ``found`` (n,) of codes, best first, those within ``alike`` of the best ordered from their middle out."""
    close = scores >= scores[0] - alike
    away = (codes[found[close]] - codes[found[close]].mean(0)).norm(dim=1)
    return torch.cat([found[close][away.argsort(stable=True)], found[~close]])


def _silhouette_score(
    name: str, values: dict[str, Tensor], photo: Photo, models: Models, settings: GarmentFit
) -> Callable:
    """A function from a code's index to its silhouette's overlap with the mask."""
    at = level(photo, settings.retrieval_pixels)
    mine = at.names.index(name)
    weight = at.weight * (1 - hidden(at.targets[:mine], at.targets[mine], round(SPILL * settings.retrieval_pixels)))
    camera = at.camera(to_camera(values, photo_size(photo)))
    decoder = models.decoders[name]
    posed = models.body.pose(to_body(values))

    def score(index: int) -> float:
        garment = decoder.decode(decoder.codes[index], settings.retrieval_resolution)
        pixels = camera.project(models.draper.drape(garment, posed).vertices[0])
        drawn = silhouette(pixels.cpu().numpy(), garment.mesh.faces.cpu().numpy(), at.size)
        return float(hard_iou(drawn[None].to(at.targets), at.targets[mine][None], weight)[0])

    return score


def scene_images(
    posed: PosedBody, layers: list[tuple[Tensor, Tensor]], camera: Camera, size: tuple[int, int], models: Models
) -> Tensor:
    """(L, h, w) visible coverage of the layers ((V, 3) vertices, (F, 3) faces) over a body that only hides."""
    faces = [f for _, f in layers] + [models.body.faces]
    labels = [*range(len(layers)), -1]
    vertices = [v for v, _ in layers] + [posed.mesh.vertices[0]]
    renderer = models.renderer_of(faces, labels, [len(v) for v in vertices])
    return renderer(vertices, camera, size)


def anchor_loss(values: dict[str, Tensor], anchors: dict[str, Tensor]) -> Tensor:
    """Squared distance of body and camera from where the body stage left them, in ANCHOR_UNITS."""
    return torch.stack([((values[k] - anchors[k]) / u).square().mean() for k, u in ANCHOR_UNITS.items()]).sum()


class GarmentLoss:
    """The loss of one garment's descent at one level (ISP Eq. 11, 18-23; DrapeNet Eq. 12)."""

    def __init__(
        self, name, outer: list[Layer], anchors, photo: Photo, models: Models, settings: GarmentFit, long_side: int
    ):
        self.outer, self.anchors, self.photo, self.models, self.settings = outer, anchors, photo, models, settings
        self.decoder = models.decoders[name]
        allowed = self.decoder.codes[of_variants(self.decoder.variants, models.variants[name])]
        self.prior, self.known = LatentPrior.of(allowed), Neighbourhood.of(allowed)
        self.at = level(photo, long_side).pick((*[layer.name for layer in outer], name))
        self.decoding = Decoding(self.decoder, settings.resolution, settings.refresh)
        on = torch.nonzero(self.at.targets[-1] > 0.5)
        chosen = torch.linspace(0, max(len(on) - 1, 0), min(len(on), 400)).long()
        self.targets = on[chosen].flip(1).to(torch.float32) + 0.5

    def __call__(self, values: dict[str, Tensor]) -> Tensor:
        s, models = self.settings, self.models
        posed = models.body.pose(to_body(values))
        camera = self.at.camera(to_camera(values, photo_size(self.photo)))
        try:
            garment = self.decoding(values["latent"])
        except UserError:  # the code left what garments look like: descend goes back to the best
            return values["latent"].sum() * float("nan")
        mine = models.draper.drape(garment, posed).vertices[0]
        layers = [(models.draper.drape(o.garment, posed).vertices[0], o.garment.mesh.faces) for o in self.outer]
        image = scene_images(posed, [*layers, (mine, garment.mesh.faces)], camera, self.at.size, models)
        overlap = soft_iou_loss(image, self.at.targets, self.at.weight)
        weights = overlap.new_tensor([s.outer] * len(self.outer) + [1.0])
        gap = BodyContact(posed.mesh.vertices[0], models.body.faces).signed_distance(mine)
        loss = (weights * overlap).sum()
        loss = loss + s.pull * overlap[-1].detach() ** 2 * chamfer_pull(
            camera.project(mine), self.at.fields[-1], self.targets
        )
        loss = loss + s.contact * depth_penalty(gap, s.clearance) / 10
        loss = loss + s.mahalanobis * self.prior.energy(values["latent"])
        loss = loss + s.neighbourhood * self.known.energy(values["latent"])
        loss = loss + s.anchor * anchor_loss(values, self.anchors) / 10
        return loss + 0.1 * evidence_loss(values, posed, models.body, self.photo, s.body)


def fit_garment(
    name: str,
    values: dict[str, Tensor],
    outer: list[Layer],
    photo: Photo,
    models: Models,
    settings: GarmentFit,
    tick=None,
) -> tuple[dict[str, Tensor], Layer]:
    """Find the code of one garment; body and camera settle with it, outer layers stay as they are and stay rendered.

    Args:
        name: the garment, a key of ``photo.garments``.
        values: body and camera as ``fit_body`` returns them.
        outer: the layers outside, outermost first.

    Returns:
        The settled body and camera, and the layer.
    """
    decoder = models.decoders[name]
    scale = decoder.codes.std(0).mean().item()
    sizes = {**BODY_SIZES, "latent": settings.latent_rate * scale}
    anchors = {k: values[k] for k in ANCHOR_UNITS}
    starts = retrieve(name, values, photo, models, settings, tick)[: settings.starts]
    best = None
    for number, (long_side, steps) in enumerate(settings.levels):
        loss = GarmentLoss(name, outer, anchors, photo, models, settings, long_side)
        plan = Descent(**{**vars(settings.descent), "steps": steps, "rate": 0.5**number})
        tries = [{**values, "latent": decoder.codes[i]} for i in starts] if best is None else [best.values]
        ends = [descend(t, sizes, loss, plan, tick) for t in tries]
        best = min(ends, key=lambda e: e.loss)
    assert best is not None, "a fit needs at least one level"
    found = {k: best.values[k] for k in ANCHOR_UNITS}
    with torch.no_grad():
        garment = decoder.decode(best.values["latent"], settings.final_resolution)
    return found, Layer(name, garment)
