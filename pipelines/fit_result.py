"""What a fit found: the value that pipelines hand to reports, notebooks and tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.fit_garment import Layer
from recon.types import BodyPose, Camera, Mesh, Photo, Scan


@dataclass(frozen=True)
class FitResult:
    """What ``fit_photo`` or ``fit_scan`` found: the files in ``folder`` as tensors. World: feet at y = 0."""

    folder: Path
    figures: dict
    """The content of ``result.json``."""
    body_pose: BodyPose
    body: Mesh
    """(V, 3) posed body."""
    layers: tuple[Layer, ...]
    """Rest-pose garments with their panels, outermost first."""
    garments: dict[str, Mesh]
    """Name -> refined mesh (V, 3), welded and open, in the pose of the photo or scan."""
    photo: Photo | None = None
    """The evidence, where it was a photo."""
    camera: Camera | None = None
    """The camera that it was taken with."""
    scan: Scan | None = None
    """The evidence, where it was a scan, moved as the body is."""
