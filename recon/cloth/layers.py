"""Garments worn over each other on one body, at rest: elastic energy, gravity, and contact with body and each other.

Contact between layers acts on both: an outer vertex pushes the face that it lies over, and the face it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.cloth.constraints import Constraints, close_strangers, open_rim
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth
from recon.cloth.escape import vertex_normals
from recon.cloth.solve import Contacts, ElasticEnergy, PolishSettings, edge_laplacian, springs
from recon.cloth.xpbd import ON_BORDER

LAYER_REACH = 0.02
"""Layers further apart than this, or deeper in each other, don't touch [m]."""
SAME_WAY = 0.5
"""A vertex lies under a face only if their normals agree by this cosine: a sleeve beside the hip covers nothing."""


class LayeredCloth:
    """Energy [J] and gradient [N] of garments worn over each other; positions are stacked, outermost first.

    Contacts are those of the last :meth:`touch`.
    """

    def __init__(
        self,
        cloths: Sequence[Cloth],
        limits: Sequence[Constraints],
        body: BodyContact,
        settings: PolishSettings | None = None,
    ):
        """
        Args:
            cloths: rest states in double precision and of one fabric, outermost first, on the CPU.
            limits: for each its flat positions (which parts are strangers) and waistband (which keeps its height).
            body: the body, on the CPU.
            settings: contact distances and stiffness; ``apart`` counts in mean edge lengths here.
        """
        self.limits, self.body = list(limits), body
        self.settings = settings or PolishSettings(apart=0.5)
        self.apart = [self.settings.apart * float(k.edge_lengths.mean()) for k in self.limits]
        self.faces = [c.faces for c in cloths]
        self.rims = [open_rim(c.faces.numpy(), len(c.masses)) for c in cloths]
        self.starts = np.cumsum([0, *[len(c.masses) for c in cloths]])
        self.cloth = stack(cloths)
        self.energy = ElasticEnergy(self.cloth)
        self.laplacian = edge_laplacian(self.cloth)
        self.levels: list[NDArray] = []
        self.touching = np.zeros(self.starts[-1])

    def split(self, x: NDArray) -> list[NDArray]:
        """(V, 3) stacked positions -> one array per layer."""
        return [x[a:b] for a, b in zip(self.starts[:-1], self.starts[1:])]

    def hold(self, x: NDArray) -> None:
        """From now on waistbands keep the height of each of their vertices in ``x``."""
        self.levels = [part[k.held].copy() for part, k in zip(self.split(x), self.limits)]

    def touch(self, x: NDArray) -> None:
        """Find what is close to what at ``x`` (V, 3)."""
        parts = self.split(x)
        found = [self._body(x), *self._holds()]
        for k, part in enumerate(parts):
            pair = close_strangers(part, self.limits[k].rest, self.apart[k])
            found.append(Contacts(pair=pair + self.starts[k], apart=np.full(len(pair), self.apart[k])))
        found.append(between(parts, self.faces, self.rims, self.starts))
        contacts = Contacts.join(found)
        self.energy.touch(contacts, self.settings)
        depth = ((x[contacts.vertex] - contacts.point) * contacts.normal).sum(1)
        on = contacts.vertex[depth < 1.5 * self.settings.offset]
        self.touching = np.minimum(np.bincount(on, minlength=len(x)), 2)

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        """Energy and gradient (V, 3) at ``x`` (V, 3)."""
        return self.energy(x)

    def preconditioner(self) -> Callable[[NDArray], NDArray]:
        """Multiplies (V, 3) by the inverse of a constant stand-in for the Hessian: springs along edges, and contacts.

        It lets L-BFGS start where the stiffness is (Liu et al. 2017, "Quasi-Newton Methods for Real-Time Simulation
        of Hyperelastic Materials").
        """
        return springs(self.cloth, self.laplacian, 2 * self.settings.stiffness * self.touching)

    def _body(self, x: NDArray) -> Contacts:
        """Planes of the body close to the cloth."""
        close = self.body.nearest(x, self.settings.reach)
        return Contacts(vertex=close.rows, point=close.point, normal=close.outward)

    def _holds(self):
        """Two facing planes hold each waistband vertex at its height, and leave it its way around the body."""
        for start, limits, level in zip(self.starts, self.limits, self.levels):
            for direction in (1.0, -1.0):
                normal = np.tile([0.0, direction, 0.0], (len(level), 1))
                yield Contacts(vertex=limits.held + start, point=level - self.settings.offset * normal, normal=normal)


def between(parts: Sequence[NDArray], faces: Sequence[Tensor], rims: Sequence[NDArray], starts: NDArray) -> Contacts:
    """Contacts of layers (V, 3), outermost first: of vertices over the layers beneath, and under those above.

    ``faces`` (F, 3) and ``rims`` (V,) bool of each, ``starts``: the first of its vertices among all.
    """
    found = []
    for k in range(len(parts)):
        for j in range(k + 1, len(parts)):
            for mine, other, side in ((k, j, 1.0), (j, k, -1.0)):
                surface = BodyContact(torch.tensor(parts[other]), faces[other])
                close = surface.nearest(parts[mine], LAYER_REACH)
                # Beside an open border there are no sides.
                fit = ~(rims[other][close.corners] | (close.weights < ON_BORDER)).all(1)
                if side < 0:  # beneath is only what faces the same way
                    own = vertex_normals(parts[mine], faces[mine].numpy())[close.rows]
                    fit &= (own * close.outward).sum(1) > SAME_WAY
                pair = np.column_stack([close.rows + starts[mine], close.corners + starts[other]])[fit]
                found.append(Contacts(over=pair, weights=close.weights[fit], direction=side * close.outward[fit]))
    return Contacts.join(found or [Contacts()])


def stack(cloths: Sequence[Cloth]) -> Cloth:
    """Several cloths of one fabric as one."""
    starts = np.cumsum([0, *[len(c.masses) for c in cloths]])

    def joined(name: str, shifted: bool = False) -> Tensor:
        return torch.cat([getattr(c, name) + (int(n) if shifted else 0) for c, n in zip(cloths, starts)])

    moved = {name: joined(name, True) for name in ("faces", "edges", "hinges")}
    plain = ("inverse", "areas", "edge_lengths", "hinge_weights", "masses", "rest_angles")
    same = {name: joined(name) for name in plain}
    return Cloth(**moved, **same, fabric=cloths[0].fabric)
