"""Untangle: draped layers in, layers out that pass neither through each other, nor themselves, nor the body.

Rounds of small moves until an exact test finds nothing:

- vertices and face centres inside the body go out of it (``escape``), outer layers further than inner ones;
- between layers the order is known: what is on the wrong side goes back to its own, and what is left of crossing edges
  is drawn apart along the inner layer's outward direction; within a layer nobody knows which side is right: crossing
  edges and faces move so that the curve along which the cloth passes through itself grows shorter (``repairs``; Volino
  & Magnenat-Thalmann 2006);
- edges are brought back to the lengths they came with, so that repairs spread.

Where rounds stop helping, pockets cut off by crossings are laid flat, then all cloth in balls around what still
crosses, in wider ones each time, like soap films (``patches``): films over one hole lie over each other in the order of
their borders, and those are clean. That always costs more strain than was needed, so once all is clean cloth goes back
to its lengths and its place, by steps that cross nothing (``tighten``).

What stays tangled is tried in other ways, from the start. One is for wide cloth under narrow: the sides of a wide shirt
stand out of a narrow dress over it along curves that end at the hem, so they cut nothing off. What has outgrown the
layer over it, where the body that it is worn on lies under that layer too, is laid flat, border and all. Every other
round then moves layers so that curves grow shorter: beside an armhole cloth leaves by the border.

Only what is tangled, and what hangs on it, moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recon.cloth.escape import Escape
from recon.cloth.intersections import Crossings
from recon.cloth.patches import Pockets, film
from recon.cloth.repairs import Repairs
from recon.cloth.stack import Stack
from recon.cloth.tighten import Tighten, Tightening
from recon.cloth.xpbd import keep_lengths
from recon.types import Mesh

PATIENCE = 3
"""So many rounds without much progress, then cloth is laid flat."""
HELD = 0.1
"""How easily cloth gives way that is not laid flat, compared with what is."""
ALONE = 3
"""So many times what has outgrown the layers over it is laid flat by itself, where there is any."""
RADIUS, WIDER, WIDEST = 0.04, 1.5, 0.2
"""Radius of the first balls whose cloth is laid flat, how many times wider the next are, and the widest [m]."""
LEAVING = 20
"""Most steps out of the body that cross nothing, where nothing does."""
FARTHEST = 0.1
"""Where little else helps layers are recognised this deep in each other [m]."""

WAYS: tuple[dict[str, float | bool], ...] = (
    {},
    {"tuck": True},
    {"curve": 0.3, "gap": 2e-3},
    {"stiffness": 0.2},
    {"reach": 0.04},
)
"""What the tries change: what one way leaves tangled another mostly does not, and none is the best for all."""
BETWEEN = ("tuck", "reach")
"""What of it says nothing of a single layer."""


@dataclass(frozen=True)
class Untangling:
    """How layers are untangled."""

    rounds: int = 30
    """Most rounds of each try; what ends clean mostly does in fewer."""
    tries: int = 5
    """Most tries, each from the start and in another of the ``WAYS``."""
    enough: float = 0.005
    """A clean end that changes edges by no more than this share on average is taken; after another, what tries are left
    may find a better one."""
    body: float = 5e-4
    """Distance from the body that every vertex and face centre ends with [m]."""
    gap: float = 1e-3
    """Distance that layers are drawn apart where they cross [m]."""
    reach: float = 0.025
    """Layers deeper in each other than this are not recognised [m]."""
    curve: float = 0.6
    """Longest step against the curve of self-intersection per round, in mean edge lengths."""
    tuck: bool = False
    """Whether cloth too wide for the layers over it is drawn in beneath them."""
    sweeps: int = 4
    """Sweeps per round over the edges near a repair."""
    stiffness: float = 0.5
    """Share of an edge's error that a sweep takes back, halved each time that cloth is laid flat."""
    tighten: int = 6
    """Most steps back to where cloth was, once all is clean."""


