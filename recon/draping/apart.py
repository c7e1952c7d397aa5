"""Layers that pass through nothing: networks' drapes untangled, or where that fails the same outfit dressed anew.

Networks drape each garment by itself, whatever it would have to pass through: a sleeve that they fold into a bent elbow
may leave no way out. A simulation that starts in the T pose, where layers lie clean over each other, and carries
them into the pose gets there with crossings that can be undone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from recon.bodies import Body
from recon.cloth.untangle import Untangled, Untangling, untangle
from recon.draping import Draper
from recon.draping.dress import dress
from recon.types import BodyPose, Garment, Mesh

TRIES = 2
"""Ways in which a network's drapes are untangled: what two leave tangled the others mostly do, too, and they cost more
than a simulation."""


@dataclass(frozen=True)
class Apart:
    """Where layers end."""

    layers: list[Mesh]
    """(V, 3) of each, innermost first, as they came [m]."""
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
    """Drapes of one body, untangled; where anything is left, dressed by simulation and untangled from there.

    Args:
        garments: innermost first, at rest on the neutral body.
        drapes: (V, 3) of each in the pose.
        body: the body model.
        pose: one body (batch of one).
        skinning: where a simulation takes cloth.
        say: hears when a simulation begins.
    """
    worn = Mesh(body.pose(pose).mesh.vertices[0], body.faces)
    first = untangle(drapes[::-1], worn, Untangling(tries=TRIES))
    if first.clean:
        return _ended(drapes, first, first, False)
    say("what networks draped can't be untangled: dressed by simulation")
    ends = dress([_bare(g) for g in reversed(garments)], body, pose, skinning)
    again = [mesh.with_vertices(torch.from_numpy(x).to(mesh.vertices)) for mesh, x in zip(drapes, ends[::-1])]
    second = untangle(again[::-1], worn)
    if (second.inside, len(second.left)) < (first.inside, len(first.left)):
        return _ended(again, second, first, True)
    return _ended(drapes, first, first, False)


def _bare(garment: Garment | Mesh) -> Garment:
    return Garment.bare("", garment) if isinstance(garment, Mesh) else garment


def _ended(layers: Sequence[Mesh], done: Untangled, first: Untangled, dressed: bool) -> Apart:
    moved = [m.with_vertices(torch.as_tensor(x).to(m.vertices)) for m, x in zip(layers, done.vertices[::-1])]
    return Apart(moved, done, first.crossings, dressed)
