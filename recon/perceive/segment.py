"""The person's mask with crisp borders: the landmark network's coarse mask, GrabCut where it is unsure, guided filter.

GrabCut: Rother et al. 2004; guided filter: He et al. 2010 (both OpenCV's).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

LONG_SIDE = 512
"""Longer side of the person's window while it is taken apart [px]; borders are sharpened on the photo's own pixels."""


@dataclass(frozen=True)
class Window:
    """The person's part of the photo, at the resolution at which it is taken apart."""

    box: tuple[int, int, int, int]
    """x0, y0, x1, y1 in pixels of the photo."""
    scale: float
    """Working pixels a photo pixel, at most 1 for a large person; small people are enlarged."""

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) in working pixels."""
        x0, y0, x1, y1 = self.box
        return max(8, round((y1 - y0) * self.scale)), max(8, round((x1 - x0) * self.scale))

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The window of an image of the photo's size, in working pixels."""
        x0, y0, x1, y1 = self.box
        h, w = self.size
        how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        return cv2.resize(np.ascontiguousarray(image[y0:y1, x0:x1]), (w, h), interpolation=how)

    def points(self, landmarks: np.ndarray) -> np.ndarray:
        """(N, 2+) pixels of the photo -> (N, 2) working pixels."""
        return (landmarks[:, :2] - np.array(self.box[:2])) * self.scale


def window_around(mask: np.ndarray, landmarks: np.ndarray) -> Window:
    """The window of a person's (H, W) mask and (33, 3) landmarks with a margin of 5 % of its longer side."""
    h, w = mask.shape
    ys, xs = np.nonzero(mask > 0.3)
    seen = landmarks[landmarks[:, 2] > 0.5, :2]
    corners = np.vstack([np.column_stack([xs, ys]), seen]) if len(xs) else seen
    (x0, y0), (x1, y1) = corners.min(0), corners.max(0) + 1
    pad = 0.05 * max(x1 - x0, y1 - y0)
    box = int(max(0, x0 - pad)), int(max(0, y0 - pad)), int(min(w, x1 + pad + 1)), int(min(h, y1 + pad + 1))
    side = max(box[2] - box[0], box[3] - box[1])
    return Window(box, float(np.clip(LONG_SIDE / side, 0.05, 2.0)))


def guided(guide: np.ndarray, values: np.ndarray, radius: int, eps: float) -> np.ndarray:
    """Guided filter of (h, w) or (h, w, C) float values under a colour guide (h, w, 3) uint8."""
    engine = cv2.ximgproc.createGuidedFilter(guide.astype(np.float32) / 255, radius, eps)
    layers = values[..., None] if values.ndim == 2 else values
    planes = [np.ascontiguousarray(layers[..., k], np.float32) for k in range(layers.shape[-1])]
    out = np.stack([engine.filter(plane) for plane in planes], -1)
    return out[..., 0] if values.ndim == 2 else out


def _disk(radius: float) -> np.ndarray:
    n = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (n, n))


def person_mask(rgb: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """(h, w) float32 probability of the person: the network's mask with its border moved to the image's edges.

    Args:
        rgb: (h, w, 3) uint8, the person's window.
        coarse: (h, w) the network's probability in the same window.
    """
    reach = 0.014 * max(rgb.shape[:2])
    state = np.where(coarse > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    state[cv2.erode((coarse > 0.8).astype(np.uint8), _disk(reach)) > 0] = cv2.GC_FGD
    state[cv2.dilate((coarse > 0.3).astype(np.uint8), _disk(reach)) == 0] = cv2.GC_BGD
    cut = coarse > 0.5
    if (state == cv2.GC_FGD).any() and (state == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        bgr = np.ascontiguousarray(rgb[..., ::-1])
        cv2.grabCut(bgr, state, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
        cut = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    # The network keeps a say: where person and background have one colour, GrabCut's border is a guess.
    mixed = 0.7 * cut + 0.3 * coarse
    soft = np.clip(guided(rgb, mixed.astype(np.float32), max(2, round(reach / 2)), 1e-4), 0, 1)
    solid = cv2.morphologyEx((soft > 0.5).astype(np.uint8), cv2.MORPH_OPEN, _disk(1))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(solid)
    if count > 1:
        # Limbs behind a held thing come apart; specks of background do not count.
        large = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] > 0.02 * stats[1:, cv2.CC_STAT_AREA].max())
        soft[~np.isin(parts, large)] = np.minimum(soft, 0.49)[~np.isin(parts, large)]
    return soft
