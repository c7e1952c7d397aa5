"""Stage 'refine': the fitted layers' vertices move freely under cloth physics and the photo's silhouettes.

DrapeNet Eq. 15 (strain, bending, gravity, collision) with the label overlap kept as evidence; layers push each other in
their order; ends with no vertex and no face centre inside the body.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from pipelines.evidence import level
from pipelines.fit_body import to_body, to_camera
from pipelines.fit_garment import Layer, Models, photo_size, scene_images
from recon.cloth.contact import BodyContact
from recon.cloth.energies import GRAVITY, Cloth, bending, gravity, stvk
from recon.cloth.smooth import SmoothCoordinates
from recon.descend import Descent, descend
from recon.losses import soft_iou_loss
from recon.types import Mesh, Photo


@dataclass(frozen=True)
class Refinement:
    """Settings of the refine stage; weights are unitless."""

    settle: Descent = field(default_factory=lambda: Descent(steps=80, patience=80, final=0.3))
    """First descent: physics alone, which takes out what skinning stretched."""
    match: Descent = field(default_factory=lambda: Descent(steps=90, patience=30, final=0.15))
    """Second descent: physics and silhouettes."""
    long_side: int = 288
    """Resolution of the silhouettes."""
    evidence: float = 1.0
    """Weight of the labels' overlap loss."""
    strain: float = 0.1
    """Weight of StVK energy per area, in units of the energy density at 5 % stretch."""
    bend: float = 2.0
    """Weight of bending energy per area, in the same unit."""
    weight: float = 0.05
    """Weight of the height of the centre of mass (gravity), in metres of drop."""
    contact: float = 1.0
    """Weight of missing clearance to the body and to the layer beneath."""
    clearance: float = 0.004
    """Wanted clearance between cloth and body, and between layers [m]."""
    hold: float = 1.0
    """Weight that holds waist borders where they were draped, in units of 1 cm."""
    step: float = 0.002
    """Step size of the free vertices [m]."""
    stiffness: float = 15.0
    """Width of one step's neighbourhood (see SmoothCoordinates)."""


@dataclass(frozen=True)
class Piece:
    """One layer made ready for physics."""

    layer: Layer
    cloth: Cloth
    smooth: SmoothCoordinates
    held: Tensor
    """(n,) indices of vertices on a waist border."""
    start: Tensor
    """(V, 3) draped vertices before refinement [m]."""


def waist(layer: Layer) -> Tensor:
    """Vertices of borders that are named a waist: what keeps trousers and skirts from falling."""
    garment = layer.garment
    names = [i for i, n in enumerate(garment.seam_names) if "waist" in n]
    on = torch.isin(garment.border_labels, torch.tensor(names, dtype=garment.border_labels.dtype))
    return torch.unique(garment.vertex_of_point[on])


def make_piece(layer: Layer, draped: Tensor, settings: Refinement) -> Piece:
    """Physics of one layer with its panels as the rest shape."""
    faces = layer.garment.mesh.faces
    smooth = SmoothCoordinates(faces, len(draped), settings.stiffness)
    return Piece(layer, Cloth.from_garment(layer.garment), smooth, waist(layer), draped)


def physics_loss(piece: Piece, x: Tensor, settings: Refinement) -> Tensor:
    """Strain, bending, gravity and the held waist of one layer, each per garment and unitless."""
    fabric = piece.cloth.fabric
    unit = piece.cloth.areas.sum() * fabric.thickness * (fabric.lame_mu + 0.5 * fabric.lame_lambda) * 0.05**2
    loss = settings.strain * stvk(piece.cloth, x) / unit + settings.bend * bending(piece.cloth, x) / unit
    fall = gravity(piece.cloth, x - piece.start) / (GRAVITY * piece.cloth.masses.sum())
    loss = loss + settings.weight * fall
    if len(piece.held):
        drift = (x[piece.held] - piece.start[piece.held]) / 0.01
        loss = loss + settings.hold * drift.square().sum(1).mean()
    return loss


def clearance_loss(contact: BodyContact, x: Tensor, faces: Tensor, margin: float) -> Tensor:
    """Missing clearance of vertices and face centres, mean square in units of the margin, times ten."""
    points = torch.cat([x, x[faces].mean(1)])
    lack = F.relu(margin - contact.signed_distance(points)) / margin
    return lack.square().mean() * 10


