"""Dressing by simulation: garments put on in the T pose and carried into the body's pose, the innermost first.

Skinning says where the cloth is taken, the simulator lets it relax on the way: folds form as the pose does, and cloth
that would be stretched or pressed through itself by skinning in one step is not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from recon.bodies import Body
from recon.bodies.creases import open_creases
from recon.cloth.constraints import Constraints
from recon.cloth.energies import Cloth
from recon.cloth.xpbd import Carry, Settings, carry
from recon.draping import Draper
from recon.garments import WAISTED
from recon.garments.panels import waistband
from recon.types import BodyPose, Garment, Mesh, to_device


@dataclass(frozen=True)
class Dressing:
    """How garments are carried into a pose."""

    frames: int = 40
    """Poses on the way from T to the wanted one."""
    steps: int = 20
    """Simulation substeps per frame."""
    bend_compliance: float = 1e-5
    """Compliance of the distances across edges: stiff enough that coarse cloth does not crumple."""
    self_distance: float = 0.6
    """Distance that parts of the cloth keep from each other, in mean edge lengths."""
    offset: float = 0.003
    """Distance kept from the body and from the layer beneath [m]."""
    friction: float = 0.05
    """Coulomb friction: little, so that cloth slips to where it is at ease, as it does while people dress."""
    creases: bool = False
    """Whether skin gives way in the creases of elbows and knees."""


def limits_of(garment: Garment | Mesh) -> Constraints:
    """What the simulator needs to know of a garment: its cloth, its waistband, and which parts are strangers.

    Strangers are told by the shape at rest on the body, where both sides of a seam are neighbours. A mesh without
    panels is its own pattern, and nothing holds it.
    """
    if isinstance(garment, Mesh):
        return Constraints.from_cloth(Cloth.from_mesh(garment), garment.vertices.detach().double().numpy())
    held, at = held_vertices(garment), garment.mesh.vertices.detach().double().numpy()
    return Constraints.from_cloth(Cloth.from_garment(garment), at, held if len(held) else None)


def held_vertices(garment: Garment | Mesh) -> NDArray:
    """(H,) vertices of the waistband that holds a garment; none where nothing is known to."""
    if isinstance(garment, Garment) and garment.kind in WAISTED:
        return waistband(garment)
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class Dressed:
    """A body on its way into a pose, and what it wears."""

    garments: list[NDArray]
    """(T, V, 3) of each, outermost first, double precision [m]."""
    bodies: NDArray
    """(T, B, 3) [m]."""
    transforms: NDArray
    """(T, 24, 4, 4) of its joints, as in ``PosedBody``."""

    def then(self, ends: Sequence[NDArray], frames: int) -> Dressed:
        """Further on to (V, 3) of each garment by frames of equal steps, while the body stays."""
        share = np.linspace(0, 1, frames + 1)[1:, None, None]
        way = [np.concatenate([x, x[-1] + share * (end - x[-1])]) for x, end in zip(self.garments, ends, strict=True)]
        still = (np.concatenate([part, np.repeat(part[-1:], frames, 0)]) for part in (self.bodies, self.transforms))
        return Dressed(way, *still)

    def later(self, frames: int) -> Dressed:
        """The same after so many frames in which nothing moves."""
        parts = [*self.garments, self.bodies, self.transforms]
        *way, bodies, transforms = (np.concatenate([np.repeat(part[:1], frames, 0), part]) for part in parts)
        return Dressed(way, bodies, transforms)


def dress(
    garments: Sequence[Garment],
    body: Body,
    pose: BodyPose,
    skinning: Draper,
    settings: Dressing | None = None,
    tick: Callable[[int, float], None] | None = None,
) -> list[NDArray]:
    """Garments worn over each other by one body, at rest in its pose: (V, 3) of each, as :func:`dressed` ends."""
    return [frames[-1] for frames in dressed(garments, body, pose, skinning, settings, tick).garments]


@torch.no_grad()
def dressed(
    garments: Sequence[Garment],
    body: Body,
    pose: BodyPose,
    skinning: Draper,
    settings: Dressing | None = None,
    tick: Callable[[int, float], None] | None = None,
) -> Dressed:
    """Garments worn over each other by one body, on the way from the T pose into its own.

    Args:
        garments: outermost first, on the CPU, with panels that fit the body's shape (``grade``).
        body: the body model.
        pose: one body (batch of one).
        skinning: where the cloth is taken without simulation.
        settings: see :class:`Dressing`.
        tick: hears (frame, 0) after each frame of each garment.
    """
    s = settings or Dressing()
    posed, device = body.pose(way_to(pose, s.frames)), pose.pose.device
    posed = open_creases(posed) if s.creases else posed
    frames, faces = posed.mesh.vertices.cpu().numpy(), body.faces.cpu().numpy()
    simulation = Settings(
        bend_compliance=s.bend_compliance, self_distance=s.self_distance, offset=s.offset, friction=s.friction
    )
    skin, worn = frames, list[NDArray]()
    for garment in reversed(garments):
        skinned = skinning.drape(to_device(garment, device), posed).vertices.double().cpu().numpy()
        own = []
        for k, x in enumerate(carry(skinned, limits_of(garment), frames, faces, simulation, Carry(steps=s.steps))):
            own.append(x)
            if tick:
                tick(k, 0.0)
        worn.append(np.stack(own))
        # What lies beneath is part of what the next garment collides with.
        faces = np.concatenate([faces, garment.mesh.faces.cpu().numpy() + frames.shape[1]])
        frames = np.concatenate([frames, worn[-1].astype(np.float32)], 1)
    return Dressed(worn[::-1], skin, posed.transforms.cpu().double().numpy())


def neutral(pose: BodyPose) -> BodyPose:
    """The same body in the T pose."""
    return replace(pose, pose=torch.zeros_like(pose.pose))


def begun(pose: BodyPose) -> BodyPose:
    """The same body in the T pose, turned and placed as it is: where the way of :func:`dressed` begins."""
    return BodyPose(*(part[:1] for part in vars(way_to(pose, 1)).values()))


def way_to(pose: BodyPose, count: int) -> BodyPose:
    """(count + 1) bodies from T (turned and placed as in the end) to the pose."""
    share = torch.linspace(0, 1, count + 1, dtype=pose.pose.dtype, device=pose.pose.device)
    joints = pose.pose * share[:, None, None]
    joints[:, 0] = pose.pose[:, 0]
    many = count + 1
    return BodyPose(pose.shape.expand(many, -1), joints, pose.translation.expand(many, -1))
