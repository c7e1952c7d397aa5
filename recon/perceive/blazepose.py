"""People in a photo: BlazePose's detector and landmark network (vendored, Apache-2.0) through ai-edge-litert.

The detector looks at the letterboxed photo and answers with boxes and two key points a person (middle of the hips and a
point on the circle round the whole body). The landmark network looks at the upright square crop that these two points
span and answers with 33 landmarks in the crop, 33 world landmarks and a person mask. A second pass takes its crop
from the first pass's own landmarks, which centres people whom the detector placed badly.

Source of the network's formats: the model cards of MediaPipe BlazePose GHUM 3D and the networks' own tensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import as_file, files

import cv2
import numpy as np

DETECTOR_SIDE, CROP_SIDE = 224, 256
MIN_SCORE = 0.5
"""Detections and crops that score less than this are no people."""
MIN_IOU = 0.3
"""Boxes that overlap more than this are the same person (weighted non-maximum suppression)."""


@dataclass(frozen=True)
class Crop:
    """The upright square that the landmark network sees."""

    centre: np.ndarray
    """(2,) pixels of the photo: the middle of the hips."""
    side: float
    """Side of the square [px]."""
    angle: float
    """Clockwise turn of the body from upright [rad]."""

    @property
    def to_photo(self) -> np.ndarray:
        """(2, 3) affine map from the network's 256 x 256 pixels to the photo's."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[c, -s], [s, c]]) * self.side / CROP_SIDE
        return np.hstack([turn, (self.centre - turn @ [CROP_SIDE / 2, CROP_SIDE / 2])[:, None]])

    @staticmethod
    def around(hips: np.ndarray, circle: np.ndarray) -> Crop:
        """The crop from BlazePose's two alignment points."""
        d = circle - hips
        return Crop(hips, 2 * 1.25 * float(np.linalg.norm(d)), float(np.arctan2(d[0], -d[1])))


@dataclass(frozen=True)
class Person:
    """One person as BlazePose sees them."""

    landmarks: np.ndarray
    """(33, 3) x, y in pixels of the photo, visibility in [0, 1]."""
    world: np.ndarray
    """(33, 3) origin at the hips, x right in the photo, y up, +z towards the camera; not to metric scale."""
    mask: np.ndarray
    """(H, W) float32, probability of the person."""
    score: float
    """Probability that there is a person in the crop."""
    crop: Crop
    """Where the network looked."""

    @property
    def size(self) -> float:
        """Extent of the landmarks [px], the longer side of their box."""
        return float(np.ptp(self.landmarks[:, :2], axis=0).max())


@lru_cache(maxsize=1)
def _anchors() -> np.ndarray:
    """(2254, 2) anchor centres in [0, 1]: cells of strides 8 (2 a cell), 16 (2) and 32 (6)."""
    out = []
    for stride, per_cell in ((8, 2), (16, 2), (32, 6)):
        n = DETECTOR_SIDE // stride
        rows, columns = np.mgrid[:n, :n]
        centres = np.stack([(columns + 0.5) / n, (rows + 0.5) / n], -1).reshape(-1, 1, 2)
        out.append(np.repeat(centres, per_cell, 1).reshape(-1, 2))
    return np.concatenate(out)


@lru_cache(maxsize=2)
def _network(name: str):
    from ai_edge_litert.interpreter import Interpreter

    with as_file(files("recon.perceive") / "models" / name) as path:
        network = Interpreter(model_content=path.read_bytes(), num_threads=2)
    network.allocate_tensors()
    return network


def _run(name: str, image: np.ndarray) -> list[np.ndarray]:
    network = _network(name)
    network.set_tensor(network.get_input_details()[0]["index"], image[None].astype(np.float32))
    network.invoke()
    return [network.get_tensor(o["index"])[0].copy() for o in network.get_output_details()]


def sigmoid(x: np.ndarray) -> np.ndarray:
    """The logistic function, safe for large inputs."""
    return 1 / (1 + np.exp(-np.clip(x, -80, 80)))