def layer_loss(outer: Tensor, inner: Tensor, inner_faces: Tensor, margin: float) -> Tensor:
    """Outer vertices must stay on the outside of the inner layer, where it lies within 4 cm of them."""
    contact = BodyContact(inner, inner_faces)
    gap = contact.signed_distance(outer)
    near = gap > -0.04
    lack = F.relu(margin - gap) / margin
    return torch.where(near, lack, torch.zeros_like(lack)).square().mean() * 10


def push_out(x: Tensor, faces: Tensor, contact: BodyContact, margin: float, rounds: int = 60) -> Tensor:
    """Move vertices along the distance's gradient until no vertex and no face centre is nearer than ``margin``."""
    x = x.detach().clone()
    for _ in range(rounds):
        points = torch.cat([x, x[faces].mean(1)]).requires_grad_()
        distance = contact.signed_distance(points)
        (normal,) = torch.autograd.grad(distance.sum(), points)
        lack = F.relu(margin - distance.detach())
        if lack.max() <= 0:
            break
        move = lack[:, None] * F.normalize(normal, dim=1)
        n = len(x)
        of_faces = torch.zeros_like(x)
        of_faces.index_reduce_(0, faces.reshape(-1), move[n:].repeat_interleave(3, 0), "amax", include_self=True)
        low = torch.zeros_like(x).index_reduce_(
            0, faces.reshape(-1), move[n:].repeat_interleave(3, 0), "amin", include_self=True
        )
        spread = torch.where(of_faces.abs() > low.abs(), of_faces, low)
        x = x + torch.where(move[:n].abs() > spread.abs(), move[:n], spread) * 1.05
    return x


def refine(
    values: dict[str, Tensor], layers: list[Layer], photo: Photo, models: Models, settings: Refinement, tick=None
) -> dict[str, Mesh]:
    """Refine all layers together.

    Args:
        values: body and camera of the last garment's stage.
        layers: outermost first, all with names in ``photo.garments``.

    Returns:
        Name -> posed mesh (V, 3), faces as in the layer's garment; no vertex or face centre inside the body.
    """
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        draped = [models.draper.drape(layer.garment, posed).vertices[0] for layer in layers]
    contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
    pieces = [make_piece(layer, x, settings) for layer, x in zip(layers, draped)]
    at = level(photo, settings.long_side).pick(tuple(layer.name for layer in layers))
    camera = at.camera(to_camera(values, photo_size(photo)))

    def positions(free: dict[str, Tensor]) -> list[Tensor]:
        return [p.smooth.decode(free[p.layer.name]) for p in pieces]

    def physics(free: dict[str, Tensor]) -> Tensor:
        xs = positions(free)
        loss = xs[0].new_zeros(())
        for k, (piece, x) in enumerate(zip(pieces, xs)):
            faces = piece.layer.garment.mesh.faces
            loss = loss + physics_loss(piece, x, settings)
            loss = loss + settings.contact * clearance_loss(contact, x, faces, settings.clearance)
            for inner, y in zip(pieces[k + 1 :], xs[k + 1 :]):
                inner_faces = inner.layer.garment.mesh.faces
                loss = loss + settings.contact * layer_loss(x, y.detach(), inner_faces, settings.clearance)
        return loss

    def with_evidence(free: dict[str, Tensor]) -> Tensor:
        xs = positions(free)
        scene = [(x, p.layer.garment.mesh.faces) for x, p in zip(xs, pieces)]
        image = scene_images(posed, scene, camera, at.size, models)
        return physics(free) + settings.evidence * soft_iou_loss(image, at.targets, at.weight).sum()

    free = {p.layer.name: p.smooth.encode(p.start) for p in pieces}
    sizes = dict.fromkeys(free, settings.step)
    free = descend(free, sizes, physics, settings.settle, tick).values
    free = descend(free, sizes, with_evidence, settings.match, tick).values
    ends = {}
    with torch.no_grad():
        xs = positions(free)
    for piece, x in zip(pieces, xs):
        faces = piece.layer.garment.mesh.faces
        ends[piece.layer.name] = Mesh(push_out(x, faces, contact, 5e-4), faces)
    return ends
