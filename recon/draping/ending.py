"""What ends a network's drape: rounds in which edges are drawn to their lengths and vertices out of what lies beneath.

That is the body for a garment draped alone, and body and garments for one that is layered over them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.cloth.beside import Start, Surface
from recon.cloth.edges import EdgeProjection
from recon.cloth.energies import rest_edges
from recon.draping.dress import held_vertices
from recon.types import Garment, Mesh, PosedBody

ROUNDS = 24
"""Rounds that end a drape; on the coarse garments that networks learn on, half as many reach as far."""

FEWEST, WORK = 12, 2_400_000
"""Rounds of a mesh so fine that all of them, times its vertices, are more than ``WORK``: at 100,000 vertices 24."""


def rounds_for(mesh: Mesh, most: int) -> int:
    """How many rounds end a mesh's drape: up to ``most``, fewer where each takes long."""
    return max(FEWEST, min(most, WORK // max(mesh.vertices.shape[-2], 1)))


def edges_of(thing: Garment | Mesh, rounds: int) -> EdgeProjection:
    """Edge projection of a garment whose waistband stays; of a mesh without panels with the lengths that it has."""
    garment = Garment.of(thing)
    held = torch.as_tensor(held_vertices(garment))
    return EdgeProjection(*rest_edges(garment), len(garment.mesh.vertices), rounds, held)


@dataclass(frozen=True)
class Ending:
    """The rounds for one garment; its waistband stays where the network has it."""

    edges: EdgeProjection
    surface: Surface
    """The body's."""
    start: Start
    """The body's vertices that are nearest to the garment's at rest."""

    @classmethod
    def of(cls, garment: Garment, surface: Surface, rounds: int = ROUNDS) -> Ending:
        """Lengths are the panels', or without panels the mesh's at rest; differentiable in either."""
        return cls(edges_of(garment, rounds), surface, surface.nearest_at_rest(garment.mesh.vertices))

    def __call__(self, x: Tensor, body: PosedBody) -> Tensor:
        """Drapes (B, V, 3) [m] on B bodies -> as many; differentiable in them, in the garment and in the bodies."""
        return self.edges(x, self.surface.beside(body.mesh.vertices, self.start))
