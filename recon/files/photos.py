"""Photos as upright 8-bit RGB tensors, whatever the file stores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.types import UserError

MIN_SIDE = 128
"""Shorter photos show no person that could be fitted [px]."""
MAX_PIXELS = 200_000_000
"""More would fill the memory."""


def read_photo(path: str | Path) -> Tensor:
    """A photo as (H, W, 3) uint8 RGB, turned upright by its EXIF orientation.

    Palette, grey, CMYK and 16-bit files become 8-bit RGB; transparent pixels are put on white, as viewers do.

    Raises:
        UserError: the file is missing, no image, truncated, too small or too large.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; wanted a photo (JPEG, PNG, WebP, TIFF or BMP)")
    try:
        with Image.open(path) as image:
            w, h = image.size
            if w * h > MAX_PIXELS:
                raise UserError(f"{path}: {w} x {h} pixels; wanted at most {MAX_PIXELS // 1_000_000} megapixels")
            image.load()
            pixels = _to_rgb(ImageOps.exif_transpose(image))
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise UserError(f"{path}: no image that can be read; wanted a JPEG, PNG, WebP, TIFF or BMP photo") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise UserError(f"{path}: damaged or truncated image ({_first_line(error)}); wanted a whole file") from error
    h, w = pixels.shape[:2]
    if min(h, w) < MIN_SIDE:
        raise UserError(f"{path}: {w} x {h} pixels; wanted at least {MIN_SIDE} on the shorter side")
    return torch.from_numpy(pixels)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _to_rgb(image) -> np.ndarray:
    """(H, W, 3) uint8 of a loaded Pillow image of any mode."""
    from PIL import Image

    if image.mode.startswith(("I", "F")):  # 16-bit grey; 32-bit TIFFs land here, too
        values = np.asarray(image).astype(np.float64)
        top = 65535.0 if image.mode != "F" and values.max(initial=0) > 255 else max(float(values.max(initial=0)), 1e-9)
        top = 255.0 if image.mode == "I" and values.max(initial=0) <= 255 else top
        grey = np.clip(values / top * 255 + 0.5, 0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, -1)
    if image.mode in ("LA", "PA", "RGBA", "La", "RGBa") or "transparency" in image.info:
        rgba = image.convert("RGBA")
        white = Image.new("RGBA", rgba.size, (255, 255, 255, 255))
        image = Image.alpha_composite(white, rgba)
    return np.array(image.convert("RGB"))
