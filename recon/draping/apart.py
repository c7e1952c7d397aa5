"""Layers that pass through nothing: networks' drapes untangled, or where that fails the same outfit dressed anew.

Networks drape each garment by itself, whatever it would have to pass through: a sleeve that they fold into a bent elbow
may leave no way out. Then a simulation starts in the T pose, where layers lie clean over each other, and carries them
into the pose; they follow it as far as nothing crosses (``follow``). Where they don't lie clean there either they begin
in shells around each other (``nest``). The body that they end on has room in its creases
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
from recon.draping.dress import Dressed, Dressing, begun, dress, dressed
from recon.draping.nest import Shells
from recon.draping.space import Space
from recon.types import BodyPose, Garment, Mesh, PosedBody

TRIES = 2
"""Ways in which drapes are untangled: what two leave tangled the others mostly do, too, and they cost more than a
simulation."""

DRAWING_IN = 20
"""Frames in which layers that were put around each other are drawn in."""
FINELY = Dressing(frames=120, steps=7, creases=True)
"""How layers are carried that follow: the smaller a step, the less of it makes anything cross."""
THERE = 1e-3
"""Cloth this near to where a simulation has it moves as it does [m]; other cloth goes with the body."""


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
    # What only lies in the body was led out as far as nothing crosses.
    tried = untangle(again[::-1], worn, Untangling(tries=TRIES)) if len(plain.left) else plain
    second = min(plain, tried, key=_worth)
    if _worth(second) < _worth(first):
        return _ended(again, posed, second, first, True)
    return _ended(drapes, posed, first, first, False)


def _worth(done: Untangled) -> tuple[int, int]:
    """The less the better: cloth that crosses nothing can be simulated on, even if some of it is in the body."""
    return len(done.left), done.inside


def _simulated(garments: Sequence[Garment], body: Body, pose: BodyPose, skinning: Draper) -> list[NDArray]:
    """(V, 3) of each garment, outermost first: free of crossings if they are in the T pose, else as simulated."""
    way = dressed(garments, body, pose, skinning, FINELY)
    ends = followed(way, garments, body)
    if ends is None and len(garments) > 1:
        ends = followed(way.later(DRAWING_IN), garments, body, _nested(garments, way, body, pose, skinning))
    return ends or [x[-1] for x in way.garments]


def _nested(garments: Sequence[Garment], way: Dressed, body: Body, pose: BodyPose, skinning: Draper) -> list[NDArray]:
    """(V, 3) of each garment, outermost first, around each other on the body in the T pose."""
    around, shells = list[NDArray](), Shells(Mesh(torch.from_numpy(way.bodies[0]), body.faces))
    for garment in reversed(garments):
        (hung,) = dress([garment], body, begun(pose), skinning, Dressing(frames=1))
        around.append(shells.around(hung, around))
    return around[::-1]


def followed(
    way: Dressed,
    garments: Sequence[Garment],
    body: Body,
    start: Sequence[NDArray] | None = None,
) -> list[NDArray] | None:
    """Where layers get that cross nothing on the way of a simulation; None where they do in the T pose already.

    Args:
        way: as the garments were simulated, the first frame in the T pose, the steps as fine as ``FINELY``.
        garments: outermost first.
        body: the body model.
        start: (V, 3) where each begins in the T pose; as in the simulation if not given [m].

    Returns:
        (V, 3) of each garment [m].
    """
    begin, faces = start or [x[0] for x in way.garments], body.faces.cpu()
    layers = [Mesh(torch.from_numpy(x), g.mesh.faces.cpu()) for x, g in zip(begin, garments, strict=True)]
    apart = untangle(layers, Mesh(torch.from_numpy(way.bodies[0]), faces), Untangling(tries=TRIES))
    if len(apart.left):
        return None
    clean = [mesh.with_vertices(torch.from_numpy(x)) for mesh, x in zip(layers, apart.vertices)]
    goals, space = np.concatenate(way.garments, 1), Space(body, way.bodies[0], way.transforms)

    def as_simulated(k: int, x: NDArray) -> NDArray:
        there = np.linalg.norm(x - goals[k - 1], axis=1, keepdims=True) < THERE
        return np.where(there, x + goals[k] - goals[k - 1], space(k, x))

    # A simulation that is tangled from the T pose on moves layers through each other: then all go with the body.
    return follow(clean, goals, way.bodies, faces, as_simulated if start is None else space)


def _ended(layers: Sequence[Mesh], posed: PosedBody, done: Untangled, first: Untangled, dressed: bool) -> Apart:
    moved = [m.with_vertices(torch.as_tensor(x).to(m.vertices)) for m, x in zip(layers, done.vertices[::-1])]
    return Apart(moved, posed, done, first.crossings, dressed)
