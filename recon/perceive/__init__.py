"""From a photo to its evidence: landmarks, the person's mask and one mask for each garment that the user names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module

from torch import Tensor

from recon.types import Photo, UserError

SOURCES: dict[str, str] = {"photo": "recon.perceive.photo:perceive"}
"""Source of the evidence -> ``module:function`` of (rgb, garments, person, masks); a new one is a line here."""


def perceive(
    rgb: Tensor,
    garments: Sequence[str],
    person: int | None = None,
    masks: Mapping[str, Tensor] | None = None,
    source: str = "photo",
) -> Photo:
    """What a photo shows of one person and the named garments; networks are loaded when it is called, not before.

    Args:
        rgb: (H, W, 3) uint8, upright.
        garments: garment names (``recon.garments.NAMES``); they come back outermost first.
        person: which of several people, 1 = the largest; without it the largest, with a note.
        masks: the user's own masks, name -> (H, W) bool.
        source: who perceives, a key of ``SOURCES``.

    Raises:
        UserError: an unknown source, nobody found, or names that are unknown or cannot be worn together.
    """
    if source not in SOURCES:
        raise UserError(f"source: found {source}; wanted one of {', '.join(SOURCES)}")
    module, _, function = SOURCES[source].partition(":")
    return getattr(import_module(module), function)(rgb, garments, person, masks)
