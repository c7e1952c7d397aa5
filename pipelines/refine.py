"""Stage 'refine': the fitted layers become cloth, at rest on the body and under the photo's silhouettes.

The panels are graded to the person's shape, the garments put on in the T pose and carried into the photo's by
simulation; then free vertices minimise StVK, bending, gravity and contact (DrapeNet Eq. 15) together with the labels'
overlap, all layers at once. In between the panels are graded again, to the cloth as the photo shows it. Last, what
passes through itself or another layer is drawn apart; where that fails layers are led, clean, from the T pose to their
places. Ends with no vertex and no face centre inside the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from pipelines.evidence import Level, level
from pipelines.fit_body import to_body, to_camera
from pipelines.fit_garment import Layer, Models, photo_size, scene_images
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, Fabric
from recon.cloth.intersections import Crossings
from recon.cloth.layers import LayeredCloth
from recon.cloth.solve import PolishSettings, lbfgs
from recon.cloth.stack import Stack
from recon.cloth.untangle import Untangling, untangle
from recon.draping.apart import FINELY, followed
from recon.draping.dress import Dressing, dress, dressed, limits_of, neutral
from recon.garments.grading import grade
from recon.losses import soft_iou_loss
from recon.types import Camera, Garment, Mesh, Photo, PosedBody, to_device


@dataclass(frozen=True)
class Refinement:
    """Settings of the refine stage."""

    dressing: Dressing = field(default_factory=Dressing)
    """How the garments are put on and carried into the pose."""
    gradings: int = 2
    """How often the panels are graded anew to the cloth as the photo shows it."""
    settle: int = 30
    """Minimisation steps of physics alone, at the start and after the panels were graded anew."""
    rounds: int = 1
    """Rounds of minimisation with the silhouettes after that; contacts are searched anew in each."""
    steps: int = 30
    """Minimisation steps per round."""
    long_side: int = 288
    """Resolution of the silhouettes."""
    evidence: float = 60.0
    """Energy of a whole garment's overlap lost [J]: what the cloth would pay for it in strain."""
    stretch: float = 30.0
    """Factor on the fabric's membrane stiffness: ready-to-wear cloth hardly stretches."""
    bend: float = 20.0
    """Factor on its bending stiffness: folds as wide as the mesh can show."""
    reach: float = 0.06
    """Body and layers are in each other's way within this distance [m]."""
    margin: float = 5e-4
    """Distance from the body that every vertex and face centre ends with [m]."""
    untangling: int = 30
    """Most rounds of drawing apart what passes through itself or another layer; 0 = without."""
    leading: int = 10
    """Frames from where the garments were dressed to where they end, for layers that are led there instead."""


@dataclass(frozen=True)
class Refined:
    """Where the stage ends."""

    layers: list[Layer]
    """The garments with their panels graded to the person, outermost first."""
    meshes: dict[str, Mesh]
    """Name -> posed mesh (V, 3), faces as in the layer's garment."""


def push_out(x: Tensor, faces: Tensor, contact: BodyContact, margin: float, rounds: int = 400) -> Tensor:
    """Move vertices along the distance's gradient until no vertex and no face centre is nearer than ``margin``.

    Where the body closes in from both sides there may be no such place: then the margin shrinks and steps grow.
    """
    x = x.detach().clone()
    for k in range(rounds):
        late = max(0.0, (2 * k - rounds) / rounds)
        points = torch.cat([x, x[faces].mean(1)]).requires_grad_()
        distance = contact.signed_distance(points)
        (normal,) = torch.autograd.grad(distance.sum(), points)
        lack = F.relu(margin * (1 - 0.98 * late) - distance.detach())
        if lack.max() <= 0:
            break
        move = lack[:, None] * F.normalize(normal, dim=1)
        n, corners = len(x), faces.reshape(-1)
        pushed = (lack[n:] > 0).to(x.dtype).repeat_interleave(3)
        count = torch.zeros(n, dtype=x.dtype, device=x.device).index_add_(0, corners, pushed)
        by_faces = torch.zeros_like(x).index_add_(0, corners, move[n:].repeat_interleave(3, 0))
        by_faces = by_faces / count.clamp_min(1)[:, None]
        own = (lack[:n] > by_faces.norm(dim=1))[:, None]
        x = x + torch.where(own, move[:n], by_faces) * (1.05 + 4 * late)
    return x


