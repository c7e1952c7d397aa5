"""Layers as one mesh: what is searched for crossings, moved and taken apart again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.types import Mesh


@dataclass(frozen=True)
class Stack:
    """Garments, outermost first, stacked."""

    x: NDArray
    """(V, 3) vertices of all layers, double precision [m]."""
    faces: NDArray
    """(F, 3)"""
    starts: NDArray
    """(L + 1,) first vertex of each layer, and their number."""
    first_face: NDArray
    """(L + 1,) the same of faces."""

    @classmethod
    def of(cls, layers: Sequence[Mesh]) -> Stack:
        """``layers``: (V, 3) each."""
        starts = np.cumsum([0, *[len(m.vertices) for m in layers]])
        x = np.concatenate([m.vertices.detach().cpu().double().numpy() for m in layers])
        faces = [m.faces.cpu().numpy() + at for m, at in zip(layers, starts[:-1])]
        return cls(x, np.concatenate(faces), starts, np.cumsum([0, *[len(f) for f in faces]]))

    def split(self, x: NDArray) -> list[NDArray]:
        """(V, 3) of each layer of ``x`` (V, 3) of all."""
        return [x[a:b] for a, b in zip(self.starts[:-1], self.starts[1:])]
