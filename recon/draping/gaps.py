"""GAPS: a recurrent network drapes one garment on a moving body, frame after frame (GAPS §4.1, Eq. 8).

The garment at rest follows the body by geometry-aware skinning; the network adds displacements in the unposed space,
from pose, shape and the root's motion. What the network sees does not depend on where the person stands or faces:
gravity and velocities are given in the pelvis' own frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import eigsh
from torch import Tensor, nn

from recon.bodies import Body
from recon.bodies.rig import rotation_matrices
from recon.bodies.skin import shaped, skin
from recon.cloth.edges import EdgeProjection
from recon.cloth.energies import Cloth
from recon.cloth.projective import Projecting, Projective
from recon.draping.binding import METHODS, BodyField, cloth_operators
from recon.draping.dress import held_vertices
from recon.draping.frame import FrameRig, one_thread
from recon.files.weights import read_weights
from recon.types import TWO_PANELS, BodyPose, Garment, Mesh, PosedBody, UserError

FEATURES = 23 * 6 + 3 + 3 + 3
"""Numbers per frame: joints 1..23 as two columns of their rotations, gravity, velocity and turning of the pelvis."""
SPEED = 0.3
"""Factor that brings velocities [m/s, rad/s] to about one."""
PANELS = ("panel_faces", "panel_of_face", "vertex_of_point", "border_labels")
"""Index tensors of a garment's panels, as stored."""
COARSE = 150.0
"""Laplacian eigenvalue [1/m²] of waves half a metre long: as smooth as cloth on a body mostly is."""
WARM_UP = 24
"""Frames for which the first pose is held before a motion starts: the hidden state settles."""


@dataclass(frozen=True)
class GapsShape:
    """What is needed to rebuild the network."""

    vertices: int
    n_shape: int
    width: int = 256
    layers: int = 4
    scale: float = 0.05
    """Displacement [m] that an output of one means."""
    rank: int = 0
    """Drapes that the last layer mixes; 0 = displacements straight from the states."""
    edge_rounds: int = 0
    """Rounds of edge projection (:mod:`recon.cloth.edges`) that end the network, on the posed garment."""


