"""Layers that pass through nothing: networks' drapes untangled, or where that fails the same outfit dressed anew.

Networks drape each garment by itself, whatever it would have to pass through: a sleeve that they fold into a bent elbow
may leave no way out. Then a simulation starts in the T pose, where layers lie clean over each other, and carries them
into the pose; they follow it as far as nothing crosses (``follow``). The body that they end on has room in its creases
(``open_creases``): where its parts pass through each other no cloth can be outside of both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from recon.bodies import Body
from recon.bodies.creases import open_creases
from recon.cloth.follow import follow
from recon.cloth.untangle import Untangled, Untangling, untangle
from recon.draping import Draper
from recon.draping.dress import Dressing, dressed
from recon.types import BodyPose, Garment, Mesh, PosedBody

TRIES = 2
"""Ways in which drapes are untangled: what two leave tangled the others mostly do, too, and they cost more than a
simulation."""


@dataclass(frozen=True)
class Apart:
    """Where layers end."""

    layers: list[Mesh]
    """(V, 3) of each, innermost first, as they came [m]."""
    posed: PosedBody
    """What they are worn on, with room in its creases."""
    done: Untangled
    """How they were untangled."""
    before: int
    """Pairs of faces that passed through each other in the networks' drapes."""
    dressed: bool
    """Whether the outfit was dressed by simulation in the end."""


def draw_apart(
    garments: Sequence[Garment | Mesh],
    drapes: Sequence[Mesh],
    body: Body,
    pose: BodyPose,
    skinning: Draper,
    say: Callable[[str], None] = lambda line: None,
) -> Apart:
    """Drapes of one body, untangled; where anything is left, led along a simulation instead if less is left then.

    Args:
        garments: innermost first, at rest on the neutral body.
        drapes: (V, 3) of each in the pose.
        body: the body model.
        pose: one body (batch of one).
        skinning: where a simulation takes cloth.
        say: hears when a simulation begins.
    """
    posed = open_creases(body.pose(pose))
    worn = Mesh(posed.mesh.vertices[0].detach(), body.faces)
    first = untangle(drapes[::-1], worn, Untangling(tries=TRIES))
    if first.clean:
        return _ended(drapes, posed, first, first, False)
    say("what networks draped can't be untangled: dressed by simulation")
    ends = _simulated([Garment.of(g) for g in reversed(garments)], body, pose, skinning)
    again = [mesh.with_vertices(torch.from_numpy(x).to(mesh.vertices)) for mesh, x in zip(drapes, ends[::-1])]
    plain = untangle(again[::-1], worn, Untangling(tries=1, rounds=0))
    tried = plain if plain.clean else untangle(again[::-1], worn, Untangling(tries=TRIES))
    second = min(plain, tried, key=_worth)
    if _worth(second) < _worth(first):
        return _ended(again, posed, second, first, True)
    return _ended(drapes, posed, first, first, False)


def _worth(done: Untangled) -> tuple[int, int]:
    """The less the better: cloth that crosses nothing can be simulated on, even if some of it is in the body."""
    return len(done.left), done.inside


def _simulated(garments: Sequence[Garment], body: Body, pose: BodyPose, skinning: Draper) -> list[NDArray]:
    """(V, 3) of each garment, outermost first: free of crossings if they are in the T pose, else as simulated."""
    way = dressed(garments, body, pose, skinning, Dressing(creases=True))
    faces = [g.mesh.faces.cpu() for g in garments]
    begin = [Mesh(torch.from_numpy(x[0]), f) for x, f in zip(way.garments, faces)]
    start = untangle(begin, Mesh(torch.from_numpy(way.bodies[0]), body.faces))
    if len(start.left):
        return [x[-1] for x in way.garments]
    clean = [mesh.with_vertices(torch.from_numpy(x)) for mesh, x in zip(begin, start.vertices)]
    return follow(clean, np.concatenate(way.garments, 1), way.bodies, body.faces.cpu())


def _ended(layers: Sequence[Mesh], posed: PosedBody, done: Untangled, first: Untangled, dressed: bool) -> Apart:
    moved = [m.with_vertices(torch.as_tensor(x).to(m.vertices)) for m, x in zip(layers, done.vertices[::-1])]
    return Apart(moved, posed, done, first.crossings, dressed)