Evidence = Callable[[list[NDArray]], tuple[float, NDArray]]
"""Vertices (V, 3) of each layer -> energy [J] and its gradient [N], stacked."""


class Silhouettes:
    """The silhouettes' overlap of stacked layers as an energy: value [J] and gradient [N]."""

    def __init__(self, posed: PosedBody, faces: list[Tensor], at: Level, camera: Camera, models: Models, weight: float):
        """``faces`` of each layer in the order of ``at``'s names; ``weight`` [J] per garment's overlap."""
        self.posed, self.faces, self.at, self.camera, self.models = posed, faces, at, camera, models
        self.weight = weight

    def __call__(self, parts: list[NDArray]) -> tuple[float, NDArray]:
        """Vertices (V, 3) of each layer -> energy and its gradient, stacked."""
        xs = [torch.from_numpy(p).to(self.at.targets).requires_grad_() for p in parts]
        with torch.enable_grad():
            image = scene_images(self.posed, list(zip(xs, self.faces)), self.camera, self.at.size, self.models)
            loss = self.weight * soft_iou_loss(image, self.at.targets, self.at.weight).sum()
            gradients = torch.autograd.grad(loss, xs)
        return loss.item(), np.concatenate([g.cpu().double().numpy() for g in gradients])


def graded(layers: list[Layer], values: dict[str, Tensor], models: Models) -> list[Layer]:
    """The layers with panels that fit the person's shape, and where their codes put them in the pose; on the CPU."""
    unposed, posed = models.body.pose(neutral(to_body(values))), models.body.pose(to_body(values))
    cut = []
    for layer in layers:
        worn = models.skinning.drape(layer.garment, unposed).vertices[0]
        coded = models.draper.drape(layer.garment, posed).vertices[0]
        cut.append(replace(layer, garment=grade(layer.garment, worn), coded=coded))
    return [to_device(layer, torch.device("cpu")) for layer in cut]


def cloth_of(garments: list[Garment], body: BodyContact, settings: Refinement) -> LayeredCloth:
    """The physics of garments on the CPU, outermost first."""
    fabric = Fabric().scaled(stretch=settings.stretch, bending=settings.bend)
    cloths = [Cloth.from_garment(replace(g, panel_points=g.panel_points.double()), fabric) for g in garments]
    contacts = PolishSettings(reach=settings.reach, apart=0.5)
    return LayeredCloth(cloths, [limits_of(g) for g in garments], body, contacts)


def match(
    parts: list[NDArray],
    garments: list[Garment],
    body: BodyContact,
    evidence: Evidence,
    settings: Refinement,
    tick: Callable[[int, float], None],
) -> list[NDArray]:
    """Minimise physics alone, then physics and evidence together, from the vertices (V, 3) of each layer."""
    physics, x = cloth_of(garments, body, settings), np.concatenate(parts)

    def total(x: NDArray) -> tuple[float, NDArray]:
        value, gradient = physics(x)
        more, pull = evidence(physics.split(x))
        return value + more, gradient + pull

    physics.hold(x)
    physics.touch(x)
    x = lbfgs(physics, x, settings.settle, precondition=physics.preconditioner())
    for number in range(settings.rounds):
        physics.touch(x)
        x = lbfgs(total, x, settings.steps, precondition=physics.preconditioner())
        tick(number, physics(x)[0])
    return physics.split(x)


