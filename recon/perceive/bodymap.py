"""Where on the body a pixel lies, from the landmarks alone: nearest limb, how far along it, how high on the trunk."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

TORSO, HEAD, ARM_L, ARM_R, LEG_L, LEG_R = range(6)
ARMS = {ARM_L: (11, 13, 15, (17, 19)), ARM_R: (12, 14, 16, (18, 20))}
LEGS = {LEG_L: (23, 25, 27, (29, 31)), LEG_R: (24, 26, 28, (30, 32))}


@dataclass(frozen=True)
class BodyMap:
    """Body coordinates of the pixels of a window (h, w)."""

    part: np.ndarray
    """(h, w) nearest part: TORSO, HEAD, ARM_L ... LEG_R."""
    up: np.ndarray
    """(h, w) height on the trunk's axis: 0 at the hips, 1 at the shoulders, negative at the legs."""
    across: np.ndarray
    """(h, w) signed distance from the trunk's middle line in half trunk widths: +-1 on the lines shoulder to hip."""
    arm: np.ndarray
    """(h, w) place along the nearest arm: 0 shoulder, 1 elbow, 2 wrist, more on the hand."""
    arm_axis: np.ndarray
    """(h, w) distance to the nearest arm's axis in its radii, below 1 on a bare arm, before the trunk, too."""
    leg: np.ndarray
    """(h, w) place along the nearest leg: 0 hip, 1 knee, 2 ankle, more on the foot."""
    hand: np.ndarray
    """(h, w) distance to the nearer hand's axis in hand radii, below 1 on the hand."""
    foot: np.ndarray
    """(h, w) distance to the nearer foot in foot radii, below 1 on the foot."""
    head: np.ndarray
    """(h, w) distance to the face's centre in head radii, below 1 on the head."""
    neck: np.ndarray
    """(h, w) distance to the base of the neck in shoulder widths."""
    beside: np.ndarray
    """(h, w) bool, beside jaw and neck: only long hair, a hood or a scarf is there."""
    gap: np.ndarray
    """(h, w) distance to the nearest part in its own radii: large where the background may show between limbs."""
    behind: bool
    """Whether the person is seen from behind: the left shoulder is on the photo's left."""
    chin: float
    """Height of the chin, in ``up``."""
    unit: float
    """Length of the trunk [working px], guarded against foreshortening."""
    width: float
    """Width of the shoulders [working px], guarded against side views."""
    face: np.ndarray
    """(h, w) bool, inside the face's landmarks."""
    cheeks: np.ndarray
    """(h, w) bool, between eyes, ears and nose: skin even under a beard, a fringe or a hat."""
    core: np.ndarray
    """(h, w) bool, surely on the trunk: between shoulders and hips, away from their ends."""
    thighs: np.ndarray
    """(h, w) bool, surely on the thighs (the lap's middle between them not included)."""


