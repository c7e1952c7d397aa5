"""Draping by skinning: a garment at rest rides on the body's shape directions and joints (SNUG, GAPS Eq. 7)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from torch import Tensor

from recon.bodies.skin import shaped, skin
from recon.cloth.beside import Surface
from recon.draping.binding import JOINTS, METHODS, BodyField, settle
from recon.draping.lattice import Lattice
from recon.types import Garment, Mesh, PosedBody


class SkinningDraper:
    """A ``Draper``: linear blend skinning with the body's weights extended into space."""

    def __init__(self, body, method: str = "rbf", lattice: bool = True):
        """
        Args:
            body: a ``recon.bodies`` body.
            method: key of ``binding.METHODS``.
            lattice: read GAPS' participation, which rbf settles, from a lattice that is sampled on first use (about two
                seconds): several times faster, 0.3 mm from the exact binding in the mean, and differentiable in the
                garment's rest vertices also through the weights. Other methods are evaluated exactly, weights held.
        """
        if method not in METHODS:
            raise ValueError(f"skinning: found method {method!r}; wanted one of {', '.join(METHODS)}")
        self.field = BodyField.of(body)
        self.method = method
        self._use_lattice = lattice and method == "rbf"
        self._lattice: Lattice | None = None
        self._body = body

    @cached_property
    def surface(self) -> Surface:
        """The neutral body's at rest, to walk on."""
        rest = self._body.rest(self._body.neutral().shape)
        return Surface(rest.vertices[0], rest.faces)

    def bind(self, vertices: Tensor, faces: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Rest vertices (N, 3) -> skinning weights (N, 24), rows sum to 1, and shape directions (N, 3, S)."""
        if self._use_lattice:
            self._lattice = self._lattice or Lattice(self.field)
            found = settle(self.field, self._lattice(vertices), vertices, faces)
        else:
            found = METHODS[self.method](self.field, vertices, faces)
        weights = found[:, :JOINTS] / found[:, :JOINTS].sum(1, keepdim=True)
        return weights, found[:, JOINTS:].contiguous().unflatten(1, (3, -1))

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on B bodies: Mesh with (B, N, 3) vertices; the layers beneath play no part in skinning.

        Differentiable in the garment's rest vertices and in the body's shape, pose and translation.
        """
        return Mesh(self.drape_vertices(garment.mesh, body), garment.mesh.faces)

    def drape_vertices(self, rest: Mesh, body: PosedBody) -> Tensor:
        """(N, 3) rest vertices on B bodies -> (B, N, 3)."""
        weights, directions = self.bind(rest.vertices, rest.faces)
        return skin(shaped(rest.vertices, directions, body.shape), body.transforms, weights)


def load_skinning(body, folder: str | Path | None = None) -> SkinningDraper:
    """The draper without weights; ``folder`` plays no part."""
    return SkinningDraper(body)
