"""Any draper, followed by projective steps: what a network or skinning leaves in stretch and skin is put right.

Which garments are drawn where is the draper's knowledge; the steps (:mod:`recon.cloth.projective`) know only cloth and
body. For drapes that are wanted as they are: through the steps no gradient flows.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from recon.cloth.energies import Cloth
from recon.cloth.projective import Projecting, Projective
from recon.draping import Draper
from recon.draping.dress import held_vertices
from recon.draping.skinning import SkinningDraper
from recon.types import Garment, Mesh, PosedBody

ANY_POSE = Projecting(anchor=60.0, shallow=0.01)
"""For bodies of any shape in any pose, whose parts lie in each other more than those of a recorded motion: there, cloth
that is drawn out of a part that it does not ride on is mostly stretched."""


class ProjectedDraper:
    """A ``Draper``: another one, and projective steps after it."""

    def __init__(self, draper: Draper, skinning: SkinningDraper, settings: Projecting | None = None):
        """``skinning`` says which part of the body each vertex rides on."""
        self.draper, self.skinning, self.settings = draper, skinning, settings or ANY_POSE
        self._last: tuple[Tensor, Projective] | None = None

    def prepared(self, garment: Garment) -> Projective:
        """The steps for a garment; the last one's are remembered."""
        rest = garment.mesh.vertices
        if self._last is None or self._last[0] is not rest:
            weights = self.skinning.bind(rest.detach(), garment.mesh.faces)[0]
            steps = Projective(Cloth.from_garment(garment), weights, held_vertices(garment), self.settings)
            self._last = rest, steps
        return self._last[1]

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on B bodies: Mesh with (B, V, 3) vertices; not differentiable."""
        found = self.draper.drape(garment, body, under)
        return found.with_vertices(self.prepared(garment)(found.vertices, body))
