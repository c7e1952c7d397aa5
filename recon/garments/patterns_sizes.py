"""Sizes of clothes that people wear, drawn at random for a body: tight to oversized, cropped to long.

Each function returns the named sizes [m] (and a few unitless shape factors) that ``patterns_shapes`` cuts from. "Ease"
is what a garment is wider than the body; with two panels a girth g needs a half width of g / 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.garments import patterns_shapes as shapes
from recon.garments.patterns_body import Measures

Parameters = dict[str, float]

SKIN = 2 * np.pi * 0.0035
"""What the cloth's distance from the skin adds to a girth [m]."""


def top(variant: str, rng: np.random.Generator, m: Measures) -> Parameters:
    """Sizes of a tank, tshirt, shirt or jacket."""
    fit = rng.beta(1.1, 1.3)
    # Woven cloth tighter than this across the chest would have to stretch, most of all with long sleeves set in.
    eases = {"tank": (0.022, 0.055), "tshirt": (0.028, 0.082), "shirt": (0.035, 0.090), "jacket": (0.038, 0.095)}
    low, high = eases[variant]
    p = _shoulders(variant, rng, m, fit, low + fit * (high - low))
    if variant == "jacket":
        p["opening"] = rng.uniform(0.050, 0.060)
    ease = p["chest_x"] - _trunk(m, m.chest_y)
    lengths = {
        "tank": [(0.70, m.hip_y - 0.06, m.hip_y + 0.12), (0.30, m.waist_y - 0.08, m.waist_y + 0.01)],
        "tshirt": [(0.80, m.hip_y - 0.08, m.hip_y + 0.12), (0.20, m.waist_y - 0.08, m.waist_y + 0.01)],
        "shirt": [(0.85, m.hip_y - 0.09, m.hip_y + 0.12), (0.15, m.waist_y - 0.08, m.waist_y)],
        "jacket": [(0.7, m.hip_y - 0.1, m.hip_y + 0.14), (0.3, m.knee_y + 0.02, m.hip_y - 0.1)],
    }[variant]
    p["hem_y"] = _pick(rng, lengths)
    need = _trunk(m, p["hem_y"]) + 0.008
    ribbed = variant in ("shirt", "jacket") and ease > 0.03 and rng.random() < 0.35
    if ribbed:
        p["hem_x"] = max(need, need + 0.25 * ease)
    else:
        p["hem_x"] = max(need, p["chest_x"] + rng.uniform(-0.012, 0.02) + max(0.0, rng.normal(0.0, 0.02)))
    _waist(p, rng, m, fitted=rng.uniform(0, 0.8) * (1 - fit))
    _clear(p, m, shapes.bodice_side(p), 0.005)
    p["hem_drop"] = float(np.clip(0.15 * (p["hem_x"] - p["waist_x"]) + rng.uniform(-0.004, 0.012), 0.0, 0.03))
    return p


def set_in(style: str, rng: np.random.Generator, m: Measures) -> Parameters:
    """Sizes of a shirt with set-in sleeves: those of a tshirt or shirt, and how far its armholes are hollowed [m]."""
    p = top(style, rng, m)
    p["armhole_back"] = rng.uniform(0.004, 0.012)
    p["armhole_front"] = p["armhole_back"] + rng.uniform(0.0, 0.012)
    return p