def refine(
    values: dict[str, Tensor],
    layers: list[Layer],
    photo: Photo,
    models: Models,
    settings: Refinement,
    tick: Callable[[int, float], None] | None = None,
) -> Refined:
    """Refine all layers together under the photo's silhouettes.

    Args:
        values: body and camera of the last garment's stage.
        layers: outermost first, all with names in ``photo.garments``.
        photo: the evidence.
        models: body, draper, renderer.
        settings: see :class:`Refinement`.
        tick: hears (step, energy).
    """

    def silhouettes(posed: PosedBody, faces: list[Tensor]) -> Evidence:
        at = level(photo, settings.long_side).pick(tuple(layer.name for layer in layers))
        camera = at.camera(to_camera({k: v.detach() for k, v in values.items()}, photo_size(photo)))
        return Silhouettes(posed, faces, at, camera, models, settings.evidence)

    return refine_with(silhouettes, values, layers, models, settings, tick)


def refine_with(
    evidence_of: Callable[[PosedBody, list[Tensor]], Evidence],
    values: dict[str, Tensor],
    layers: list[Layer],
    models: Models,
    settings: Refinement,
    tick: Callable[[int, float], None] | None = None,
) -> Refined:
    """Refine all layers together under physics and any evidence.

    Args:
        evidence_of: posed body and faces (F, 3) of each layer -> the evidence as an energy of the layers' vertices.
        values: the body's parameters (and the camera's).
        layers: outermost first.
        models: body and draper.
        settings: see :class:`Refinement`.
        tick: hears (step, energy).

    Returns:
        The layers with graded panels, and their posed meshes: no vertex or face centre is inside the body.
    """
    tick = tick or (lambda step, energy: None)
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        layers = graded(layers, values, models)
    garments = [layer.garment for layer in layers]
    pose = to_body(values)
    parts = dress(garments, models.body, pose, models.skinning, settings.dressing, tick)
    device, faces = posed.mesh.vertices.device, [g.mesh.faces.to(posed.mesh.vertices.device) for g in garments]
    body = BodyContact(posed.mesh.vertices[0].cpu(), models.body.faces.cpu())
    evidence = evidence_of(posed, faces)
    parts = match(parts, garments, body, evidence, settings, tick)
    for _ in range(settings.gradings):  # what is strained under the evidence was cut too short or too wide
        garments = [grade(g, torch.from_numpy(part)) for g, part in zip(garments, parts)]
        parts = match(parts, garments, body, evidence, settings, tick)
    layers = [replace(layer, garment=g) for layer, g in zip(layers, garments)]

    def led() -> list[NDArray] | None:
        way = dressed(garments, models.body, pose, models.skinning, replace(FINELY, creases=False))
        return followed(way.then(parts, settings.leading), garments, models.body)

    meshes = drawn_apart(parts, [g.mesh.faces for g in garments], body, settings, led)
    named = {layer.name: Mesh(m.vertices.to(device), f) for layer, m, f in zip(layers, meshes, faces)}
    return Refined([to_device(layer, device) for layer in layers], named)


def drawn_apart(
    parts: list[NDArray],
    faces: list[Tensor],
    body: BodyContact,
    settings: Refinement,
    led: Callable[[], list[NDArray] | None],
) -> list[Mesh]:
    """The layers (V, 3) out of the body, and out of each other as far as there is room; on the CPU.

    ``led``: the same layers, come to their places without crossing anything, if they can; asked where untangling fails.
    """
    worn, how = Mesh(body.vertices, body.faces), Untangling(rounds=settings.untangling, body=settings.margin)

    def out(layers: Sequence[NDArray]) -> list[Mesh]:
        xs = [torch.from_numpy(x).float() for x in layers]
        return [Mesh(push_out(x, f, body, settings.margin), f) for x, f in zip(xs, faces)]

    def crossing(meshes: list[Mesh]) -> int:
        stack = Stack.of(meshes)
        return len(Crossings(stack.faces, len(stack.x))(stack.x))

    meshes = out(untangle(out(parts), worn, how).vertices)
    if settings.untangling and crossing(meshes) and (way := led()) is not None:
        meshes = min(meshes, out(untangle(out(way), worn, how).vertices), key=crossing)
    return meshes
