"""The user's own garment masks: one label PNG, or one binary PNG per garment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.types import UserError

WANTED = "wanted a label PNG with --labels 1=top,2=trousers, or one PNG per garment (top=top.png, or named top.png)"
MIN_PIXELS = 50
"""Masks with fewer pixels show no garment."""


def read_masks(
    paths: Sequence[str], labels: str | Sequence[str] | None, garments: Sequence[str], size: tuple[int, int]
) -> dict[str, Tensor]:
    """Garment masks from the user's files, in the order of ``garments``.

    Args:
        paths: with ``labels``: one PNG whose pixel values (palette index or grey level) are labels. Without: one PNG
            per garment, as ``top=any.png`` or as a file whose name without suffix is the garment's; a pixel is in when
            its grey value (or its alpha, where the image is transparent somewhere) is above half of the range.
        labels: ``1=top,2=trousers``: which label is which garment; several labels may name one garment.
        garments: the names that are fitted; each needs its mask.
        size: (H, W) of the photo.

    Returns:
        Name -> (H, W) bool, disjoint.

    Raises:
        UserError: missing or broken files, another size, empty masks, unknown labels, masks that overlap.
    """
    parsed = parse_labels(labels)
    masks = _from_labels(paths, parsed, garments, size) if parsed else _from_files(paths, garments, size)
    return _checked(masks, garments)


def read_mask(path: str | Path) -> Tensor:
    """(h, w) bool: what is opaque in one image that has transparency, else what is bright.

    Raises:
        UserError: missing, no image, or fewer than ``MIN_PIXELS`` pixels in or out of the mask.
    """
    mask = torch.as_tensor(_binary(_read_image(Path(path))))
    inside = int(mask.sum())
    if min(inside, mask.numel() - inside) < MIN_PIXELS:
        raise UserError(f"{path}: {inside} of {mask.numel()} pixels are in the mask; wanted a garment's silhouette")
    return mask


def parse_labels(labels: str | Sequence[str] | None) -> dict[int, str]:
    """``1=top,2=trousers`` (or a list of such items) -> {1: "top", 2: "trousers"}."""
    items = labels.split(",") if isinstance(labels, str) else [p for item in labels or () for p in item.split(",")]
    out: dict[int, str] = {}
    for item in filter(None, (i.strip() for i in items)):
        number, equals, name = (part.strip() for part in item.partition("="))
        if not equals or not number.isdigit() or not name:
            raise UserError(f"--labels: found {item!r}; wanted NUMBER=GARMENT, for example 1=top,2=trousers")
        if int(number) in out and out[int(number)] != name:
            raise UserError(f"--labels: label {number} names {out[int(number)]} and {name}; wanted one garment a label")
        out[int(number)] = name
    return out


def _read_image(path: Path) -> np.ndarray:
    """(H, W) labels or levels, or (H, W, C), as the file stores them; palette files give their indices."""
    from PIL import Image, UnidentifiedImageError

    if not path.is_file():
        raise UserError(f"{path}: no such file; {WANTED}")
    try:
        with Image.open(path) as image:
            image.load()
            return np.asarray(image).copy()
    except UnidentifiedImageError as error:
        raise UserError(f"{path}: not an image; {WANTED}") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise UserError(f"{path}: damaged or truncated image; {WANTED}") from error


def _same_size(path: Path, image: np.ndarray, size: tuple[int, int]) -> None:
    if image.shape[:2] != tuple(size):
        (h, w), (ph, pw) = image.shape[:2], size
        raise UserError(f"{path}: mask of {w} x {h} pixels; wanted {pw} x {ph}, the photo's size")


def _from_labels(
    paths: Sequence[str], labels: dict[int, str], garments: Sequence[str], size: tuple[int, int]
) -> dict[str, np.ndarray]:
    if len(paths) != 1:
        raise UserError(f"--masks: found {len(paths)} files with --labels; wanted one label PNG")
    unknown = sorted(set(labels.values()) - set(garments))
    if unknown:
        raise UserError(f"--labels: found {', '.join(unknown)}; wanted garments of --garments: {', '.join(garments)}")
    path = Path(paths[0])
    image = _read_image(path)
    _same_size(path, image, size)
    if image.ndim == 3 and image.shape[2] <= 4 and (image[..., :1] == image[..., : min(3, image.shape[2])]).all():
        image = image[..., 0]  # grey saved as RGB
    if image.ndim != 2:
        raise UserError(f"{path}: a colour image; wanted labels as palette indices or grey levels")
    image = image.astype(np.int64)
    present = [int(v) for v in np.unique(image)]
    missing = sorted(set(labels) - set(present))
    if missing:
        shown = ", ".join(map(str, present[:12])) + (" ..." if len(present) > 12 else "")
        raise UserError(f"{path}: no pixel has label {', '.join(map(str, missing))}; found labels {shown}")
    return {g: np.isin(image, [k for k, v in labels.items() if v == g]) for g in garments if g in labels.values()}


def _from_files(paths: Sequence[str], garments: Sequence[str], size: tuple[int, int]) -> dict[str, np.ndarray]:
    masks: dict[str, np.ndarray] = {}
    for item in paths:
        name, equals, file = item.partition("=")
        path = Path(file if equals and name in garments else item)
        name = name if equals and name in garments else path.stem
        if equals and not path.is_file() and item.partition("=")[0] not in garments and Path(file).is_file():
            raise UserError(f"--masks: found {item.partition('=')[0]}; wanted one of --garments: {', '.join(garments)}")
        if name not in garments:
            raise UserError(f"{path}: which garment is this? {WANTED}; garments: {', '.join(garments)}")
        if name in masks:
            raise UserError(f"{path}: a second mask for {name}; wanted one")
        image = _read_image(path)
        _same_size(path, image, size)
        masks[name] = _binary(image)
    return masks


def _binary(image: np.ndarray) -> np.ndarray:
    """(H, W) bool of an image as it is stored."""
    if image.dtype == bool:
        return image
    if image.ndim == 3 and image.shape[2] in (2, 4) and (image[..., -1] < 255).any():
        return image[..., -1] > 127
    level = image[..., : 3 if image.shape[2] >= 3 else 1].max(-1) if image.ndim == 3 else image
    # 0/1 masks and palette indices of two colours count as binary as well as 0/255.
    return level > (level.max() / 2 if level.max() <= 127 else np.iinfo(level.dtype).max / 2)


def _checked(masks: dict[str, np.ndarray], garments: Sequence[str]) -> dict[str, Tensor]:
    missing = [g for g in garments if g not in masks]
    if missing:
        raise UserError(f"--masks: no mask for {', '.join(missing)}; {WANTED}")
    taken = np.zeros(next(iter(masks.values())).shape, bool)
    out: dict[str, Tensor] = {}
    for name in garments:
        mask = masks[name]
        if mask.sum() < MIN_PIXELS:
            raise UserError(f"--masks: the mask of {name} has {int(mask.sum())} pixels; wanted at least {MIN_PIXELS}")
        both = int((mask & taken).sum())
        if both > 0.01 * mask.sum():
            raise UserError(f"--masks: {name} shares {both} pixels with another garment; wanted no overlap")
        out[name] = torch.from_numpy(mask & ~taken)
        taken |= mask
    return out
