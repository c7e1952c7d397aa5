"""Cloth that follows a simulated motion and crosses nothing on the way.

A simulation that knows distances but no crossings ends where a sleeve was pressed through itself in a bent elbow, and
from there no small moves lead out. Here cloth starts clean and goes along with the body, frame by frame: what a frame's
move would make cross is cut short, then drawn to where the simulation has it as far as that crosses nothing. So
crossings never are; what the body's parts pinch between them may end inside the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.cloth.escape import Escape
from recon.cloth.intersections import Crossings
from recon.cloth.repairs import Repairs
from recon.cloth.stack import Stack
from recon.cloth.tighten import Tighten
from recon.cloth.xpbd import keep_lengths
from recon.types import Mesh

OFF = 1e-6
"""Cloth this near to where the simulation has it has followed [m]."""
AROUND = 3
"""So many rings of neighbours move along with cloth that has not."""


@dataclass(frozen=True)
class Following:
    """How cloth catches up with the simulation."""

    rounds: int = 1
    """Steps after each frame's move."""
    last: int = 20
    """Steps after the last."""
    pull: float = 0.3
    """Share of the way to the simulated place that a step begins with."""
    sweeps: int = 6
    """Sweeps over the edges in a step."""
    stiffness: float = 0.5
    """Share of an edge's error that a sweep takes back."""
    longest: float = 0.02
    """Longest step of a vertex [m]."""
    gap: float = 1e-3
    """Distance that layers are drawn apart where a step would make them cross [m]."""
    margin: float = 5e-4
    """Distance kept from the body [m]."""
    leaving: int = 60
    """Most steps that only lead out of the body, wherever the simulation has cloth."""
    patience: int = 10
    """These end after so many that lead nothing out."""
    barely: float = 1e-4
    """Distance from the body that these ask for: where its parts pinch cloth there is no room for more [m]."""


def follow(
    layers: Sequence[Mesh],
    goals: NDArray,
    bodies: NDArray,
    faces: Tensor,
    space: Callable[[int, NDArray], NDArray],
    settings: Following | None = None,
) -> list[NDArray]:
    """Where layers get that cross nothing on the way.

    Args:
        layers: their start (V, 3), outermost first, of which nothing crosses.
        goals: (T, V, 3) where a simulation has all of them, from the start on [m].
        bodies: (T, B, 3) what they are worn on [m].
        faces: (F, 3) of those, outward.
        space: takes a frame's number and cloth (V, 3) beside the body of the one before, and says where the body takes
            it: all of it alike, so that little of it passes through anything.
        settings: see :class:`Following`.

    Returns:
        (V, 3) of each layer.
    """
    stack, way = Stack.of(layers), _Way(layers, settings or Following())
    x = stack.x
    for k in range(1, len(goals)):
        x = way.frame(x, space(k, x) - x, goals[k], Mesh(torch.from_numpy(bodies[k]), faces), k + 1 == len(goals))
    return stack.split(way.out(x))


class _Way:
    def __init__(self, layers: Sequence[Mesh], settings: Following):
        self.settings, stack = settings, Stack.of(layers)
        self.faces = stack.faces
        crossings = Crossings(stack.faces, len(stack.x))
        self.edges = crossings.edges
        scale = float(np.linalg.norm(stack.x[self.edges[:, 0]] - stack.x[self.edges[:, 1]], axis=1).mean())
        self.repairs = Repairs(crossings, stack.starts, settings.gap, scale)
        self.tighten = Tighten(self.repairs, None, settings.margin)

    def frame(self, x: NDArray, step: NDArray, goal: NDArray, body: Mesh, last: bool) -> NDArray:
        """From ``x`` (V, 3) by ``step`` (V, 3), then towards ``goal`` (V, 3)."""
        self._wear(body, x)
        x = self.tighten.filtered(x, step, False)
        return self._catch_up(x, goal, self.settings.last if last else self.settings.rounds)

    def out(self, x: NDArray) -> NDArray:
        """Of steps from ``x`` (V, 3) that only lead out of the body, crossing nothing, the end with least inside."""
        self.tighten.margin = self.settings.barely
        best, least, when = x, np.inf, 0
        for number in range(self.settings.leaving + 1):
            lack = self._lack(x)
            if lack.sum() < least:
                best, least, when = x, lack.sum(), number
            if not least or number - when > self.settings.patience:
                break
            step = self.tighten.apart(x.copy(), self._around(self._vertices(lack)), number) - x
            x = self.tighten.filtered(x, step, False)
        return best

    def _wear(self, body: Mesh, x: NDArray) -> None:
        """The body of a frame, around cloth that was outside of the one before."""
        self.tighten.body = Escape(body, x, self.faces, self.edges)
        self.repairs.body = self.tighten.body.body

    def _catch_up(self, x: NDArray, goal: NDArray, rounds: int) -> NDArray:
        """``x`` (V, 3) nearer to ``goal`` (V, 3), out of the body, as far as nothing crosses."""
        s = self.settings
        ends = goal[self.edges]
        lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        for number in range(rounds):
            free = self._behind(x, goal)
            if not free.any():
                break
            mine = free[self.edges].all(1)
            aim = x + s.pull * (goal - x)
            step = keep_lengths(aim, self.edges[mine], lengths[mine], s.stiffness, s.sweeps) - x
            size = np.linalg.norm(step, axis=1, keepdims=True)
            aim = x + step * np.minimum(1, s.longest / np.maximum(size, 1e-12))
            x = self.tighten.filtered(x, self.tighten.apart(aim, free, number) - x, False)
        return x

    def _behind(self, x: NDArray, goal: NDArray) -> NDArray[np.bool_]:
        """(V,) cloth that is not where it should be or in the body, and what is around it."""
        return self._around((np.linalg.norm(x - goal, axis=1) > OFF) | self._vertices(self._lack(x)))

    def _lack(self, x: NDArray) -> NDArray[np.bool_]:
        """(V + F,) as ``Escape.lack``."""
        assert self.tighten.body is not None
        return self.tighten.body.lack(x)

    def _vertices(self, lack: NDArray) -> NDArray[np.bool_]:
        """(V,) the vertices of what is in the body (V + F,)."""
        out = lack[: len(lack) - len(self.faces)].copy()
        out[self.faces[lack[len(out) :]]] = True
        return out

    def _around(self, free: NDArray) -> NDArray[np.bool_]:
        """(V,) these vertices and some rings of neighbours."""
        for _ in range(AROUND):
            free[self.edges[free[self.edges].any(1)]] = True
        return free
