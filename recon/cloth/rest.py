"""Cloth at rest: the minimum of elastic energy, gravity and contact, reached to a stated residual force.

L-BFGS on the compiled energy, in the metric of a positive stand-in for its Hessian (``curvature``); that and contacts
(``touch``) are made anew every few steps, and when nothing moves any more contacts are searched once again before that
counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.cloth.contact import BodyContact
from recon.cloth.curvature import Curvature
from recon.cloth.energies import GRAVITY, Cloth
from recon.cloth.layers import stack
from recon.cloth.solve import Contacts, ElasticEnergy, PolishSettings, lbfgs
from recon.cloth.touch import Touch

FEWEST = 5
"""Steps between two searches for contact at least."""
LONGEST = 0.02
"""No vertex moves further in one step [m]."""
BACK = 6
"""So many times in a row a round is taken back because energy would rise; the next one counts whatever it does."""
MANY = 1.7
"""Where a step takes more evaluations than this, springs are made stiffer: directions were too bold."""
FIRM, FIRMER, LOOSER, LEAST = 0.1, 3.0, 0.3, 1e-5
"""Stiffness of the springs in the metric, in units of the membrane's: at first, how it changes, and the least."""


@dataclass(frozen=True)
class Resting:
    """When cloth counts as being at rest."""

    tolerance: float = 0.02
    """Largest residual force on any vertex, in units of the mean vertex's weight."""
    iterations: int = 4000
    """Most steps in all."""
    search: int = 30
    """Steps between two searches for contact."""
    memory: int = 20
    """Pairs that L-BFGS keeps."""
    friction: float = 0.0
    """Coulomb's coefficient, on the body and between layers; cloth sticks where it first touches until that gives
    way."""
    contact: PolishSettings = field(default_factory=lambda: PolishSettings(stiffness=20.0))
    """Distance kept from the body and between layers, and how stiff that is."""


@dataclass(frozen=True)
class Rested:
    """Where it ends."""

    x: NDArray
    """(V, 3) [m]."""
    energy: float
    """[J]."""
    residual: float
    """Largest force on a vertex that is free, in units of the mean vertex's weight."""
    iterations: int
    """An upper bound of the steps taken."""
    energies: tuple[float, ...]
    """Energy at the start and after each search for contact, with the contacts found there and what friction has
    stored [J]."""
    converged: bool
    """Whether the residual met the tolerance."""


def rest(
    cloth: Cloth | Sequence[Cloth],
    start: NDArray,
    pins: NDArray | None = None,
    body: BodyContact | None = None,
    settings: Resting | None = None,
) -> Rested:
    """Let cloth come to rest.

    Args:
        cloth: in double precision, on the CPU; or several layers of one fabric, outermost first.
        start: (V, 3) where it is now, layers stacked [m].
        pins: (P,) vertices that stay where they are.
        body: what it may lie on.
        settings: see :class:`Resting`.
    """
    s, x = settings or Resting(), np.array(start, np.float64)
    scene = _Scene([cloth] if isinstance(cloth, Cloth) else list(cloth), pins, body, s)
    value, residual = scene.search(x)
    done, energies, steps, longest, back = 0, [value], s.search, LONGEST, 0
    while residual > s.tolerance and done < s.iterations:
        now, found = min(steps, s.iterations - done), (residual, scene.contacts, scene.touch.sticking)
        new = scene.minimise(x, now, longest)
        value, residual = scene.search(new)
        done += now
        if value > energies[-1] and back < BACK:
            # Planes stand for a curved body only so far: back, and search again after fewer and shorter steps.
            back, steps, longest = back + 1, max(steps // 4, FEWEST), longest / 4
            residual, scene.contacts, scene.touch.sticking = found
        else:
            x, back, steps, longest = new, 0, min(2 * steps, s.search), min(2 * longest, LONGEST)
            energies.append(value)
    return Rested(x, energies[-1], residual, done, tuple(energies), residual <= s.tolerance)


class _Scene:
    """Layers, what they touch, and the metric to measure steps by."""

    def __init__(self, cloths: list[Cloth], pins: NDArray | None, body: BodyContact | None, settings: Resting):
        whole = stack(cloths)
        self.settings, self.energy, self.curvature = settings, ElasticEnergy(whole), Curvature(whole)
        self.touch = Touch(cloths, body, settings.contact, settings.friction)
        self.held = np.zeros(0, np.int64) if pins is None else np.asarray(pins)
        self.weight = GRAVITY * float(whole.masses.mean())
        self.contacts, self.firm, self.evaluations = Contacts(), FIRM, 0

    def free(self, x: NDArray) -> tuple[float, NDArray]:
        """Energy and gradient, which is 0 where cloth is pinned."""
        value, gradient = self.energy(x)
        self.evaluations += 1
        gradient[self.held] = 0
        return value, gradient

    def search(self, x: NDArray) -> tuple[float, float]:
        """Find contacts at ``x`` (V, 3); the energy with them [J], and the residual in mean weights."""
        self.contacts = self.touch(x)
        self.energy.touch(self.contacts, self.settings.contact)
        value, gradient = self.free(x)
        return value, float(np.abs(gradient).max(initial=0.0)) / self.weight

    def minimise(self, x: NDArray, steps: int, longest: float) -> NDArray:
        """(V, 3) after ``steps``, none longer than ``longest`` [m]."""
        s = self.settings
        metric = self.curvature.solve(x, self.contacts, s.contact, self.held, self.firm)
        self.energy.touch(self.contacts, s.contact)
        self.evaluations = 0
        x = lbfgs(self.free, x, steps, s.memory, metric, longest, s.tolerance * self.weight)
        self.firm = float(np.clip(self.firm * (FIRMER if self.evaluations > MANY * steps else LOOSER), LEAST, 1.0))
        return x
