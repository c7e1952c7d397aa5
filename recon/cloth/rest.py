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
    """Energy at the start and after each search for contact, with the contacts found there [J]."""
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

    done, energies, residual = 0, [], np.inf
    while done < s.iterations:
        touching = _touch(energy, x, body, s.contact)
        value, gradient = free(x)
        energies.append(value)
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

        steps = min(s.search, s.iterations - done)
        x = lbfgs(free, x, steps, s.memory, metric, longest=0.02, tolerance=s.tolerance * weight)
        done += steps
    return Rested(x, energies[-1], residual, done, tuple(energies), residual <= s.tolerance)


def _touch(energy: ElasticEnergy, x: NDArray, body: BodyContact | None, s: PolishSettings) -> NDArray:
    """Set the planes of the body near the cloth; (V,) 1 where it touches."""
    touching = np.zeros(len(x))
    if body is None:
        return touching
    face, weights, sign = (t.numpy() for t in body.closest(torch.from_numpy(x)))
    on = (body.vertices.detach().numpy()[body.faces.numpy()[face]] * weights[..., None]).sum(1)
    away = (x - on) * sign[:, None]
    distance = np.linalg.norm(away, axis=1)
    near = np.flatnonzero((distance < s.reach) & (distance > 1e-9))
    energy.touch(Contacts(vertex=near, point=on[near], normal=away[near] / distance[near, None]), s)
    touching[(distance < 1.5 * s.offset) | (sign < 0)] = 1
    return touching
