"""The pose networks: finding people, their landmarks, axes and masks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.perceive.blazepose import Crop, people, suppress

DEMO = "man-hoodie-trousers.jpg"


def test_suppress_merges_overlaps_and_keeps_the_rest() -> None:
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [20, 20, 30, 30.0]])
    values, best = suppress(boxes, np.array([0.6, 0.9, 0.7]), np.array([[0.0], [3.0], [7.0]]))
    assert values.shape == (2, 1) and best.tolist() == [0.9, 0.7]
    assert values[0, 0] == pytest.approx(3 * 0.9 / 1.5) and values[1, 0] == 7
    assert len(suppress(np.zeros((0, 4)), np.zeros(0), np.zeros((0, 4)))[0]) == 0


def test_crop_maps_its_points() -> None:
    crop = Crop.around(np.array([50.0, 60.0]), np.array([70.0, 60.0]))  # a body lying to the right
    assert crop.side == pytest.approx(50) and crop.angle == pytest.approx(np.pi / 2)
    centre = crop.to_photo @ [128, 128, 1]
    up = crop.to_photo @ [128, 0, 1] - centre
    assert np.allclose(centre, [50, 60]) and np.allclose(up / np.linalg.norm(up), [1, 0])


def test_landmarks_and_world_axes(bundled) -> None:
    rgb = bundled(DEMO)
    found = people(rgb)
    assert len(found) == 1
    person = found[0]
    assert person.landmarks.shape == person.world.shape == (33, 3) and person.mask.shape == rgb.shape[:2]
    assert person.score > 0.9 and person.landmarks[:, 2].min() > 0.3
    p, w = person.landmarks, person.world
    # In the photo: left shoulder on the right, head above hips above ankles.
    assert p[11, 0] > p[12, 0] and p[0, 1] < p[23, 1] < p[27, 1]
    # In the world: wearer's left = +x, y up, facing +z (the nose is before the ears).
    assert w[11, 0] > w[12, 0] and w[0, 1] > w[11, 1] > 0 > w[25, 1] > w[27, 1]
    assert w[0, 2] > w[7:9, 2].mean() and np.abs(w[23:25].mean(0)).max() < 0.05


def test_a_small_person_and_a_turned_photo(bundled) -> None:
    rgb = bundled(DEMO)
    whole = people(rgb)[0]
    small = cv2.resize(rgb, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    h, w = small.shape[:2]
    padded = cv2.copyMakeBorder(small, 1024 - h, 0, 300, 1024 - w - 300, cv2.BORDER_REPLICATE)
    found = people(padded)
    assert len(found) >= 1
    at = whole.landmarks[:, :2] * 0.3 + [300, 1024 - h]
    assert np.linalg.norm(found[0].landmarks[:, :2] - at, axis=1).mean() < 0.06 * whole.size * 0.3
    turned = np.ascontiguousarray(np.rot90(rgb))
    assert people(turned)[0].landmarks[0, 0] < people(turned)[0].landmarks[27, 0]


def test_several_people_largest_first(bundled) -> None:
    right = cv2.resize(bundled("woman-open-blazer-trousers.jpg"), (687, 1024), interpolation=cv2.INTER_AREA)
    found = people(np.hstack([bundled(DEMO), right]))
    assert len(found) == 2
    assert found[0].size > found[1].size and found[0].landmarks[0, 0] > 768 > found[1].landmarks[0, 0]


def test_nobody() -> None:
    assert people(np.full((240, 320, 3), 128, np.uint8)) == []
    assert people(np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)) == []
