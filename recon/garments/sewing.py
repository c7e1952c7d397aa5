"""Sew front and back panel along borders of equal label, by arc length (ISP B.2 puts strips of triangles between).

Each seam's two chains get the same number of points at the same relative arc lengths: points that nearly match move to
their common place, the others are inserted on the other side. Each pair becomes one vertex of the garment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from recon.garments.panels import Panel, border_edges, border_loops, corners, cross, move_safely

SHORTEST_RUN = 0.025
"""Label runs shorter than this [domain units] are noise: real seams and openings are several times longer."""
SLIT_SHARE = 0.8
"""An open run within one seam and shorter than this share of each of its two parts is a wrong label."""
CORNER_REACH = 0.03
"""How far from a label change its corner is searched [domain units]."""
MAX_CHAIN_DISTANCE = 0.15
"""Front and back chain of a seam lie this close in the plane [domain units], or they don't belong together."""


@dataclass(frozen=True)
class Chain:
    """A stretch of one panel's border that carries one label."""

    label: int
    points: NDArray[np.int64]
    """Panel point indices from end to end, both corners included."""


@dataclass(frozen=True)
class Sewn:
    """Both panels in one index space, sewn."""

    points: NDArray[np.float64]
    """(P, 2) domain coordinates."""
    faces: NDArray[np.int64]
    """(F, 3) panel indices; counter-clockwise in the plane for the front, clockwise for the back: seen from outside."""
    panel_of_face: NDArray[np.int64]
    """(F,) 0 front, 1 back."""
    vertex_of_point: NDArray[np.int64]
    """(P,) the welded vertex."""
    labels: NDArray[np.int64]
    """(P,) -1 inside, else the border label."""


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
        beside = np.minimum(np.roll(run, 1), np.roll(run, -1))
        short = (run < SLIT_SHARE * beside) & (beside > 4 * SHORTEST_RUN)
        slits = np.nonzero((runs == 0) & (np.roll(runs, 1) == np.roll(runs, -1)) & short)[0]
        if len(starts) < 3 or not len(slits):
            return labels
        first, last = starts[slits[0]], starts[(slits[0] + 1) % len(starts)]
        index = np.arange(first, last + (len(labels) if last <= first else 0)) % len(labels)
        labels[index] = labels[first - 1]