def suppress(boxes: np.ndarray, scores: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted non-maximum suppression (Bazarevsky et al. 2019, BlazeFace, section 4): overlapping answers average.

    Args: boxes (N, 4) as x0, y0, x1, y1; scores (N,); values (N, D) what to average.
    Returns: averaged values (M, D) and best scores (M,), best first.
    """
    order = np.argsort(-scores, kind="stable")
    boxes, scores, values = boxes[order], scores[order], values[order]
    area = (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(1)
    out, best = [], []
    left = np.arange(len(scores))
    while len(left):
        i = left[0]
        inner = np.minimum(boxes[left, 2:], boxes[i, 2:]) - np.maximum(boxes[left, :2], boxes[i, :2])
        both = inner.clip(0).prod(1)
        same = both > MIN_IOU * (area[left] + area[i] - both)
        same[0] = True
        group = left[same]
        out.append(np.average(values[group], axis=0, weights=scores[group]))
        best.append(scores[i])
        left = left[~same]
    return np.array(out).reshape(-1, values.shape[1]), np.array(best)


def detect(rgb: np.ndarray) -> list[Crop]:
    """All people that the detector sees in rgb (H, W, 3) uint8, as crops for the landmark network.

    Where it sees nobody in the whole photo it looks again in overlapping tiles of half the size: people less than a
    fifth of the photo's height are too small for it.
    """
    whole = _detect(rgb)
    if whole:
        return whole
    h, w = rgb.shape[:2]
    side = max(min(h, w, max(h, w) // 2), DETECTOR_SIDE)
    crops = []
    for y in sorted({*range(0, max(h - side, 0) + 1, max(side // 2, 1)), max(h - side, 0)}):
        for x in sorted({*range(0, max(w - side, 0) + 1, max(side // 2, 1)), max(w - side, 0)}):
            tile = np.ascontiguousarray(rgb[y : y + side, x : x + side])
            crops += [replace(c, centre=c.centre + [x, y]) for c in _detect(tile)]
    return crops


def _detect(rgb: np.ndarray) -> list[Crop]:
    h, w = rgb.shape[:2]
    scale = max(h, w) / DETECTOR_SIDE
    small = cv2.resize(rgb, (max(1, round(w / scale)), max(1, round(h / scale))), interpolation=cv2.INTER_AREA)
    top, left = (DETECTOR_SIDE - small.shape[0]) // 2, (DETECTOR_SIDE - small.shape[1]) // 2
    square = np.zeros((DETECTOR_SIDE, DETECTOR_SIDE, 3), np.uint8)
    square[top : top + small.shape[0], left : left + small.shape[1]] = small
    rows, logits = _run("pose_detection.tflite", square / 127.5 - 1)
    scores = sigmoid(logits[:, 0])
    strong = scores > MIN_SCORE
    anchors = _anchors()[strong]
    centre = rows[strong, :2] / DETECTOR_SIDE + anchors
    half = rows[strong, 2:4] / DETECTOR_SIDE / 2
    points = (rows[strong, 4:8].reshape(-1, 2, 2) / DETECTOR_SIDE + anchors[:, None]).reshape(-1, 4)
    values, _ = suppress(np.hstack([centre - half, centre + half]), scores[strong], points)
    values = values.reshape(-1, 2, 2) * DETECTOR_SIDE
    values = (values - [left, top]) * scale
    return [Crop.around(hips, circle) for hips, circle in values]


def _refined(points: np.ndarray, heat: np.ndarray) -> np.ndarray:
    """(N, 2) landmarks in crop pixels, moved to the centre of mass of their heat map's 7 x 7 neighbourhood."""
    out, cell, n = points.copy(), CROP_SIDE / heat.shape[0], heat.shape[0]
    for j, (x, y) in enumerate((points / cell).astype(int)):
        if not (0 <= x < n and 0 <= y < n):
            continue
        rows, columns = slice(max(0, y - 3), min(n, y + 4)), slice(max(0, x - 3), min(n, x + 4))
        p = heat[rows, columns, j]
        if p.max() >= 0.5:
            yy, xx = np.mgrid[rows, columns]
            out[j] = (xx * p).sum() / p.sum() * cell, (yy * p).sum() / p.sum() * cell
    return out


def _look(rgb: np.ndarray, crop: Crop) -> tuple[Person, Crop]:
    """One pass of the landmark network; also the crop that its own landmarks ask for."""
    h, w = rgb.shape[:2]
    to_photo = crop.to_photo
    source, scaled = rgb, to_photo
    if crop.side > 2 * CROP_SIDE:  # shrink first, or the crop aliases
        f = CROP_SIDE / crop.side
        source = cv2.resize(rgb, None, fx=f, fy=f, interpolation=cv2.INTER_AREA)
        scaled = to_photo * f
    seen = cv2.warpAffine(source, scaled, (CROP_SIDE, CROP_SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    rows, flag, logits, heat, world = _run("pose_landmark_full.tflite", seen / 255.0)
    rows = rows.reshape(39, 5)
    points = _refined(rows[:, :2].astype(np.float64), sigmoid(heat)) @ to_photo[:, :2].T + to_photo[:, 2]
    turned = world.reshape(39, 3)[:33].astype(np.float64)
    turned[:, :2] = turned[:, :2] @ (to_photo[:, :2] * CROP_SIDE / crop.side).T
    mask = cv2.warpAffine(sigmoid(logits[..., 0]).astype(np.float32), to_photo, (w, h), flags=cv2.INTER_LINEAR)
    person = Person(
        landmarks=np.column_stack([points[:33], sigmoid(rows[:33, 3])]),
        world=turned * [1, -1, -1],  # the network's y points down and its z away from the camera
        mask=mask,
        score=float(flag[0]),
        crop=crop,
    )
    return person, Crop.around(points[33], points[34])


def people(rgb: np.ndarray) -> list[Person]:
    """Everybody in rgb (H, W, 3) uint8, the largest first."""
    found: list[Person] = []
    for crop in sorted(detect(rgb), key=lambda c: -c.side)[:12]:
        person, closer = _look(rgb, crop)
        for _ in range(2):
            if person.score < MIN_SCORE:
                break
            again, next_crop = _look(rgb, closer)
            if again.score < MIN_SCORE:
                break
            settled = abs(closer.side / person.crop.side - 1) < 0.15
            person, closer = again, next_crop
            if settled:
                break
        if person.score >= MIN_SCORE and not any(_same(person, other) for other in found):
            found.append(person)
    return sorted(found, key=lambda p: -p.size)


def _same(a: Person, b: Person) -> bool:
    hips = a.landmarks[23:25, :2].mean(0) - b.landmarks[23:25, :2].mean(0)
    nose = a.landmarks[0, :2] - b.landmarks[0, :2]
    return bool(max(np.linalg.norm(hips), np.linalg.norm(nose)) < 0.15 * max(a.size, b.size))
