"""Chains: the stretches of panels' borders that carry one label, and which of them belong together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from recon.garments.panels import KEPT, Panel, cross, move_safely

SHORTEST_RUN = 0.025
"""Label runs shorter than this [domain units] are noise: real seams and openings are several times longer."""
SLIT_SHARES = (1.5, 0.8)
"""An open run within one seam and shorter than these shares of the shorter and the longer of its two parts is a wrong
label: between shorts and trousers, the hem of the shorts leaves such traces in the inseam."""
CORNER_REACH = 0.03
"""How far from a label change its corner is searched [domain units]."""
TURN_REACH = 0.015
"""Along so much of the border on either side it is told how far it turns [domain units]."""
FAR = 64
"""Vertices on either side of a label change that are looked at."""
AWAY = 2.0
"""By so much less a corner counts as turning, per distance from the label change [radians / domain unit]."""
MAX_CHAIN_DISTANCE = 0.15
"""Both chains of a seam lie this close in the plane [domain units], or they don't belong together."""


@dataclass(frozen=True)
class Chain:
    """A stretch of one panel's border that carries one label."""

    label: int
    points: NDArray[np.int64]
    """Panel point indices from end to end, both corners included."""


def clean_runs(labels: NDArray, lengths: NDArray) -> NDArray:
    """Labels along a closed loop without runs shorter than ``SHORTEST_RUN``; lengths[i] joins vertex i to i + 1."""
    labels = labels.copy()
    while True:
        starts = np.nonzero(labels != np.roll(labels, 1))[0]
        if len(starts) < 2:
            return labels
        ends = np.roll(starts, -1)
        total = np.concatenate([[0.0], np.cumsum(lengths)])
        run = (total[ends] - total[starts]) % total[-1]
        k = int(run.argmin())
        if run[k] >= SHORTEST_RUN:
            return labels
        before, after = (k - 1) % len(starts), (k + 1) % len(starts)
        winner = before if run[before] >= run[after] else after
        index = np.arange(starts[k], ends[k] + (len(labels) if ends[k] <= starts[k] else 0)) % len(labels)
        labels[index] = labels[starts[winner]]


def without_slits(labels: NDArray, lengths: NDArray) -> NDArray:
    """Labels along a closed loop in which no short open run lies within one seam: patterns have no such slits."""
    labels = labels.copy()
    total = np.concatenate([[0.0], np.cumsum(lengths)])
    while True:
        starts = np.nonzero(labels != np.roll(labels, 1))[0]
        runs = labels[starts]
        run = (total[np.roll(starts, -1)] - total[starts]) % total[-1]
        less, more = np.sort([np.roll(run, 1), np.roll(run, -1)], axis=0)
        short = (run < SLIT_SHARES[0] * less) & (run < SLIT_SHARES[1] * more) & (less > 2 * SHORTEST_RUN)
        slits = np.nonzero((runs == 0) & (np.roll(runs, 1) == np.roll(runs, -1)) & short)[0]
        if len(starts) < 3 or not len(slits):
            return labels
        first, last = starts[slits[0]], starts[(slits[0] + 1) % len(starts)]
        index = np.arange(first, last + (len(labels) if last <= first else 0)) % len(labels)
        labels[index] = labels[first - 1]