@dataclass(frozen=True)
class Untangled:
    """Where it ends."""

    vertices: list[NDArray]
    """(V, 3) of each layer, as they came [m]."""
    crossings: int
    """Pairs of faces that passed through each other before it began."""
    strain: float
    """Mean change of the edges' lengths, as a share."""
    left: NDArray
    """(P, 2) pairs of faces that still do, faces counted through all layers; empty where it worked."""
    inside: int
    """Vertices and face centres that are still inside the body."""
    rounds: int
    """How many it took, all tries together."""
    notes: tuple[str, ...] = field(default=())
    """Where it could not, one line each."""

    @property
    def clean(self) -> bool:
        """Nothing is left."""
        return not len(self.left) and not self.inside


def untangle(layers: Sequence[Mesh], body: Mesh | None = None, settings: Untangling | None = None) -> Untangled:
    """Draw apart what passes through each other.

    Args:
        layers: draped garments (V, 3), outermost first; faces counter-clockwise from outside.
        body: what they are worn on; its faces outward.
        settings: see :class:`Untangling`.

    Returns:
        The layers moved, and what is left. Layers that are clean come back as they were.
    """
    settings = settings or Untangling()
    ways = [way for way in WAYS if len(layers) > 1 or not any(key in way for key in BETWEEN)]
    found: list[Untangled] = []
    for way in ways[: max(1, settings.tries)]:
        found.append(_Tangle(layers, body, replace(settings, **way)).solve())
        if found[-1].clean and found[-1].strain <= settings.enough:
            break
    best = min(found, key=lambda u: (u.inside, len(u.left), u.strain))
    return replace(best, rounds=sum(u.rounds for u in found))


