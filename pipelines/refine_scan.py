"""Stage 'refine' of a scan: free vertices under physics and the two-way distance to the scan (DrapeNet Eq. 16)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.fit_garment import Layer, Models
from pipelines.fit_scan_garment import TwoWay
from pipelines.refine import Evidence, Refined, Refinement, refine_with
from recon.types import PosedBody, Scan


@dataclass(frozen=True)
class ScanRefinement:
    """Settings of the refine stage."""

    cloth: Refinement = field(default_factory=lambda: Refinement(steps=60, gradings=2))
    """Dressing, physics and untangling; silhouettes' settings play no part."""
    pull: float = 250.0
    """Energy of a whole garment that is ``reach`` or more away from its scan [J]."""
    reach: float = 0.03
    """Distance at which points stop pulling harder [m]."""
    points: int = 4000
    """Scan points of each garment that are asked for their distance to it."""


class ToScan:
    """The layers' two-way distance to their points as an energy."""

    def __init__(self, scan: Scan, names: tuple[str, ...], faces: list[Tensor], settings: ScanRefinement):
        """``names`` and ``faces`` (F, 3) of the layers, outermost first."""
        self.faces, self.settings = faces, settings
        self.distances = [TwoWay(scan, name, names[:k], settings.points) for k, name in enumerate(names)]

    def __call__(self, parts: list[NDArray]) -> tuple[float, NDArray]:
        """Vertices (V, 3) of each layer -> energy [J] and its gradient [N], stacked."""
        total, gradients = 0.0, []
        for part, faces, distance in zip(parts, self.faces, self.distances, strict=True):
            x = torch.from_numpy(part).to(distance.points).requires_grad_()
            with torch.enable_grad():
                energy = 0.5 * self.settings.pull * distance(x, faces, self.settings.reach)
                (gradient,) = torch.autograd.grad(energy, x)
            total += energy.item()
            gradients.append(gradient.cpu().double().numpy())
        return total, np.concatenate(gradients)


def refine_scan(
    values: dict[str, Tensor],
    layers: list[Layer],
    scan: Scan,
    models: Models,
    settings: ScanRefinement,
    tick: Callable[[int, float], None] | None = None,
) -> Refined:
    """Refine all layers together under the scan.

    Args:
        values: the body of the last garment's stage.
        layers: outermost first.
        scan: the evidence.
        models: body and draper.
        settings: see :class:`ScanRefinement`.
        tick: hears (step, energy).
    """

    def distances(posed: PosedBody, faces: list[Tensor]) -> Evidence:
        return ToScan(scan, tuple(layer.name for layer in layers), faces, settings)

    return refine_with(distances, values, layers, models, settings.cloth, tick)