def corner_near(points: NDArray, lengths: NDArray, change: int) -> tuple[int, NDArray]:
    """The corner near a label change (first vertex of the new run): the loop vertex nearest to it, its place (2,).

    Both sides of a seam must end in the same place, wherever a grid cuts their corners off: a corner is in the middle
    of all that the border turns about where it turns most, and where the lines along its two sides meet.
    """
    half = min(len(points) // 2, FAR)
    order = np.arange(change - half, change + half) % len(points)
    at, place = np.concatenate([[0.0], np.cumsum(lengths[order[:-1]])]), points[order]
    at -= at[half]
    step = float(lengths.mean())
    reach = max(TURN_REACH, 1.5 * step)

    def on(t: NDArray) -> NDArray:
        return np.stack([np.interp(t, at, x) for x in place.T], -1)

    t = at[np.abs(at) <= max(CORNER_REACH, 3 * step)]
    turn = _turn(on(t) - on(t - reach), on(t + reach) - on(t))
    best = int((np.abs(turn) - AWAY * np.abs(t)).argmax())
    if np.abs(turn[best]) <= np.radians(25):
        return change, points[change]
    about = np.nonzero(np.abs(at - t[best]) <= reach)[0][:, None] + np.array([-1, 0, 1])
    a, b, c = place[np.clip(about, 0, len(at) - 1).T]
    share = np.maximum(_turn(b - a, c - b) * np.sign(turn[best]), 0)
    middle = float((share * at[about[:, 1]]).sum() / share.sum())
    # Lines from one and a half to four edges away: nearer the grid has cut the corner off.
    ends = on(middle + step * np.array([[-4.0, -1.5], [4.0, 1.5]]))
    blunt, corner = on(np.array([middle]))[0], _meeting(ends[0], ends[1])
    sharp = np.linalg.norm(corner - blunt) < reach
    return int(order[np.abs(at - middle).argmin()]), corner if sharp else blunt


def _meeting(one: NDArray, other: NDArray) -> NDArray:
    """(2,) where the lines through two pairs of points (2, 2) meet; not finite where they are parallel."""
    along = np.stack([one[1] - one[0], other[1] - other[0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = cross(other[1:] - one[1:], along[1:]) / cross(along[:1], along[1:])
    return one[1] + far * along[0]


def _turn(before: NDArray, after: NDArray) -> NDArray:
    """(N,) angles from directions (N, 2) to others, counter-clockwise."""
    return np.arctan2(cross(before, after), (before * after).sum(1))


def chains_of(panel: Panel, labels: NDArray) -> tuple[Panel, list[Chain], NDArray]:
    """Seam chains of a panel and the border label of each of its points, from raw labels at its border vertices.

    labels: (B,) in the order of ``panel.border``. Chains end at corners, which neighbouring chains share; the panel
    comes back with those corners sharp.
    """
    chains, per_point, offset = [], np.full(len(panel.points), -1), 0
    ends: dict[int, NDArray] = {}
    for loop in panel.loops:
        place = panel.points[loop]
        lengths = np.linalg.norm(np.roll(place, -1, 0) - place, axis=1)
        clean = without_slits(clean_runs(labels[offset : offset + len(loop)], lengths), lengths)
        offset += len(loop)
        per_point[loop] = 0
        changes = np.nonzero(clean != np.roll(clean, 1))[0]
        found = [corner_near(place, lengths, int(k)) for k in changes]
        ends |= {int(loop[k]): at for k, at in found}
        for k, (start, _) in enumerate(found):
            end = found[(k + 1) % len(found)][0]
            label = int(clean[changes[k]])
            if label == 0 or start == end:
                continue
            index = np.arange(start, end + 1 + (len(loop) if end <= start else 0)) % len(loop)
            chains.append(Chain(label, loop[index]))
    chains = _without_scraps(panel, chains)
    for chain in chains:
        per_point[chain.points] = chain.label
    sharp = np.array(list(ends.values())).reshape(-1, 2)
    points = move_safely(panel.points, panel.faces, np.array(list(ends), np.int64), sharp, KEPT)
    return replace(panel, points=points), chains, per_point


def _without_scraps(panel: Panel, chains: list[Chain]) -> list[Chain]:
    """Chains without those far shorter than the longest one of their label: a seam's stray traces around a corner."""
    length = [np.linalg.norm(np.diff(panel.points[c.points], axis=0), axis=1).sum() for c in chains]
    longest: dict[int, float] = {}
    for chain, own in zip(chains, length, strict=True):
        longest[chain.label] = max(longest.get(chain.label, 0.0), own)
    return [c for c, own in zip(chains, length, strict=True) if own > 0.25 * longest[c.label]]


def arc_lengths(points: NDArray) -> NDArray:
    """(N,) relative arc length in [0, 1] along a polyline."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return total / max(total[-1], 1e-12)


def resampled(points: NDArray, at: NDArray) -> NDArray:
    """(N, 2) points of a polyline at relative arc lengths (N,)."""
    t = arc_lengths(points)
    return np.stack([np.interp(at, t, points[:, k]) for k in (0, 1)], 1)


def pair_chains(one: Panel, other: Panel, ones: list[Chain], others: list[Chain]) -> list[tuple[Chain, Chain]]:
    """Chains of two panels that belong together: equal label, nearest in the plane; the other's turned to run along."""
    at, pairs = np.linspace(0, 1, 9), []
    for label in sorted({c.label for c in ones} & {c.label for c in others}):
        a = [c for c in ones if c.label == label]
        b = [c for c in others if c.label == label]
        pa = np.stack([resampled(one.points[c.points], at) for c in a])
        pb = np.stack([resampled(other.points[c.points], at) for c in b])
        straight = np.linalg.norm(pa[:, None] - pb[None], axis=-1).mean(-1)
        turned = np.linalg.norm(pa[:, None] - pb[None, :, ::-1], axis=-1).mean(-1)
        cost = np.minimum(straight, turned)
        for i, j in zip(*linear_sum_assignment(cost), strict=True):
            if cost[i, j] > MAX_CHAIN_DISTANCE:
                continue
            turn = turned[i, j] < straight[i, j]
            pairs.append((a[i], Chain(label, b[j].points[::-1]) if turn else b[j]))
    return pairs


def merge_parameters(a: NDArray, b: NDArray, tolerance: float) -> tuple[NDArray, NDArray, NDArray]:
    """Common arc lengths of two chains: (t, index in a or -1, index in b or -1), ends matched to ends.

    Interior points closer than ``tolerance`` share their mean; the others stay alone.
    """
    inner = [np.arange(1, len(side) - 1) for side in (a, b)]
    i, j = _mutual(a[inner[0]], b[inner[1]], tolerance)
    i, j = i + 1, j + 1
    alone = [np.setdiff1d(of, used, assume_unique=True) for of, used in zip(inner, (i, j))]
    t = np.concatenate([[0.0, 1.0], 0.5 * (a[i] + b[j]), a[alone[0]], b[alone[1]]])
    none = [np.full(len(k), -1) for k in alone]
    ia = np.concatenate([[0, len(a) - 1], i, alone[0], none[1]])
    ib = np.concatenate([[0, len(b) - 1], j, none[0], alone[1]])
    order = np.argsort(t, kind="stable")
    order = np.concatenate([[0], order[(order != 0) & (order != 1)], [1]])  # the ends stay the ends
    return t[order], ia[order], ib[order]


def _mutual(a: NDArray, b: NDArray, tolerance: float) -> tuple[NDArray, NDArray]:
    """Pairs (rows of a, rows of b) of rising numbers that are each other's nearest and closer than ``tolerance``."""
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    to_b, to_a = _nearest(a, b), _nearest(b, a)
    rows = np.nonzero((to_a[to_b] == np.arange(len(a))) & (np.abs(b[to_b] - a) <= tolerance))[0]
    return rows, to_b[rows]


def _nearest(x: NDArray, among: NDArray) -> NDArray[np.int64]:
    """(N,) rows of the rising numbers ``among`` that are nearest to x (N,)."""
    last = len(among) - 1
    after = np.searchsorted(among, x).clip(0, last)
    before = (after - 1).clip(0)
    return np.where(np.abs(among[before] - x) <= np.abs(among[after] - x), before, after)
