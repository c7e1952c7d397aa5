"""Where a sewn garment starts: a pillow around the body, the front panel before it, the back panel behind it.

Placement decides whether a drape succeeds. Panels share the frontal plane with the T-posed body, so only their depth
has to be found: just off the body where it is, a thin gap beside it, and closed at the seams.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.garments.patterns_body import Measures

CELL = 0.005
"""Size of a relief cell [m]."""
MARGIN = 0.010
"""Distance of the placed cloth from the body [m]."""
GAP = 0.022
"""Half distance between front and back beside the body [m]."""


@dataclass(frozen=True)
class BodyRelief:
    """Depth maps of a body seen from the front, with a margin: front, back and middle over (y, x) cells."""

    origin: NDArray
    """(2,) x, y of cell (0, 0) [m]."""
    front: NDArray
    """(H, W) greatest z [m], -inf beside the body."""
    back: NDArray
    """(H, W) least z [m], +inf beside the body."""
    middle: NDArray
    """(H, W) smooth middle depth, continued beside the body [m]."""

    @classmethod
    def of(cls, measures: Measures) -> BodyRelief:
        """Rasterise the body and grow it by ``MARGIN``."""
        v, f = measures.vertices, measures.faces
        origin = v[:, :2].min(0) - 0.1
        width, height = np.ceil((v[:, :2].max(0) + 0.1 - origin) / CELL).astype(int)
        front, back = np.full((height, width), -np.inf), np.full((height, width), np.inf)
        n = 5
        for i in range(n + 1):
            for j in range(n + 1 - i):
                w = np.array([i, j, n - i - j]) / n
                p = (v[f] * w[:, None]).sum(1)
                cell = np.round((p[:, :2] - origin) / CELL).astype(int)
                np.maximum.at(front, (cell[:, 1], cell[:, 0]), p[:, 2])
                np.minimum.at(back, (cell[:, 1], cell[:, 0]), p[:, 2])
        known = np.isfinite(front)
        rough = np.where(known, (front + np.where(known, back, 0)) / 2, 0.0)
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        middle = ndimage.gaussian_filter(rough[tuple(nearest)], 0.04 / CELL)
        reach = int(np.ceil(MARGIN / CELL))
        offset = np.arange(-reach, reach + 1) * CELL
        square = MARGIN**2 - offset[:, None] ** 2 - offset**2
        ball = np.where(square >= 0, np.sqrt(np.maximum(square, 0)), -np.inf)
        disc = square >= 0
        front = ndimage.grey_dilation(np.where(known, front, -1e3), footprint=disc, structure=np.where(disc, ball, 0))
        back = -ndimage.grey_dilation(np.where(known, -back, -1e3), footprint=disc, structure=np.where(disc, ball, 0))
        front, back = np.where(front < -10, -np.inf, front), np.where(back > 10, np.inf, back)
        return cls(origin, front, back, middle)

    def thickness(self, side: int, bridge: float) -> NDArray:
        """(H, W) how far front (0) or back (1) stands out of the middle [m]; hollows up to ``bridge`` wide filled."""
        out = self.front - self.middle if side == 0 else self.middle - self.back
        out = np.where(np.isfinite(out), np.maximum(out, 0.0), 0.0)
        if bridge > 0:
            out = ndimage.grey_closing(out, size=(1, int(bridge / CELL)))
        return np.maximum(out, ndimage.gaussian_filter(out, 0.015 / CELL))

    def lookup(self, image: NDArray, points: NDArray) -> NDArray:
        """(N,) values of a map at (N, 2) frontal positions, bilinear."""
        at = (points - self.origin) / CELL
        return ndimage.map_coordinates(image, [at[:, 1], at[:, 0]], order=1, mode="nearest")


def place(pattern, measures: Measures, relief: BodyRelief) -> NDArray:
    """(P, 3) start position of each panel point of a ``Pattern`` [m]."""
    from scipy.spatial import cKDTree

    points = pattern.points.copy()
    if pattern.kind == "trousers":
        points = _part_legs(pattern, measures)
    # Legs and sleeves are tubes of their own; a skirt, a dress or a shirt spans what lies between two legs.
    bridge = 0.0 if pattern.kind == "trousers" else 0.26
    middle = relief.lookup(relief.middle, points)
    # Depth closes where front and back are sewn together, not where two panels of one side are.
    side = pattern.side_of_point
    closing = side[pattern.seams[:, 0]] != side[pattern.seams[:, 1]]
    seam_tree = cKDTree(pattern.points[pattern.seams[closing, 0]])
    distance, _ = seam_tree.query(pattern.points)
    q = np.clip(distance / 0.045, 0.0, 1.0)
    gap = GAP * np.sqrt(np.maximum(1 - (1 - q) ** 2, 0.0))
    z = np.empty(len(points))
    for back, sign in ((0, 1.0), (1, -1.0)):
        mine = side == back
        out = relief.lookup(relief.thickness(back, bridge), points[mine])
        # A seam lies beside the body; where it does not (shoulders), the rise from it is quick but not a cliff.
        rise = np.clip(distance[mine] / 0.02, 0.0, 1.0)
        out = out * np.sqrt(np.maximum(1 - (1 - rise) ** 2, 0.0))
        z[mine] = middle[mine] + sign * np.maximum(out, gap[mine])
    return np.column_stack([points, z])


def _part_legs(pattern, m: Measures) -> NDArray:
    """Panel points with each leg's rows moved around the body's leg; from hip to crotch the move fades in."""
    p = pattern.points.copy()
    crotch = pattern.parameters["crotch_y"]
    rows = np.linspace(p[:, 1].min(), crotch, 80)
    left = pattern.points[(pattern.labels >= 0) & (pattern.panel_of_point == 0) & (p[:, 0] >= 0)]
    inner, outer = _leg_borders(left, rows)
    width = outer - inner
    centre = (m.leg.low_at(rows, 0) + m.leg.high_at(rows, 0)) / 2
    new_inner = np.clip(np.minimum(centre - width / 2, m.leg.low_at(rows, 0) - 0.006), 0.002, None)
    new_outer = np.maximum(centre + width / 2, m.leg.high_at(rows, 0) + 0.006)
    x, y = np.abs(p[:, 0]), p[:, 1]
    below = y < crotch
    a, b, c, d = (np.interp(y, rows, row) for row in (inner, outer, new_inner, new_outer))
    legs = np.maximum(c + (x - a) / (b - a) * (d - c), 0.001)
    hip = pattern.parameters["hip_y"]
    fade = np.clip((hip - y) / (hip - crotch), 0.0, 1.0)
    trunk = x * (1 + fade * (new_outer[-1] / outer[-1] - 1))
    p[:, 0] = np.sign(p[:, 0]) * np.where(below, legs, trunk)
    return p


def _leg_borders(border: NDArray, rows: NDArray) -> tuple[NDArray, NDArray]:
    """Inner and outer x of the left leg at each height, from the border's points (B, 2)."""
    inner, outer = np.empty(len(rows)), np.empty(len(rows))
    for i, y in enumerate(rows):
        near = border[np.argsort(np.abs(border[:, 1] - y), kind="stable")[:60]]
        near = near[np.abs(near[:, 1] - y) < 0.025, 0]
        split = (near.min() + near.max()) / 2
        inner[i], outer[i] = near[near <= split].min(), near[near >= split].max()
    return inner, outer
