"""Textures for panels: images twice as wide as high, front left, back right."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.files.atomic import write_whole
from recon.types import UserError

WANTED = "wanted an RGB image twice as wide as high: front panel left, back panel right"


def read_texture(path: str | Path) -> Tensor:
    """(h, 2 h, 3) sRGB in [0, 1]; what is transparent becomes white.

    Raises:
        UserError: missing, no image, or of another aspect.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; {WANTED}")
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UserError(f"{path}: not an image; {WANTED}")
    h, w = image.shape[:2]
    if w != 2 * h or h < 16:
        raise UserError(f"{path}: {w} x {h} pixels; {WANTED}")
    level = image.astype(np.float32) / np.iinfo(image.dtype).max
    if level.ndim == 2:
        level = level[..., None].repeat(3, 2)
    if level.shape[2] == 4:
        level = level[..., :3] * level[..., 3:] + 1 - level[..., 3:]
    return torch.from_numpy(level[..., ::-1].copy())


def write_png(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write an image (h, w, 3) BGR."""
    write_whole(path, cv2.imencode(".png", image)[1].tobytes())
