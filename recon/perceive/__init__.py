"""From a photo to its evidence: landmarks, the person's mask and one mask for each garment that the user names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from recon.types import Photo


def perceive(
    rgb: Tensor, garments: Sequence[str], person: int | None = None, masks: Mapping[str, Tensor] | None = None
) -> Photo:
    """See :func:`recon.perceive.photo.perceive`, which is imported (with its networks) only when it is called."""
    from recon.perceive import photo

    return photo.perceive(rgb, garments, person, masks)
