"""Cloth that is free of crossings goes back towards where and how it was, by steps that make no new crossing.

What came out of a tangle is laid flat, stretched or pushed further than it had to be. From there its edges go back to
their old lengths, and it is drawn to its old place; what would cross is drawn apart, and where it still would, the step
is cut short. Hence whatever was clean stays clean, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.cloth.escape import Escape
from recon.cloth.repairs import Repairs
from recon.cloth.xpbd import keep_lengths

HALVINGS = 2
"""A step is halved so many times where it crosses, then not made."""
TRIALS = 24
"""After so many tests nothing moves: reached where steps of many vertices depend on each other."""
SPREAD = 6
"""From so many tests on, neighbours of what still crosses stay where they are, too."""


@dataclass(frozen=True)
class Tightening:
    """How clean cloth goes back."""

    rounds: int = 6
    """Most steps."""
    pull: float = 0.05
    """Share of the way to its old place that a step begins with."""
    longest: float = 0.01
    """Longest step of a vertex [m]."""
    sweeps: int = 8
    """Sweeps over the edges in a step."""
    stiffness: float = 0.5
    """Share of an edge's error that a sweep takes back."""
    apart: int = 4
    """Times that what a step would make cross is drawn apart."""
    enough: float = 5e-4
    """Ends where no vertex moves further [m]."""


class Tighten:
    """Steps from clean cloth, each of which ends clean."""

    def __init__(self, repairs: Repairs, body: Escape | None, margin: float, settings: Tightening | None = None):
        """``margin``: distance kept from the body [m]."""
        self.repairs, self.body, self.margin = repairs, body, margin
        self.edges, self.faces, self.crossings = repairs.edges, repairs.faces, repairs.crossings
        self.settings = settings or Tightening()

    def __call__(self, x: NDArray, goal: NDArray, lengths: NDArray) -> NDArray:
        """(V, 3) clean positions nearer to ``goal`` (V, 3) and to the edges' ``lengths`` (E,) than the clean ``x``."""
        s = self.settings
        free = np.linalg.norm(x - goal, axis=1) > 1e-6
        for _ in range(2):
            free[self.edges[free[self.edges].any(1)]] = True
        self.repairs.yields = np.where(free, 1.0, 1e-6)
        mine = free[self.edges].all(1)
        for number in range(s.rounds if mine.any() else 0):
            aim = x.copy()
            aim[free] += s.pull * (goal - x)[free]
            step = keep_lengths(aim, self.edges[mine], lengths[mine], s.stiffness, s.sweeps) - x
            size = np.linalg.norm(step, axis=1, keepdims=True)
            aim = x + step * np.minimum(1, s.longest / np.maximum(size, 1e-12))
            after = self.filtered(x, self.apart(aim, free, number) - x)
            far, x = np.abs(after - x).max(), after
            if far < s.enough:
                break
        return x

    def leave_body(self, x: NDArray, rounds: int) -> NDArray:
        """(V, 3) ``x``, of which nothing crosses, as far out of the body as that stays so."""
        for number in range(rounds):
            if not self.body or not self.body.lack(x).any():
                break
            aim = x.copy()
            everywhere = np.ones(len(x), bool)
            x = self.filtered(x, self.apart(aim, everywhere, number) - x, False)
        return x

    def apart(self, aim: NDArray, free: NDArray, number: int) -> NDArray:
        """``aim`` (V, 3), moved in place to where less of it crosses and none of it is in the body."""
        self._leave(aim)
        for _ in range(self.settings.apart):
            found = self.crossings(aim, free)
            if not len(found):
                break
            self.repairs.apart(aim, found, 0.5, number)
        self._leave(aim)
        return aim

    def _leave(self, x: NDArray) -> None:
        if self.body:
            self.body.leave(x, self.margin, 1.0, 2)

    def filtered(self, x: NDArray, step: NDArray, outside: bool = True) -> NDArray:
        """``x`` (V, 3) moved by as much of ``step`` (V, 3) as makes nothing cross; ``x`` itself must be clean.

        Places are those that single precision has: meshes are kept in it, and what all but touches may cross by then.

        ``outside``: nothing may enter the body either, and nothing of ``x`` is in it.
        """
        share = np.ones(len(x))
        changed = np.ones(len(x), bool)
        for trial in range(TRIALS):
            after = (x + share[:, None] * step).astype(np.float32).astype(np.float64)
            changed &= (after != x).any(1) | (trial > 0)
            wrong = self._offenders(after, changed, outside)
            if not wrong.any():
                return after
            if trial >= SPREAD:
                wrong[self.edges[wrong[self.edges].any(1)]] = True
            more = (trial < SPREAD) & (share[wrong] > 0.5**HALVINGS)
            share[wrong] = np.where(more, 0.5 * share[wrong], 0.0)
            changed = wrong
        return x.copy()

    def _offenders(self, x: NDArray, changed: NDArray, outside: bool) -> NDArray[np.bool_]:
        """(V,) vertices of what crosses, if it is ``changed`` (V,); of what is in the body if that counts."""
        out = np.zeros(len(x), bool)
        found = self.crossings(x, changed)
        out[self.edges[found[:, 0]]] = True
        out[self.faces[found[:, 1]]] = True
        if self.body and outside:
            lack = self.body.lack(x)
            out |= lack[: len(x)]
            out[self.faces[lack[len(x) :]]] = True
        return out
