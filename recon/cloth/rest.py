"""Cloth at rest: the minimum of elastic energy, gravity and contact, reached to a stated residual force.

L-BFGS on the compiled energy, started in the metric of springs along the edges (``solve.springs``); contact with the
body is searched anew every few steps, and when nothing moves any more it is searched once again before that counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from recon.cloth.contact import BodyContact
from recon.cloth.energies import GRAVITY, Cloth
from recon.cloth.solve import Contacts, ElasticEnergy, PolishSettings, edge_laplacian, lbfgs, springs

FEWEST = 5
"""Steps between two searches for contact at least."""


@dataclass(frozen=True)
class Resting:
    """When cloth counts as being at rest."""

    tolerance: float = 0.02
    """Largest residual force on any vertex, in units of the mean vertex's weight."""
    iterations: int = 4000
    """Most steps in all."""
    search: int = 100
    """Steps between two searches for contact."""
    memory: int = 20
    """Pairs that L-BFGS keeps."""
    friction: float = 0.0
    """Coulomb's coefficient between cloth and body; cloth sticks where it first touches until that gives way."""
    contact: PolishSettings = field(default_factory=PolishSettings)
    """Distance kept from the body, and how stiff that is."""


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
    """Energy at the start and after each search for contact, with the contacts found there [J]; friction, which spends
    energy, aside."""
    converged: bool
    """Whether the residual met the tolerance."""


def rest(
    cloth: Cloth,
    start: NDArray,
    pins: NDArray | None = None,
    body: BodyContact | None = None,
    settings: Resting | None = None,
) -> Rested:
    """Let cloth come to rest.

    Args:
        cloth: in double precision, on the CPU.
        start: (V, 3) where it is now [m].
        pins: (P,) vertices that stay where they are.
        body: what it may lie on.
        settings: see :class:`Resting`.
    """
    s = settings or Resting()
    energy, x = ElasticEnergy(cloth), np.array(start, np.float64)
    held = np.zeros(0, np.int64) if pins is None else np.asarray(pins)
    laplacian = edge_laplacian(cloth)
    weight = GRAVITY * float(cloth.masses.mean())
    spring = cloth.fabric.thickness * (2 * cloth.fabric.lame_mu + cloth.fabric.lame_lambda)

    def free(x: NDArray) -> tuple[float, NDArray]:
        value, gradient = energy(x)
        gradient[held] = 0
        return value, gradient

    touch = _Touch(energy, body, s, cloth.masses.numpy() * GRAVITY)
    done, energies, residual, before, steps = 0, list[float](), np.inf, x, s.search
    while done < s.iterations:
        touching, spent = touch(x)
        value, gradient = free(x)
        if energies and value - spent > energies[-1] and not s.friction and steps > FEWEST:
            # Planes stand for a curved body only so far: back, and search again after fewer steps.
            x, steps = before, max(steps // 4, FEWEST)
            touching, spent = touch(x)
            value, gradient = free(x)
        else:
            energies.append(value - spent)
        residual = float(np.abs(gradient).max(initial=0.0)) / weight
        if residual <= s.tolerance:
            break
        diagonal = 2 * s.contact.stiffness * touching
        diagonal[held] = 1e6 * spring
        solve = springs(cloth, laplacian, diagonal)

        def metric(q: NDArray, solve=solve) -> NDArray:
            out = solve(q)
            out[held] = 0
            return out

        before, now = x, min(steps, s.iterations - done)
        x = lbfgs(free, x, now, s.memory, metric, longest=0.02, tolerance=s.tolerance * weight)
        done, steps = done + now, min(2 * steps, s.search)
    return Rested(x, energies[-1], residual, done, tuple(energies), residual <= s.tolerance)


class _Touch:
    """The body's planes near the cloth, searched anew at each call; with friction, what each vertex sticks to."""

    def __init__(self, energy: ElasticEnergy, body: BodyContact | None, settings: Resting, weight: NDArray):
        """``weight`` (V,) of each vertex [N]."""
        self.energy, self.body, self.settings, self.weight = energy, body, settings, weight
        self.anchor = np.full((len(weight), 3), np.nan)

    def __call__(self, x: NDArray) -> tuple[NDArray, float]:
        """(V,) 1 where cloth at ``x`` (V, 3) touches, and the energy that friction would give back [J]."""
        s = self.settings.contact
        touching = np.zeros(len(x))
        if self.body is None:
            return touching, 0.0
        face, weights, sign = (t.numpy() for t in self.body.closest(torch.from_numpy(x)))
        on = (self.body.vertices.detach().numpy()[self.body.faces.numpy()[face]] * weights[..., None]).sum(1)
        away = (x - on) * sign[:, None]
        distance = np.linalg.norm(away, axis=1)
        near = np.flatnonzero((distance < s.reach) & (distance > 1e-9))
        normal, depth = away[near] / distance[near, None], s.offset - sign[near] * distance[near]
        touching[(distance < 1.5 * s.offset) | (sign < 0)] = 1
        if not self.settings.friction:
            self.energy.touch(Contacts(vertex=near, point=on[near], normal=normal), s)
            return touching, 0.0
        first = np.argsort(depth < -s.slip, kind="stable")  # those that touch come first
        near, normal, depth = near[first], normal[first], depth[first]
        stuck = int((depth >= -s.slip).sum())
        grip, spent = self._stick(x, near[:stuck], normal[:stuck], depth[:stuck])
        anchor = self.anchor[near[:stuck]]
        self.energy.touch(Contacts(vertex=near, point=on[near], normal=normal, anchor=anchor, grip=grip), s)
        return touching, spent

    def _stick(self, x: NDArray, vertex: NDArray, normal: NDArray, depth: NDArray) -> tuple[NDArray, float]:
        """(A,) how hard each touching vertex is held, its anchor dragged along where it slid; friction's energy."""
        slip = self.settings.contact.slip
        loose = np.ones(len(x), bool)
        loose[vertex] = False
        self.anchor[loose] = np.nan
        new = vertex[np.isnan(self.anchor[vertex, 0])]
        self.anchor[new] = x[new]
        along = x[vertex] - self.anchor[vertex]
        along -= normal * (along * normal).sum(1, keepdims=True)
        way = np.linalg.norm(along, axis=1)
        slid = way > slip
        self.anchor[vertex[slid]] += along[slid] * (1 - slip / way[slid, None])
        # What only just arrived is not pressed down yet: it counts with its weight.
        pressed = np.maximum(2 * self.settings.contact.stiffness * depth, self.weight[vertex] * normal[:, 1].clip(0))
        grip = self.settings.friction * pressed
        return grip, float((grip * np.minimum(way, slip) ** 2).sum() / (2 * slip))