def dress(rng: np.random.Generator, m: Measures) -> Parameters:
    """Sizes of a one-piece dress: sleeveless, short or long sleeves, mini to maxi, fitted to loose."""
    fit = rng.beta(1.0, 1.6)
    style = rng.choice(["tank", "tshirt", "shirt"], p=[0.4, 0.35, 0.25])
    least = {"tank": 0.026, "tshirt": 0.030, "shirt": 0.036}[style]
    p = _shoulders(style, rng, m, fit, least + 0.046 * fit)
    p["armpit_y"] -= 0.007  # the waist holds a dress: its armholes must leave more room than those of a top
    p["hem_y"] = _pick(
        rng,
        [
            (0.3, m.knee_y + 0.08, m.crotch_y - 0.08),
            (0.45, m.knee_y - 0.12, m.knee_y + 0.08),
            (0.25, m.ankle_y + 0.1, m.knee_y - 0.12),
        ],
    )
    p["hip_y"] = m.hip_y
    p["hip_x"] = _trunk(m, m.hip_y) + 0.008 + 0.05 * fit + rng.uniform(0, 0.02)
    flare = rng.choice([rng.uniform(0.0, 0.08), rng.uniform(0.08, 0.32)])
    p["hem_x"] = max(_trunk(m, p["hem_y"]) + 0.012, p["hip_x"] + flare * (m.hip_y - p["hem_y"]))
    _waist(p, rng, m, fitted=rng.uniform(0.1, 0.65) * (1 - 0.7 * fit))
    p["hem_drop"] = 0.28 * (p["hem_x"] - p["hip_x"]) * rng.uniform(0.6, 1.1)
    _yoke(p, m)
    _clear(p, m, shapes.bodice_side(p) if "chest_x" in p else shapes.skirt_side(p), 0.005)
    return p


def skirt(rng: np.random.Generator, m: Measures) -> Parameters:
    """Sizes of a skirt: mini to maxi, pencil to A-line, held at the waist or lower."""
    p = _waistband(rng, m, low=0.13)
    loose = rng.beta(1.0, 1.8)
    p["hip_y"] = m.hip_y
    p["hip_x"] = _trunk(m, m.hip_y) + 0.006 + 0.07 * loose
    p["hem_y"] = _pick(
        rng,
        [
            (0.35, m.knee_y + 0.10, m.crotch_y - 0.06),
            (0.4, m.knee_y - 0.12, m.knee_y + 0.10),
            (0.25, m.ankle_y + 0.07, m.knee_y - 0.12),
        ],
    )
    flare = rng.choice([rng.uniform(-0.03, 0.06), rng.uniform(0.06, 0.40)])
    p["hem_x"] = max(_trunk(m, p["hem_y"]) + 0.012, p["hip_x"] + flare * (m.hip_y - p["hem_y"]))
    p["hem_drop"] = 0.28 * max(0.0, p["hem_x"] - p["hip_x"]) * rng.uniform(0.6, 1.1)
    _yoke(p, m)
    _clear(p, m, shapes.bodice_side(p) if "chest_x" in p else shapes.skirt_side(p), 0.005)
    return p


def trousers(variant: str, rng: np.random.Generator, m: Measures) -> Parameters:
    """Sizes of trousers (to the ankle or cropped) or shorts, slim to wide."""
    p = _waistband(rng, m, low=0.11)
    fit = rng.beta(1.1, 1.4)
    half_path = m.crotch_path(p["waist_y"]) / 2
    p["crotch_y"] = p["waist_y"] - half_path - rng.uniform(0.078, 0.09) - 0.03 * fit
    p["crotch_radius"] = rng.uniform(0.014, 0.018)
    p["hip_y"] = m.hip_y
    p["hip_x"] = _trunk(m, m.hip_y) + 0.012 + 0.05 * fit
    ease = 0.017 + 0.04 * fit
    p["thigh_y"] = p["crotch_y"] - 0.04
    p["thigh_outer_x"] = float(p["crotch_radius"] + (m.leg.girth_at(m.crotch_y - 0.06) + SKIN) / 2 + ease)
    if variant == "shorts":
        high = p["crotch_y"] - 0.10  # wide ones of a low crotch have no shorter hem than the longest
        p["hem_y"] = rng.uniform(min(m.knee_y - 0.03, high), high)
    else:
        long, cropped = (m.ankle_y + 0.012, m.ankle_y + 0.07), (m.ankle_y + 0.10, m.knee_y - 0.12)
        p["hem_y"] = _pick(rng, [(0.75, *long), (0.25, *cropped)])
    knee_ease = (0.6 + 0.6 * fit) * ease + rng.uniform(0.004, 0.012)
    if variant == "shorts":
        hem_ease = ease + rng.uniform(0.0, 0.015) + 0.03 * fit * rng.random()
    else:
        straight, flared = knee_ease * rng.uniform(0.8, 1.6), knee_ease + rng.uniform(0.01, 0.045)
        hem_ease = rng.choice([rng.uniform(0.006, 0.018), straight, flared])
    _legs(p, m, knee_ease, float(hem_ease), drift=rng.uniform(-0.01, 0.05))
    _yoke(p, m)
    p["crotch_y"] -= 0.9 * p["waist_drop"]
    p["hem_rise"] = 0.9 * p["waist_drop"]  # a level waistband lowers the sides
    return p