def _segment(grid: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [px] of every pixel to the segment a-b, and the unclipped place along it (0 at a, 1 at b)."""
    d = b - a
    along = ((grid - a) @ d) / max(float(d @ d), 1e-6)
    nearest = a + np.clip(along, 0, 1)[..., None] * d
    return np.linalg.norm(grid - nearest, axis=-1), along


def _polygon(shape: tuple[int, int], points: np.ndarray) -> np.ndarray:
    out = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(np.round(points).astype(np.int32)), 1)
    return out > 0


def _limb(grid: np.ndarray, joints: list[np.ndarray], radii: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Distance to a limb of two bones in its radii, and the place along it (0, 1, 2 at the joints; goes on beyond)."""
    (d0, t0), (d1, t1) = _segment(grid, joints[0], joints[1]), _segment(grid, joints[1], joints[2])
    upper = d0 / radii[0] <= d1 / radii[1]
    place = np.where(upper, np.clip(t0, None, 1), 1 + np.clip(t1, 0, None))
    return np.minimum(d0 / radii[0], d1 / radii[1]), place


def _trunk(grid: np.ndarray, p: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray, float]:
    """``up``, ``across`` and the trunk's length."""
    shoulders, hips = p[11:13].mean(0), p[23:25].mean(0)
    axis = shoulders - hips
    length = max(float(np.linalg.norm(axis)), 1e-3)
    side = np.array([-axis[1], axis[0]]) / length
    up = ((grid - hips) @ axis) / length**2
    half_top = max(abs(float((p[11] - p[12]) @ side)) / 2, 0.35 * width)
    half_low = max(abs(float((p[23] - p[24]) @ side)) / 2 * 1.35, 0.3 * width)  # hip joints lie inside the hips
    half = half_low + np.clip(up, 0, 1) * (half_top - half_low)
    return up, ((grid - hips) @ side) / half, length


def body_map(shape: tuple[int, int], p: np.ndarray) -> BodyMap:
    """Body coordinates of a window of ``shape`` (h, w) from (33, 2) landmarks in its pixels."""
    h, w = shape
    yy, xx = np.mgrid[:h, :w].astype(np.float32)
    grid = np.stack([xx, yy], -1)
    length = float(np.linalg.norm(p[11:13].mean(0) - p[23:25].mean(0)))
    thigh = max(np.linalg.norm(p[23] - p[25]), np.linalg.norm(p[24] - p[26]))
    unit = max(length, 0.9 * float(thigh), 1e-3)
    width = float(np.clip(np.linalg.norm(p[11] - p[12]), 0.4 * unit, 0.85 * unit))
    up, across, _ = _trunk(grid, p, width)

    face_points = p[:11]
    centre = face_points[[0, 2, 5, 7, 8, 9, 10]].mean(0)
    ear = max(float(np.linalg.norm(p[7] - p[8])), 0.24 * unit)
    head = np.linalg.norm(grid - centre, axis=-1) / (0.95 * ear)
    axis = (p[11:13].mean(0) - p[23:25].mean(0)) / max(length, 1e-3)
    chin = float((centre - p[23:25].mean(0)) @ axis) / max(length, 1e-3) - 0.62 * ear / max(length, 1e-3)

    trunk = _polygon(shape, np.vstack([p[11:13], p[23:25]]))
    outside = cv2.distanceTransform((~trunk).astype(np.uint8), cv2.DIST_L2, 3) / (0.12 * unit)
    arms = {k: _limb(grid, [p[a], p[b], p[c]], (0.15 * width, 0.13 * width)) for k, (a, b, c, _) in ARMS.items()}
    legs = {k: _limb(grid, [p[a], p[b], p[c]], (0.24 * width, 0.18 * width)) for k, (a, b, c, _) in LEGS.items()}
    hand = np.minimum(*(_hand(grid, p, c, tip, width) for _, _, c, tip in ARMS.values()))
    foot = np.minimum(*(_foot(grid, p, c, sole, width) for _, _, c, sole in LEGS.values()))

    def pick(limbs: dict[int, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        (d0, t0), (d1, t1) = limbs.values()
        return np.where(d0 <= d1, t0, t1)

    near = [outside, head / 1.05, *(arms[k][0] for k in ARMS), *(legs[k][0] for k in LEGS)]
    # Inside the trunk's outline the arms must be clearly nearer: an arm that hangs beside the hips is not in front.
    near[0] = np.where(trunk, np.minimum(near[0], 0.0), near[0])
    part = np.argmin(np.stack(near, -1), -1)
    on_leg = np.isin(part, list(LEGS))
    # A raised or bent thigh is as far below the hips as a hanging one.
    up = np.where(on_leg, np.minimum(up, -0.85 * pick(legs)), up)

    def mix(a: int, b: int, t: float) -> np.ndarray:
        return p[a] + t * (p[b] - p[a])

    aside = np.abs((grid - centre) @ np.array([-axis[1], axis[0]]))
    beside = (up < chin + 0.2) & (up > chin - 0.12) & (aside > 0.6 * ear) & (aside < 1.5 * ear)

    core = _polygon(shape, np.array([mix(11, 23, 0.2), mix(12, 24, 0.2), mix(23, 11, 0.25), mix(24, 12, 0.25)]))
    core &= np.abs(across) < 0.85
    thighs = np.zeros(shape, bool)
    for a, b in ((23, 25), (24, 26)):
        d, t = _segment(grid, p[a], p[b])
        thighs |= (d < 0.13 * width) & (t > 0.15) & (t < 0.7)
    return BodyMap(
        part=part,
        up=up,
        across=across,
        arm=pick(arms),
        arm_axis=np.minimum(*(d for d, _ in arms.values())),
        leg=pick(legs),
        hand=hand,
        foot=foot,
        head=head,
        neck=np.linalg.norm(grid - p[11:13].mean(0) - 0.12 * unit * axis, axis=-1) / width,
        beside=beside,
        gap=np.min(np.stack(near, -1), -1),
        behind=bool(p[11, 0] < p[12, 0]),
        chin=chin,
        unit=unit,
        width=width,
        face=_polygon(shape, face_points),
        cheeks=_cheeks(shape, p),
        core=core,
        thighs=thighs,
    )


def _cheeks(shape: tuple[int, int], p: np.ndarray) -> np.ndarray:
    ears = [p[7] + 0.2 * (p[0] - p[7]), p[8] + 0.2 * (p[0] - p[8])]
    return _polygon(shape, np.array([*ears, p[3], p[6], p[0], *(0.5 * (p[7:9] + p[9:11]))]))


def _hand(grid: np.ndarray, p: np.ndarray, wrist: int, tips: tuple[int, int], width: float) -> np.ndarray:
    knuckles = p[list(tips)].mean(0)
    reach = knuckles - p[wrist]
    return _segment(grid, p[wrist] + 0.25 * reach, knuckles + 0.9 * reach)[0] / (0.17 * width)


def _foot(grid: np.ndarray, p: np.ndarray, ankle: int, sole: tuple[int, int], width: float) -> np.ndarray:
    inside = _polygon(grid.shape[:2], np.array([0.3 * p[ankle] + 0.7 * p[sole[0]], p[sole[0]], p[sole[1]]]))
    return cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 3) / (0.14 * width)
