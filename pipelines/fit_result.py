"""What a fit found: the value that pipelines hand to reports, notebooks and tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.fit_garment import Layer
from recon.types import BodyPose, Camera, Mesh, Photo


@dataclass(frozen=True)
class FitResult:
    """What ``fit_photo`` found; the same as the files in ``folder``, as tensors. World: feet at y = 0."""

    folder: Path
    figures: dict
    """The content of ``result.json``."""
    photo: Photo
    camera: Camera
    body_pose: BodyPose
    body: Mesh
    """(V, 3) posed body."""
    layers: tuple[Layer, ...]
    """Rest-pose garments with their panels, outermost first."""
    garments: dict[str, Mesh]
    """Name -> refined mesh (V, 3), welded and open, in the pose of the photo."""
