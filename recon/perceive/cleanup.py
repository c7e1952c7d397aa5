"""From probabilities in the person's window to crisp masks of the photo without holes and islands."""

from __future__ import annotations

import cv2
import numpy as np

from recon.perceive.segment import Window, guided
from recon.perceive.zones import BACKGROUND, JACKET, LAYERS, LOWER, TOP

NOBODY = 255
"""Label of pixels outside of the person."""
ISLAND = 0.012
"""Components smaller than this share of their garment are no part of it."""
HOLE = 0.01
"""Holes smaller than this share of the garment belong to it (buttons, prints, belts)."""


def sharpen(image: np.ndarray, window: Window, soft: np.ndarray, belief: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Person and labels on the photo's own pixels of the window's box.

    Args:
        image: (H, W, 3) uint8, the photo.
        window: the person's window.
        soft: (h, w) probability of the person in the window.
        belief: (h, w, LAYERS) probabilities of the layers in the window.

    Returns:
        (bh, bw) float32 probability of the person, (bh, bw) uint8 layer or ``NOBODY``.
    """
    x0, y0, x1, y1 = window.box
    guide = np.ascontiguousarray(image[y0:y1, x0:x1])
    radius = max(2, round(1.5 / window.scale))

    def enlarge(values: np.ndarray) -> np.ndarray:
        how = cv2.INTER_AREA if window.scale > 1 else cv2.INTER_LINEAR
        return cv2.resize(values, (x1 - x0, y1 - y0), interpolation=how)

    person = np.clip(guided(guide, enlarge(soft), radius, 1e-4), 0, 1).astype(np.float32)
    alive = [k for k in range(LAYERS) if belief[..., k].any()]
    layers = np.stack([enlarge(belief[..., k]) for k in alive], -1)
    if window.scale < 1:
        layers = guided(guide, layers, radius, 1e-4)
    labels = np.array(alive, np.uint8)[layers.argmax(-1)]
    person[labels == BACKGROUND] = np.minimum(person, 0.3)[labels == BACKGROUND]
    labels[person <= 0.5] = NOBODY
    return person, labels


def tidy(labels: np.ndarray) -> np.ndarray:
    """Labels without small islands of garments and without small holes in them; islands go to their surroundings."""
    out = labels.copy()
    for layer in (JACKET, TOP, LOWER):
        mask = (out == layer).astype(np.uint8)
        count, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        if count < 2:
            continue
        area = stats[1:, cv2.CC_STAT_AREA]
        small = 1 + np.flatnonzero(area < ISLAND * area.sum())
        island = np.isin(parts, small) & (mask > 0)
        out[island] = _surroundings(out, island)[island]
    for layer in (JACKET, TOP, LOWER):
        mask = (out == layer).astype(np.uint8)
        count, parts, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
        small = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] < HOLE * max(1, int(mask.sum())))
        hole = np.isin(parts, small) & (mask == 0)
        # Only what the garment surrounds: a notch between two layers is none of its holes.
        rim = (cv2.dilate(hole.astype(np.uint8), np.ones((3, 3))) > 0) & ~hole
        _, rims = cv2.connectedComponents(hole.astype(np.uint8), connectivity=4)
        grown = cv2.dilate(rims.astype(np.float32), np.ones((3, 3)))
        total = np.bincount(grown[rim].astype(int), minlength=rims.max() + 1)
        own = np.bincount(grown[rim & (mask > 0)].astype(int), minlength=rims.max() + 1)
        filled = own > 0.8 * np.maximum(total, 1)
        filled[0] = False
        out[filled[rims]] = layer
    return out


def _surroundings(labels: np.ndarray, island: np.ndarray) -> np.ndarray:
    """(h, w) label of the nearest pixel that is no island."""
    _, nearest = cv2.distanceTransformWithLabels(
        island.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(nearest.max()) + 1, labels.dtype)
    table[nearest[~island]] = labels[~island]
    return table[nearest]