def _pick(rng: np.random.Generator, ranges: list[tuple[float, float, float]]) -> float:
    """A value from one of (probability, low, high) ranges."""
    _, low, high = ranges[rng.choice(len(ranges), p=[r[0] for r in ranges])]
    return float(rng.uniform(low, high))


def _trunk(m: Measures, y: float) -> float:
    """Half width of a panel that just goes round the body at a height [m]."""
    return float(m.trunk.girth_at(y)) / 4 + SKIN / 4


def _legs(p: Parameters, m: Measures, knee_ease: float, hem_ease: float, drift: float) -> None:
    """Widths at knee and hem.

    The side seam goes on straight down from the thigh (drifting outwards by ``drift``): the panel's legs part in the
    plane, as those of the wearer do.
    """
    p["knee_y"] = m.knee_y
    knee, hem = _leg(m, m.knee_y) + knee_ease, _leg(m, p["hem_y"]) + hem_ease
    for y in np.arange(p["hem_y"], m.knee_y, 0.02):  # the calf is wider than a straight line from knee to ankle
        t = (m.knee_y - y) / (m.knee_y - p["hem_y"])
        lack = max(0.0, _leg(m, y) + 0.004 - (knee + t * (hem - knee)))
        knee, hem = knee + lack, hem + lack
    for name, half in (("knee", knee), ("hem", hem)):
        drop = p["crotch_y"] - p[f"{name}_y"]
        outer = p["thigh_outer_x"] + drift * drop
        inner = max(outer - 2 * half, p["crotch_radius"] + 0.03 * drop)
        p[f"{name}_inner_x"], p[f"{name}_outer_x"] = inner, inner + 2 * half


def _leg(m: Measures, y: float) -> float:
    """Half width of a flat leg that just goes round the body's leg at a height [m]."""
    return float(m.leg.girth_at(y) + SKIN) / 4


def _clear(p: Parameters, m: Measures, side: NDArray, least: float) -> None:
    """Widen the whole side (N, 2) by what it lacks anywhere to go round the trunk with ``least`` to spare."""
    heights = np.arange(max(side[:, 1].min(), m.crotch_y + 0.02), side[:, 1].max(), 0.01)
    order = np.argsort(side[:, 1])
    have = np.interp(heights, side[order, 1], side[order, 0])
    lack = float(np.max(m.trunk.girth_at(heights) / 4 + SKIN / 4 + least - have, initial=0.0))
    for name in ("chest_x", "waist_x", "yoke_x", "hip_x", "hem_x"):
        if name in p and not (name == "waist_x" and "chest_x" not in p):
            p[name] += lack


def _yoke(p: Parameters, m: Measures) -> None:
    """A size between waist and hip, where bodies are wider than a straight line."""
    p["yoke_y"] = 0.5 * (p["waist_y"] + p["hip_y"])
    p["yoke_x"] = max(0.45 * p["waist_x"] + 0.55 * p["hip_x"], _trunk(m, p["yoke_y"]) + 0.013)
    if "waist_drop" in p:
        # Hips make a cone of the cloth below a waistband. Laid flat, a level waistband is an arc at right angles to
        # the sides.
        p["waist_drop"] = 0.5 * p["waist_x"] * (p["yoke_x"] - p["waist_x"]) / (p["waist_y"] - p["yoke_y"])


def _waistband(rng: np.random.Generator, m: Measures, low: float) -> Parameters:
    """A waistband between ``low`` above the hips and the waist."""
    y = rng.uniform(m.hip_y + low, m.waist_y)
    return {
        "waist_y": y,
        "waist_x": _trunk(m, y) + rng.uniform(0.006, 0.011),
        "waist_drop": 0.0,
    }


