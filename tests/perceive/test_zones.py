"""Ends of garments along limbs, on made scores."""

from __future__ import annotations

import numpy as np
import pytest

from recon.perceive.zones import ZONES, Range, limb_ends, waist_split

PLACES = np.linspace(0, 2.4, 4000)


def step(at: float, strength: float) -> tuple[np.ndarray, np.ndarray]:
    return PLACES, np.where(PLACES < at, -strength, strength)


def test_limb_ends_follow_clear_colours() -> None:
    (left, sure), (right, _) = limb_ends([step(0.7, 4), step(1.5, 4)], Range(0, 1.2, 2.2), (0, 2.4), 6.0)
    assert left == pytest.approx(0.7, abs=0.05) and right == pytest.approx(1.5, abs=0.05) and sure > 0.8


def test_limb_ends_are_alike_where_one_side_says_little() -> None:
    (left, _), (right, sure) = limb_ends([step(0.7, 4), step(1.5, 0.1)], Range(0, 1.2, 2.2), (0, 2.4), 6.0)
    assert left == pytest.approx(0.7, abs=0.05) and right == pytest.approx(0.7, abs=0.1) and sure < 0.1


def test_limb_ends_without_colours_are_the_usual_ones() -> None:
    ends = limb_ends([step(0.2, 0.0), step(2.0, 0.0)], Range(0.35, 1.95, 2.2), (0, 2.4), 10.0)
    assert all(end == pytest.approx(1.95, abs=0.05) and sure == 0 for end, sure in ends)


def test_limb_ends_of_a_hidden_limb() -> None:
    none = np.zeros(0)
    (left, _), (right, sure) = limb_ends([step(0.7, 4), (none, none)], Range(0, 1.2, 2.2), (0, 2.4), 6.0)
    assert left == pytest.approx(0.7, abs=0.05) and sure == 0 and np.isfinite(right)


UP = np.linspace(0.8, -0.8, 4000)


def test_waist_split_with_and_without_a_bare_waist() -> None:
    upper, lower = np.where(UP > 0.1, 0.0, -8.0), np.where(UP < 0.1, 0.0, -8.0)
    end, begin, sure = waist_split(UP, upper, lower, np.full(4000, -8.0), 0.0)
    assert end == pytest.approx(0.1, abs=0.05) and begin == pytest.approx(end) and sure > 0.5
    upper, lower = np.where(UP > 0.5, 0.0, -8.0), np.where(UP < 0.2, 0.0, -8.0)
    skin = np.where((UP < 0.5) & (UP > 0.2), 0.0, -8.0)
    end, begin, _ = waist_split(UP, upper, lower, skin, 0.0)
    assert end == pytest.approx(0.5, abs=0.05) and begin == pytest.approx(0.2, abs=0.05)


def test_waist_split_of_one_colour_is_the_usual_one() -> None:
    same = np.zeros(4000)
    end, begin, sure = waist_split(UP, same, same, same - 8, -0.1)
    assert end == pytest.approx(-0.1, abs=0.05) and begin == end and sure == 0


def test_zones_know_every_garment_name() -> None:
    from recon.garments import NAMES

    assert set(ZONES) == set(NAMES)
