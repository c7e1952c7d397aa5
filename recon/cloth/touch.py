"""What cloth touches: the body, other layers, and where friction holds it; found anew whenever it is asked for.

Coulomb's friction is an energy here: it grows with the way from where cloth first touched, up to its coefficient times
the normal force of the last search, and from there on the anchor is dragged along. Body and layers are alike: cloth
is held to a point of a face, which moves as the face does (the body's never).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.cloth.constraints import open_rim
from recon.cloth.contact import BodyContact
from recon.cloth.energies import GRAVITY, Cloth
from recon.cloth.layers import between
from recon.cloth.solve import Contacts, PolishSettings


@dataclass(frozen=True)
class _Pressed:
    """Contacts that may hold, of either kind."""

    vertex: NDArray
    """(K,)"""
    surface: NDArray
    """(K,) 0: the body, 1 + j: layer j."""
    corners: NDArray
    """(K, 3) of the face that it is close to."""
    weights: NDArray
    """(K, 3) barycentric, zeros for the body."""
    normal: NDArray
    """(K, 3)"""
    depth: NDArray
    """(K,) how much nearer it is than the offset [m]."""

    def __getitem__(self, rows: NDArray) -> _Pressed:
        return _Pressed(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Sticking:
    """Where friction holds cloth, by surface (0: the body, 1 + j: layer j) and vertex."""

    anchor: NDArray
    """(S, V, 3) where it would be held, from a point of the surface on; nan: not held [m]."""
    corners: NDArray
    """(S, V, 3) vertices of the face that point is of."""
    weights: NDArray
    """(S, V, 3) its barycentric weights, zeros for the body."""
    grip: NDArray
    """(S, V) the most that holds [N]."""

    @classmethod
    def nowhere(cls, surfaces: int, vertices: int) -> Sticking:
        """Nothing is held."""
        shape = (surfaces, vertices, 3)
        return cls(np.full(shape, np.nan), np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape[:2]))

    def copy(self) -> Sticking:
        """The same in arrays of its own."""
        return Sticking(*(getattr(self, name).copy() for name in self.__dataclass_fields__))

    def held(self, now: _Pressed) -> Contacts:
        """What holds those contacts."""
        at = (now.surface, now.vertex)
        stuck = np.column_stack([now.vertex, self.corners[at]])
        return Contacts(
            stuck=stuck, share=self.weights[at], anchor=self.anchor[at], across=now.normal, grip=self.grip[at]
        )

    def hold(self, x: NDArray, now: _Pressed, along: NDArray | float) -> None:
        """From now on those are held to the point that they are closest to, ``along`` (K, 3) from their anchor."""
        at = (now.surface, now.vertex)
        self.corners[at], self.weights[at] = now.corners, now.weights
        self.anchor[at] = x[now.vertex] - np.einsum("ok,oki->oi", now.weights, x[now.corners]) - along


class Touch:
    """Finds the contacts of layers, stacked outermost first."""

    def __init__(
        self, cloths: Sequence[Cloth], body: BodyContact | None, settings: PolishSettings, friction: float = 0.0
    ):
        """``friction``: Coulomb's coefficient, against body and between layers."""
        self.body, self.settings, self.friction = body, settings, friction
        self.faces = [c.faces for c in cloths]
        self.rims = [open_rim(c.faces.numpy(), len(c.masses)) for c in cloths]
        self.starts = np.cumsum([0, *[len(c.masses) for c in cloths]])
        self.weight = np.concatenate([c.masses.numpy() for c in cloths]) * GRAVITY
        self.sticking = Sticking.nowhere(1 + len(cloths), len(self.weight))

    def __call__(self, x: NDArray) -> Contacts:
        """Contacts at ``x`` (V, 3), with what friction holds if there is any."""
        parts = [x[a:b] for a, b in zip(self.starts[:-1], self.starts[1:])]
        layers = between(parts, self.faces, self.rims, self.starts)
        found = Contacts.join([self._planes(x), layers])
        if not self.friction:
            return found
        pressed = self._pressed(x, found)
        return self._stick(x, found, pressed[pressed.depth >= -self.settings.slip])

    def _planes(self, x: NDArray) -> Contacts:
        if self.body is None:
            return Contacts()
        close = self.body.nearest(x, self.settings.reach)
        return Contacts(vertex=close.rows, point=close.point, normal=close.outward)

    def _pressed(self, x: NDArray, found: Contacts) -> _Pressed:
        count, corners = len(found.vertex), found.over[:, 1:]
        below = np.einsum("ok,oki->oi", found.weights, x[corners])
        normal = np.concatenate([found.normal, found.direction])
        away = np.concatenate([x[found.vertex] - found.point, x[found.over[:, 0]] - below])
        on = np.searchsorted(self.starts, corners[:, 0], side="right") if len(corners) else np.zeros(0, np.int64)
        return _Pressed(
            vertex=np.concatenate([found.vertex, found.over[:, 0]]),
            surface=np.concatenate([np.zeros(count, np.int64), on]),
            corners=np.concatenate([np.zeros((count, 3), np.int64), corners]),
            weights=np.concatenate([np.zeros((count, 3)), found.weights]),
            normal=normal,
            depth=self.settings.offset - (away * normal).sum(1),
        )

    def _stick(self, x: NDArray, found: Contacts, now: _Pressed) -> Contacts:
        """The contacts with friction's: anchors dragged along where cloth slid."""
        slip, at, sticking = self.settings.slip, (now.surface, now.vertex), self.sticking.copy()
        loose = np.ones(sticking.grip.shape, bool)
        loose[at] = False
        sticking.anchor[loose] = np.nan
        new = np.isnan(sticking.anchor[at][:, 0])
        sticking.hold(x, now[new], 0.0)
        before = sticking.grip[at]
        force = 2 * self.settings.stiffness * np.maximum(now.depth, 0)
        # What only just arrived is not pressed down yet: it counts with its weight.
        arrived = np.where(new, self.weight[now.vertex] * now.normal[:, 1].clip(0), 0.0)
        grip = sticking.grip[at] = self.friction * np.maximum(force, arrived)
        along = sticking.held(now).along(x)
        way = np.linalg.norm(along, axis=1)
        # Past its slip the anchor is dragged along; where the grip grew it follows, lest energy come from nowhere.
        less = np.minimum(1, slip / np.maximum(way, 1e-30)) * np.sqrt(np.minimum(1, before / np.maximum(grip, 1e-30)))
        dragged = (less < 1) & (way > 0)
        sticking.hold(x, now[dragged], along[dragged] * less[dragged, None])
        self.sticking = sticking
        return Contacts.join([found, sticking.held(now)])