def _waist(p: Parameters, rng: np.random.Generator, m: Measures, fitted: float) -> None:
    """Set the side's waist between straight (0) and close to the body (1), and keep the whole side off the body."""
    p["waist_y"] = m.waist_y
    below = ("hip_x", "hip_y") if "hip_x" in p else ("hem_x", "hem_y")
    t = (m.waist_y - p[below[1]]) / max(p["armpit_y"] - p[below[1]], 1e-3)
    straight = p[below[0]] + np.clip(t, 0.0, 1.0) * (p["chest_x"] - p[below[0]])
    close = _trunk(m, m.waist_y) + 0.01 + 0.1 * (p["chest_x"] - _trunk(m, m.chest_y))
    p["waist_x"] = float(straight + fitted * (min(close, straight) - straight))


def _shoulders(style: str, rng: np.random.Generator, m: Measures, fit: float, ease: float) -> Parameters:
    """Neck, shoulder, sleeve and chest of a bodice."""
    p: Parameters = {}
    p["chest_x"] = _trunk(m, m.chest_y) + ease
    wide = {"tank": (0.03, 0.055), "tshirt": (0.022, 0.05), "shirt": (0.018, 0.042), "jacket": (0.018, 0.04)}[style]
    p["neck_x"] = m.neck_x + rng.uniform(*wide)
    p["neck_y"] = _over(m, p["neck_x"]) + 0.004
    deep = {"tank": (0.08, 0.18), "tshirt": (0.06, 0.13), "shirt": (0.045, 0.11), "jacket": (0.07, 0.2)}[style]
    p["neck_v"] = float(rng.choice([0.0, rng.uniform(0.0, 0.3), rng.uniform(0.7, 1.0)], p=[0.45, 0.3, 0.25]))
    p["neck_depth_front"] = rng.uniform(*deep) + 0.04 * p["neck_v"]
    p["neck_depth_back"] = rng.uniform(0.03, 0.10) if style == "tank" else rng.uniform(0.012, 0.035)
    if style == "tank":
        p["sleeve_x"] = 0.0
        p["strap_x"] = p["neck_x"] + rng.uniform(0.032, 0.06)
        p["strap_y"] = _over(m, p["strap_x"]) + 0.003
        p["armpit_y"] = _over(m, p["chest_x"]) - _arm(m, p["chest_x"]) - rng.uniform(0.008, 0.035) - 0.03 * fit
        return p
    arm_ease = 0.016 + 0.065 * fit + rng.uniform(0.0, 0.015)
    p["shoulder_x"] = float(m.shoulder[0])
    p["shoulder_y"] = _over(m, p["shoulder_x"]) + 0.005 + 0.01 * fit
    if style == "tshirt":
        p["sleeve_x"] = rng.uniform(p["chest_x"] + 0.035, m.elbow_x + 0.03)
        p["cuff_height"] = _arm(m, p["sleeve_x"]) + 0.6 * arm_ease + rng.uniform(0.006, 0.03)
    else:
        reach = _pick(rng, [(0.8, m.wrist_x - 0.03, m.wrist_x + 0.015), (0.2, m.elbow_x + 0.08, m.wrist_x - 0.05)])
        p["sleeve_x"] = reach
        thick = 0.008 if style == "jacket" else 0.0
        p["cuff_height"] = _arm(m, p["sleeve_x"]) + thick + rng.uniform(0.010, 0.022) + 0.06 * fit * rng.random()
    p["sleeve_y"] = _over(m, p["sleeve_x"]) + 0.004 + 0.006 * fit
    p["armpit_y"] = _over(m, p["chest_x"]) + 0.004 - _arm(m, p["chest_x"]) - arm_ease
    p["underarm"] = rng.uniform(0.03, 0.06) + 0.04 * fit
    return p


def _over(m: Measures, x: float) -> float:
    """Height of the shoulder line (top of neck base, shoulder and arm) at x [m]."""
    return float(m.top.high_at(x, 0))


def _arm(m: Measures, x: float) -> float:
    """Height of a flat sleeve that just goes round the arm at x [m]."""
    return float(m.arm.girth_at(x)) / 2 + SKIN / 2