class GapsNet(nn.Module):
    """R of Eq. 8: GRU layers with tanh, then displacements of all vertices."""

    basis: Tensor | None

    def __init__(self, shape: GapsShape, basis: Tensor | None = None):
        """``basis`` (V, M), for learning: the network gives coefficients of these columns; see :func:`smooth_basis`."""
        super().__init__()
        self.shape = shape
        self.register_buffer("basis", basis, persistent=False)
        self.gru = nn.GRU(FEATURES + shape.n_shape, shape.width, shape.layers, batch_first=True)
        self.few = nn.Linear(shape.width, shape.rank) if shape.rank else nn.Identity()
        self.out = nn.Linear(shape.rank or shape.width, 3 * (shape.vertices if basis is None else basis.shape[1]))
        nn.init.normal_(self.out.weight, 0.0, 0.01)
        nn.init.zeros_(self.out.bias)

    def remember(self, features: Tensor, shape: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Features (B, T, FEATURES), shape (B, S), hidden (L, B, W) -> states (B, T, W), hidden after them."""
        both = torch.cat([features, shape[:, None].expand(-1, features.shape[1], -1)], -1)
        return self.gru(both, hidden)

    def forward(self, features: Tensor, shape: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As ``remember`` -> displacements (B, T, V, 3) [m], hidden."""
        states, hidden = self.remember(features, shape, hidden)
        return self.displaced(states), hidden

    def displaced(self, states: Tensor) -> Tensor:
        """States (B, T, W) -> displacements (B, T, V, 3) [m]."""
        moved = self.out(self.few(states)).unflatten(-1, (-1, 3))
        return self.shape.scale * (moved if self.basis is None else self.basis @ moved)

    @torch.no_grad()
    def take_over(self, folded: GapsNet) -> None:
        """Become the function of a network without a basis, as near as this one's basis comes to it; of any drapes."""
        self.gru.load_state_dict(folded.gru.state_dict())
        weight, bias = folded.out.weight.detach(), folded.out.bias.detach()
        if isinstance(folded.few, nn.Linear):
            weight, bias = weight @ folded.few.weight, bias + weight @ folded.few.bias
        if self.basis is None:
            self.out.weight.copy_(weight)
            self.out.bias.copy_(bias)
            return
        columns = torch.cat([weight, bias[:, None]], 1).unflatten(0, (-1, 3)).flatten(1)
        found = torch.linalg.lstsq(self.basis, columns).solution.unflatten(1, (3, -1)).flatten(0, 1)
        self.out.weight.copy_(found[:, :-1])
        self.out.bias.copy_(found[:, -1])

    def folded(self) -> GapsNet:
        """The same function without a basis: its columns are multiplied into the last layer."""
        if self.basis is None:
            return self
        net = GapsNet(self.shape)
        net.gru.load_state_dict(self.gru.state_dict())
        net.few.load_state_dict(self.few.state_dict())
        with torch.no_grad():
            weight = torch.einsum("vm,mdw->vdw", self.basis, self.out.weight.unflatten(0, (-1, 3)))
            net.out.weight.copy_(weight.flatten(0, 1))
            net.out.bias.copy_((self.basis @ self.out.bias.unflatten(0, (-1, 3))).flatten())
        return net


def smooth_basis(vertices: Tensor, faces: Tensor, count: int) -> Tensor:
    """(V, M) the ``count`` smoothest functions on a mesh, eigenvectors of its Laplacian, fine ones scaled down.

    Stretching costs a mode its eigenvalue: divided by the root of it, all coefficients are about as stiff, and learning
    is no longer slowed down by single vertices. Constant modes keep size one.
    """
    x, f = vertices.detach().cpu().double().numpy(), faces.cpu().numpy()
    stiffness, mass = cloth_operators(x, f, np.ones(len(f)))
    count = min(count, len(x) - 2)
    start = np.random.default_rng(0).standard_normal(len(x))
    values, modes = eigsh(stiffness, count, sp.diags(mass), sigma=-1e-3, v0=start)
    modes = modes * np.sqrt(mass.sum())
    return torch.as_tensor(modes / np.sqrt(1 + np.maximum(values, 0) / COARSE)).float()


def motion_features(
    pose: Tensor, translation: Tensor, fps: float, before: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """What the network sees of a motion: (B, T, FEATURES).

    Args:
        pose: (B, T, 24, 3) [rad].
        translation: (B, T, 3) [m].
        fps: frames per second.
        before: pose (B, 24, 3) and translation (B, 3) of the frame before the first; without, the first stands still.
    """
    earlier = None if before is None else (rotation_matrices(before[0][:, 0]), before[1])
    return features_of(rotation_matrices(pose), translation, fps, earlier)


def features_of(
    rotations: Tensor, translation: Tensor, fps: float, before: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """The same from local rotations (B, T, 24, 3, 3); ``before``: the pelvis' rotation (B, 3, 3) and place (B, 3)."""
    world, joints = rotations[:, :, 0], rotations[:, :, 1:, :, :2].flatten(-3)
    turned, earlier = world[:, :1], translation[:, :1]
    if before is not None:
        turned, earlier = before[0][:, None], before[1][:, None]
    if world.shape[1] > 1:
        turned, earlier = torch.cat([turned, world[:, :-1]], 1), torch.cat([earlier, translation[:, :-1]], 1)
    to_own = world.transpose(-1, -2)
    velocity = (to_own @ ((translation - earlier) * (fps * SPEED))[..., None])[..., 0]
    turn = to_own @ turned  # from this frame's axes to the last one's
    skew = (turn.transpose(-1, -2) - turn).flatten(-2)[..., [7, 2, 3]]  # entries (2, 1), (0, 2), (1, 0)
    return torch.cat([joints, to_own[..., 1], velocity, skew * (fps * SPEED / 2)], -1)


@dataclass(frozen=True)
class Bound:
    """A garment bound to a body: skinning weights and shape directions of its vertices."""

    rest: Tensor
    """(V, 3) template [m]."""
    weights: Tensor
    """(V, 24)."""
    directions: Tensor
    """(V, 3, S)."""

    @classmethod
    def of(cls, garment_vertices: Tensor, faces: Tensor, body, method: str = "rbf") -> Bound:
        """Bind template vertices (V, 3) by one of ``binding.METHODS``."""
        found = METHODS[method](BodyField.of(body), garment_vertices, faces)
        weights = found[:, :24] / found[:, :24].sum(1, keepdim=True)
        return cls(garment_vertices, weights, found[:, 24:].contiguous().unflatten(1, (3, -1)))

    def place(self, moved: Tensor, transforms: Tensor, shape: Tensor) -> Tensor:
        """Displacements (B, V, 3), joint transforms (B, 24, 4, 4), shapes (B, S) -> posed vertices (B, V, 3)."""
        return skin(self.shaped(shape) + moved, transforms, self.weights)

    def shaped(self, shape: Tensor) -> Tensor:
        """The template as wide as bodies of shape (B, S): (B, V, 3) [m]."""
        return shaped(self.rest, self.directions, shape)


class GapsDraper:
    """Drapes the garment that it was trained on over any motion and shape."""

    def __init__(self, net: GapsNet, garment: Garment | Mesh, bound: Bound, projective: Projective | None = None):
        """``garment``: the template, a mesh where it has no panels; ``projective``: steps after the network, if any."""
        self.net = net.eval().requires_grad_(False)
        last = self.net.out  # by columns in memory: one frame's product takes half the time
        last.weight = nn.Parameter(last.weight.T.contiguous().T, requires_grad=False)
        self.garment, self.bound = garment, bound
        self.edges = template_edges(garment, net.shape.edge_rounds)
        self.projective = projective

    @torch.no_grad()
    def animate(self, body: PosedBody, pose: BodyPose, fps: float) -> Tensor:
        """All frames of one motion at once: (F, V, 3) [m]. ``body``: the F posed bodies of ``pose``."""
        features = motion_features(pose.pose[None], pose.translation[None], fps)
        moved, _ = self.net(features, pose.shape[:1], self._warm(features[:, :1], pose.shape[:1]))
        drapes = self.edges(self.bound.place(moved[0], body.transforms, pose.shape))
        return self.projective(drapes, body) if self.projective else drapes

    @torch.no_grad()
    def stream(self, frames: Iterable[BodyPose], body: Body, fps: float) -> Iterator[Tensor]:
        """One frame after another, each (1, V, 3) [m], as they come.

        Of the body only its skeleton is posed, unless projective steps need its skin.
        """
        rig: FrameRig | None = None
        hidden, shape, rest = None, torch.empty(0), torch.empty(0)
        for pose in frames:
            if rig is None or not torch.equal(pose.shape, shape):
                shape, rest = pose.shape, self.bound.shaped(pose.shape)
                rig = FrameRig(body.rest_joints(shape)[0], body.parents, SPEED, rig)
            with one_thread():
                features = rig(pose.pose[0], pose.translation[0], fps).to(rest)[None, None]
                if hidden is None:
                    hidden = self._warm(features, shape)
                moved, hidden = self.net(features, shape, hidden)
                drape = self.edges(skin(rest + moved[0], rig.transforms.to(rest), self.bound.weights))
            yield self.projective(drape, body.pose(pose)) if self.projective else drape

    def _warm(self, first: Tensor, shape: Tensor) -> Tensor:
        """The hidden state of a body that has stood still in its first pose."""
        still = first.clone()
        still[..., -6:] = 0
        return self.net.remember(still.expand(-1, WARM_UP, -1), shape)[1]


def template_edges(garment: Garment | Mesh, rounds: int) -> EdgeProjection:
    """The rounds that end the network: lengths are the template's, as in Eq. 15; a waistband stays."""
    mesh = garment.mesh if isinstance(garment, Garment) else garment
    return EdgeProjection.of(Cloth.from_mesh(mesh), rounds, torch.as_tensor(held_vertices(garment)))


def load_gaps(name: str, body, folder: str | Path | None = None, projecting: Projecting | None = None) -> GapsDraper:
    """The draper called ``gaps-NAME`` from ``folder``, or else from the packaged weights, for a body.

    ``projecting``: projective steps after the network; None = the network alone.

    Raises:
        UserError: weights missing or corrupt, or not those of such a network.
    """
    weights = read_weights(f"gaps-{name}", folder)
    try:
        return build(weights.tensors, weights.card, body, projecting)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"gaps-{name}: weights and card don't describe a GAPS network ({error})") from error


def build(tensors: dict[str, Tensor], card: dict, body, projecting: Projecting | None = None) -> GapsDraper:
    """A draper from its stored parts: the network's parameters and ``garment.*``."""
    net = GapsNet(GapsShape(**card["shape"]))
    net.load_state_dict({k[4:]: v.float() for k, v in tensors.items() if k.startswith("net.")})
    mesh = Mesh(tensors["garment.vertices"].float(), tensors["garment.faces"].long())
    thing: Garment | Mesh = mesh
    if "kind" in card:
        panels = {name: tensors[f"garment.{name}"].long() for name in PANELS}
        thing = Garment(
            card["kind"],
            mesh,
            panel_points=tensors["garment.panel_points"].float(),
            seam_names=tuple(card["seam_names"]),
            variant=card["variant"],
            panel_names=tuple(card.get("panel_names", TWO_PANELS)),
            panel_faces=panels["panel_faces"],
            panel_of_face=panels["panel_of_face"],
            vertex_of_point=panels["vertex_of_point"],
            border_labels=panels["border_labels"],
        )
    bound = Bound.of(mesh.vertices, mesh.faces, body, card["skinning"])
    if projecting is None or not projecting.steps:
        return GapsDraper(net, thing, bound)
    # The lengths to keep are the template's, as in Eq. 15.
    steps = Projective(Cloth.from_mesh(mesh), bound.weights, held_vertices(thing), projecting)
    return GapsDraper(net, thing, bound, steps)
