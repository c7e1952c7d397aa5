"""How far a mask can be trusted, from what decided it: colours, ends and the pose."""

from __future__ import annotations

import cv2
import numpy as np

from recon.perceive.parse import Parsed
from recon.perceive.zones import JACKET, LAYERS, LOWER, TOP

POSE_POINTS = {JACKET: (11, 12, 13, 14, 23, 24), TOP: (11, 12, 23, 24), LOWER: (23, 24, 25, 26, 27, 28)}
"""The landmarks that say where a layer is."""


def pose_confidence(landmarks: np.ndarray) -> float:
    """Mean visibility of shoulders, elbows, wrists, hips, knees and ankles."""
    return float(landmarks[[*range(11, 17), *range(23, 29)], 2].mean())


def garment_confidence(layer: int, parsed: Parsed, person: np.ndarray, landmarks: np.ndarray) -> float:
    """Confidence in [0, 1]: how much of the mask's border colours alone confirm, times visibility.

    Borders against other layers count; those against the background are the person mask's business.

    A border is confirmed at a pixel near it when the pixel's colour likes its own layer better than the neighbour's; of
    two layers of one colour half of the pixels do so by chance, which counts as nothing.

    Args:
        layer: JACKET, TOP or LOWER.
        parsed: the split.
        person: (h, w) bool.
        landmarks: (33, 3).
    """
    labels = np.where(person, parsed.belief.argmax(-1), LAYERS)
    own = labels == layer
    if own.sum() < 50:
        return 0.0
    reach = np.ones((2 * max(3, round(0.012 * max(person.shape))) + 1,) * 2, np.uint8)
    near_own = cv2.dilate(own.astype(np.uint8), reach) > 0
    agreed, total = 0.0, 0.0
    for other in range(LAYERS):
        theirs = labels == other
        band_theirs = theirs & near_own
        if other == layer or band_theirs.sum() < 20:
            continue
        band_own = own & (cv2.dilate(theirs.astype(np.uint8), reach) > 0)
        margin = parsed.colour[..., layer] - parsed.colour[..., other]
        right = 0.5 * ((margin[band_own] > 0.5).mean() + (margin[band_theirs] < -0.5).mean())
        agreed += float(np.clip(2 * right - 1, 0, 1)) * band_own.sum()
        total += band_own.sum()
    colours = agreed / total if total else 1.0
    visible = float(landmarks[list(POSE_POINTS[layer]), 2].mean())
    solid = float(parsed.belief[..., layer][own].mean())
    return round(float((0.25 + 0.75 * colours) * visible * solid), 3)