def corner_near(points: NDArray, lengths: NDArray, change: int) -> int:
    """The loop vertex near a label change (first vertex of the new run) where the border turns most."""
    n = len(points)
    near = [change]
    for step in (-1, 1):
        k, walked = change, 0.0
        while len(near) < n:
            walked += lengths[k if step > 0 else (k - 1) % n]
            if walked > CORNER_REACH:
                break
            k = (k + step) % n
            near.append(k)
    window = np.array(near)
    reach = max(1, min(3, int(round(0.02 / max(float(lengths.mean()), 1e-9)))))
    before = points[window] - points[(window - reach) % n]
    after = points[(window + reach) % n] - points[window]
    turn = np.abs(np.arctan2(cross(before, after), (before * after).sum(1)))
    away = np.abs((window - change + n // 2) % n - n // 2)
    best = int((turn - 0.01 * away).argmax())
    return int(window[best]) if turn[best] > np.radians(25) else change


def chains_of(panel: Panel, labels: NDArray) -> tuple[list[Chain], NDArray]:
    """Seam chains of a panel and the border label of each of its points, from raw labels at its border vertices.

    labels: (B,) in the order of ``panel.border``. Chains end at corners, which neighbouring chains share.
    """
    chains, per_point, offset = [], np.full(len(panel.points), -1), 0
    for loop in panel.loops:
        place = panel.points[loop]
        lengths = np.linalg.norm(np.roll(place, -1, 0) - place, axis=1)
        clean = without_slits(clean_runs(labels[offset : offset + len(loop)], lengths), lengths)
        offset += len(loop)
        per_point[loop] = 0
        changes = np.nonzero(clean != np.roll(clean, 1))[0]
        corners = [corner_near(place, lengths, int(k)) for k in changes]
        for k, start in enumerate(corners):
            end = corners[(k + 1) % len(corners)]
            label = int(clean[changes[k]])
            if label == 0 or start == end:
                continue
            index = np.arange(start, end + 1 + (len(loop) if end <= start else 0)) % len(loop)
            chains.append(Chain(label, loop[index]))
    chains = _without_scraps(panel, chains)
    for chain in chains:
        per_point[chain.points] = chain.label
    return chains, per_point


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


def _resample(points: NDArray, at: NDArray) -> NDArray:
    t = arc_lengths(points)
    return np.stack([np.interp(at, t, points[:, k]) for k in (0, 1)], 1)


def pair_chains(front: Panel, back: Panel, fronts: list[Chain], backs: list[Chain]) -> list[tuple[Chain, Chain]]:
    """Chains that belong together: equal label, nearest in the plane; back chains turned to run along the front's."""
    at, pairs = np.linspace(0, 1, 9), []
    for label in sorted({c.label for c in fronts} & {c.label for c in backs}):
        a = [c for c in fronts if c.label == label]
        b = [c for c in backs if c.label == label]
        pa = np.stack([_resample(front.points[c.points], at) for c in a])
        pb = np.stack([_resample(back.points[c.points], at) for c in b])
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


class _Growing:
    """A panel whose border edges are being split."""

    def __init__(self, panel: Panel, labels: NDArray):
        self.panel = panel
        self.moved = panel.points.copy()
        self.new_points: list[NDArray] = []
        self.new_labels: list[int] = []
        self.faces = panel.faces.copy()
        self.new_faces: list[tuple[int, int, int]] = []
        self.labels = labels
        self.face_at: dict[tuple[int, int], int] = {}
        on_border = np.zeros(len(panel.points), bool)
        on_border[panel.border] = True
        self.rim = np.nonzero(corners(on_border[panel.faces]) >= 2)[0]

    def face(self, f: int) -> tuple[int, ...]:
        """A face, old or new."""
        return tuple(self.faces[f].tolist()) if f < len(self.faces) else self.new_faces[f - len(self.faces)]

    def insert(self, a: int, b: int, place: NDArray, label: int) -> int:
        """A new vertex on the border edge between a and b (either direction); returns its index."""
        f, a, b = self._owner(a, b)
        face = self.face(f)
        c = face[(face.index(a) + 2) % 3]
        new, beyond = len(self.moved) + len(self.new_points), len(self.faces) + len(self.new_faces)
        self.new_points.append(place)
        self.new_labels.append(label)
        if f < len(self.faces):
            self.faces[f] = (a, new, c)
        else:
            self.new_faces[f - len(self.faces)] = (a, new, c)
        self.new_faces.append((new, b, c))
        self.face_at.update({(new, b): beyond, (b, c): beyond})
        return new

    def _owner(self, a: int, b: int) -> tuple[int, int, int]:
        """The face at the border edge between a and b, and its ends in the face's order."""
        for edge in ((a, b), (b, a)):
            if edge in self.face_at:
                return self.face_at[edge], *edge
        near = self.faces[self.rim]
        f = int(self.rim[corners((near == a) | (near == b)) == 2][0])
        face = self.face(f)
        return (f, a, b) if face[(face.index(a) + 1) % 3] == b else (f, b, a)

    def thread(self, chain: Chain, t: NDArray, index: NDArray) -> NDArray:
        """Bring the chain to the arc lengths t; index says which of its points each is (-1: inserted)."""
        place = _resample(self.panel.points[chain.points], t)
        row = np.where(index >= 0, chain.points[index], -1)
        coming = row.copy()  # the chain's own point at or after each place
        for k in range(len(row) - 2, -1, -1):
            coming[k] = row[k] if row[k] >= 0 else coming[k + 1]
        for k in np.nonzero(row < 0)[0].tolist():
            row[k] = self.insert(int(row[k - 1]), int(coming[k]), place[k], chain.label)
        own = index >= 0
        own[[0, -1]] = False
        self.moved[row[own]] = place[own]
        return row

    def finish(self) -> tuple[NDArray, NDArray, NDArray]:
        """Points, faces and labels; points moved along the border no further than no triangle flips."""
        points = np.concatenate([self.panel.points, np.array(self.new_points).reshape(-1, 2)])
        faces = np.concatenate([self.faces, np.array(self.new_faces, np.int64).reshape(-1, 3)])
        away = self.moved != self.panel.points
        moved = np.nonzero(away[:, 0] | away[:, 1])[0]
        points = move_safely(points, faces, moved, self.moved[moved])
        return points, faces, np.concatenate([self.labels, np.array(self.new_labels, np.int64)])


def split_chords(points: NDArray, faces: NDArray, labels: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Split inner edges that join two seam points, so that sewing never makes an edge of four faces."""
    for _ in range(6):
        close = np.nonzero(corners((labels > 0)[faces]) >= 2)[0]
        near = faces[close]
        ends = np.concatenate([near[:, [0, 1]], near[:, [1, 2]], near[:, [2, 0]]])
        owner = np.tile(close, 3)
        both = (labels > 0)[ends].all(1)
        ends, owner = ends[both], owner[both]
        keys = ends.min(1) * len(points) + ends.max(1)
        unique, which, count = np.unique(keys, return_inverse=True, return_counts=True)
        inner = np.nonzero(count == 2)[0]
        if not len(inner):
            break
        busy: set[int] = set()
        middles: list[NDArray] = []
        halves: list[NDArray] = []
        faces = faces.copy()
        for k in inner:
            pair = owner[which == k].tolist()
            if busy & set(pair):
                continue
            busy |= set(pair)
            a, b = divmod(int(unique[k]), len(points))
            new = len(points) + len(middles)
            middles.append(0.5 * (points[a] + points[b]))
            for f in pair:
                halves.append(np.where(faces[f] == a, new, faces[f]))
                faces[f] = np.where(faces[f] == b, new, faces[f])
        points = np.concatenate([points, np.array(middles)])
        labels = np.concatenate([labels, np.full(len(middles), -1)])
        faces = np.concatenate([faces, np.array(halves)])
    return points, faces, labels


def sew(front: Panel, back: Panel, front_labels: NDArray, back_labels: NDArray, spacing: float) -> Sewn:
    """Sew two flat panels; labels are raw, per border vertex; ``spacing`` is the grid's cell edge [domain units]."""
    front_chains, front_points = chains_of(front, front_labels)
    back_chains, back_points = chains_of(back, back_labels)
    pairs = pair_chains(front, back, front_chains, back_chains)
    for chains, labels, used in (
        (front_chains, front_points, [a.points for a, _ in pairs]),
        (back_chains, back_points, [b.points for _, b in pairs]),
    ):
        sewn_points = np.concatenate(used) if used else np.zeros(0, np.int64)
        for chain in chains:  # chains without a partner stay open
            labels[np.setdiff1d(chain.points, sewn_points)] = 0
    grown = _Growing(front, front_points), _Growing(back, back_points)
    seams = []
    for a, b in pairs:
        ta = arc_lengths(front.points[a.points])
        tb = arc_lengths(back.points[b.points])
        length = np.linalg.norm(np.diff(front.points[a.points], axis=0), axis=1).sum()
        t, ia, ib = merge_parameters(ta, tb, 0.45 * spacing / max(length, spacing))
        seams.append((grown[0].thread(a, t, ia), grown[1].thread(b, t, ib)))
    parts = [split_chords(*growing.finish()) for growing in grown]
    return _weld(parts, seams)


def _weld(parts: list, seams: list[tuple[NDArray, NDArray]]) -> Sewn:
    """One index space, back faces turned outward, and one vertex per pair of seam points."""
    (p0, f0, l0), (p1, f1, l1) = parts
    n0, count = len(p0), len(p0) + len(p1)
    one = np.concatenate([a for a, _ in seams]) if seams else np.zeros(0, np.int64)
    other = np.concatenate([b for _, b in seams]) + n0 if seams else np.zeros(0, np.int64)
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    vertex = connected_components(graph, directed=False)[1].astype(np.int64)
    return Sewn(
        points=np.concatenate([p0, p1]),
        faces=np.concatenate([f0, f1[:, [0, 2, 1]] + n0]),
        panel_of_face=np.concatenate([np.zeros(len(f0), np.int64), np.ones(len(f1), np.int64)]),
        vertex_of_point=vertex,
        labels=np.concatenate([l0, l1]),
    )


def garment_loops(mesh_faces: NDArray) -> list[NDArray]:
    """Open border loops of a sewn mesh: neck, cuffs, hems ..."""
    return border_loops(mesh_faces)


def is_manifold(mesh_faces: NDArray) -> bool:
    """Every edge has one or two faces, two faces run along it in opposite directions, and borders are simple loops."""
    edges = np.concatenate([mesh_faces[:, [0, 1]], mesh_faces[:, [1, 2]], mesh_faces[:, [2, 0]]])
    if len(np.unique(edges, axis=0)) != len(edges):
        return False
    _, count = np.unique(np.sort(edges, 1), axis=0, return_counts=True)
    starts = border_edges(mesh_faces)[:, 0]
    return int(count.max()) <= 2 and len(np.unique(starts)) == len(starts)