class _Tangle:
    def __init__(self, layers: Sequence[Mesh], body: Mesh | None, settings: Untangling):
        self.settings = settings
        self.stack = Stack.of(layers)
        self.x, self.faces = self.stack.x, self.stack.faces
        self.crossings = Crossings(self.faces, len(self.x))
        self.edges = self.crossings.edges
        self.lengths = np.linalg.norm(self.x[self.edges[:, 0]] - self.x[self.edges[:, 1]], axis=1)
        self.body = Escape(body, self.x, self.faces, self.edges) if body is not None else None
        worn_on = self.body.body if self.body else None
        self.repairs = Repairs(self.crossings, self.stack.starts, settings.gap, float(self.lengths.mean()), worn_on)
        self.repairs.tucked = settings.tuck
        self.layer = self.repairs.layer
        self.pockets = Pockets(self.crossings, self.x, self.layer)
        self.flat = 0  # times that cloth was laid flat
        self.balls = 0  # times that all was, in balls around what crosses
        self.tighten = Tighten(self.repairs, self.body, settings.body, Tightening(rounds=settings.tighten))

    def solve(self) -> Untangled:
        """Rounds until nothing is left, then back to where cloth was as far as that stays so."""
        found, lack = self.crossings(self.x), self._lack()
        before = len(self.crossings.pairs(found))
        goal, lengths = self.x.copy(), np.maximum(self.lengths, 1e-9)
        rounds = self._rounds(found, lack) if len(found) or lack.any() else 0
        found, lack = self.crossings(self.x), self._lack(fresh=True)
        if rounds and not len(found) and not lack.any():
            clean, self.x = self.x, self.tighten(self.x, goal, lengths)
            if self._lack(fresh=True).any():
                self.x = clean
            found, lack = self.crossings(self.x), self._lack(fresh=True)
        left, inside = self.crossings.pairs(found), int(lack.sum())
        ends = self.x[self.edges]
        strain = np.abs(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / lengths - 1)
        notes = self._notes(left, inside)
        return Untangled(self.stack.split(self.x), before, float(strain.mean()), left, inside, rounds, notes)

    def _rounds(self, found: NDArray, lack: NDArray) -> int:
        """How many it took; ends clean, or with the best before cloth was laid flat: films stretch, and in vain."""
        best, best_x, rounds = (int(lack.sum()), len(found)), self.x.copy(), 0
        gentle, gentle_x = best, best_x
        mark, stuck = best[1], 0
        while any(best) and rounds < self.settings.rounds:
            if stuck >= PATIENCE:
                self._lay_flat(found)
                found = self.crossings(self.x)
                mark, stuck = len(found), 0
                if not len(found):
                    self.x = self.tighten.leave_body(self.x, LEAVING)
            if len(found) or self._lack().any():
                self._round(found, rounds)
            found, lack = self.crossings(self.x), self._lack()
            if not len(found) and not lack.any():
                lack = self._lack(fresh=True)
            now = int(lack.sum()), len(found)
            stuck = 0 if now[1] < 0.8 * mark else stuck + 1
            mark, rounds = min(mark, now[1]), rounds + 1
            if now < best:
                best, best_x = now, self.x.copy()
            if not self.flat and now < gentle:
                gentle, gentle_x = now, best_x
        self.x = gentle_x if any(best) else best_x
        return rounds

    def _round(self, found: NDArray, number: int) -> None:
        """One round of small moves, for the crossings ``found`` (K, 2)."""
        s, moved = self.settings, np.zeros(len(self.x), bool)
        if len(found) and len(self.stack.starts) > 2 and number % 2 == 0:
            moved |= self.repairs.own_side(self.x, found, min(s.reach * (1 + self.flat), FARTHEST))
            found = self.crossings(self.x, self.repairs.around(self.x, found, 0.06))
        if len(found):
            ordered = not (s.tuck and self.flat) or number % 2 == 0
            moved |= self.repairs.apart(self.x, found, s.curve, number, ordered)
        # Where layers leave the body together, the outer ones go further, else they would all end in one place.
        moved |= self._leave_body(number, 3, s.gap * (self.layer.max() - self.layer))
        self._relax(moved)
        self._leave_body(number, 10)

    def _lay_flat(self, found: NDArray) -> None:
        """Pockets and what has outgrown the layers over it, later balls around all that crosses, are laid flat; from
        now on mostly they give way."""
        if not len(found):
            return
        drawn = self.repairs.outgrown(self.x, found, WIDEST) if self.settings.tuck else np.zeros(len(self.x), bool)
        free = drawn.copy()
        if not self.flat:
            crossing = np.zeros(len(self.edges), bool)
            crossing[found[:, 0]] = True
            free |= self.pockets.find(crossing)
        elif self.flat > ALONE or not free.any():
            free |= self.repairs.around(self.x, found, min(RADIUS * WIDER**self.balls, WIDEST))
            self.balls += 1
        self.flat += 1
        self.repairs.yields = np.where(free, 1.0, HELD)
        self.x = film(self.x, self.edges, self.crossings.rim, free, drawn)
        mine = free[self.edges].any(1)
        ends = self.x[self.edges[mine]]
        self.lengths[mine] = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)

    def _notes(self, left: NDArray, inside: int) -> tuple[str, ...]:
        lines = []
        of = np.searchsorted(self.stack.first_face, left, side="right") - 1
        for pair in np.unique(np.sort(of, 1), axis=0) if len(left) else []:
            mine = left[(np.sort(of, 1) == pair).all(1)]
            at = self.x[self.faces[mine[:, 0]]].mean((0, 1))
            who = f"layer {pair[0]}" if pair[0] == pair[1] else f"layers {pair[0]} and {pair[1]}"
            place = ", ".join(f"{v:.3f}" for v in at)
            lines.append(f"{who}: {len(mine)} pairs of faces still cross around ({place}) m")
        if inside:
            lines.append(f"{inside} vertices and face centres are still inside the body")
        return tuple(lines)

    def _lack(self, fresh: bool = False) -> NDArray:
        """(V + F,) whether vertices and face centres are inside the body; ``fresh`` as in ``Escape.lack``."""
        return self.body.lack(self.x, fresh) if self.body else np.zeros(len(self.x) + len(self.faces), bool)

    def _leave_body(self, number: int, times: int, beyond: NDArray | None = None) -> NDArray:
        """Vertices and face centres closer to the body than the margin go out; returns which vertices moved."""
        if self.body is None:
            return np.zeros(len(self.x), bool)
        late = max(0.0, 2 * number / self.settings.rounds - 1)
        return self.body.leave(self.x, self.settings.body * (1 - 0.9 * late), 1.05 + 3 * late, times, beyond)

    def _relax(self, moved: NDArray) -> None:
        """Edges near what moved go back towards the lengths that they came with."""
        near = moved.copy()
        for _ in range(4):
            near[self.edges[near[self.edges].any(1)]] = True
        mine = near[self.edges].all(1)
        if mine.any():
            stiffness = self.settings.stiffness * 0.5**self.flat
            self.x = keep_lengths(self.x, self.edges[mine], self.lengths[mine], stiffness, self.settings.sweeps)
