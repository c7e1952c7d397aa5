"""Colours of scenes in which anything may be worn, however often: by layer, not by kind (a photo's go by kind)."""

from __future__ import annotations

from recon.files.meshes import Colour

SKIN: Colour = (0.86, 0.69, 0.58)
_LAYERS: tuple[Colour, ...] = (
    (0.27, 0.51, 0.76),
    (0.80, 0.42, 0.36),
    (0.38, 0.62, 0.43),
    (0.72, 0.55, 0.80),
    (0.85, 0.68, 0.32),
)


def layer_colour(number: int) -> Colour:
    """sRGB of the layer of that number; beyond the last they begin anew."""
    return _LAYERS[number % len(_LAYERS)]
