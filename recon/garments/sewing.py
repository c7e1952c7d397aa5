"""Sew panels along borders of equal label, by arc length (ISP B.2 puts strips of triangles between).

Each seam's two chains get the same number of points at the same relative arc lengths: points that nearly match move to
their common place, the others are inserted on the other side. Each pair becomes one vertex of the garment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from recon.garments.chains import Chain, arc_lengths, chains_of, merge_parameters, pair_chains, resampled
from recon.garments.panels import Panel, border_edges, border_loops, corners, cross, move_safely, signed_areas

SLIVER = 0.06
"""Height of a sliver over its longest side."""


@dataclass(frozen=True)
class Sewn:
    """All panels in one index space, sewn."""

    points: NDArray[np.float64]
    """(P, 2) domain coordinates."""
    faces: NDArray[np.int64]
    """(F, 3) point indices; counter-clockwise in the plane before the body, clockwise behind it: seen from outside."""
    panel_of_face: NDArray[np.int64]
    """(F,) index of the panel."""
    vertex_of_point: NDArray[np.int64]
    """(P,) the welded vertex."""
    labels: NDArray[np.int64]
    """(P,) -1 inside, else the border label."""


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
        place = resampled(self.panel.points[chain.points], t)
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
        labels = np.concatenate([self.labels, np.array(self.new_labels, np.int64)])
        return points, without_slivers(points, faces), labels


def without_slivers(points: NDArray, faces: NDArray) -> NDArray:
    """Faces with the longest edges of slivers turned to the corner across, where that makes both better.

    A triangle a few hundredths of a millimetre high is torn by the slightest change, and takes all of a drape's strain.
    """
    ends = points[faces]
    sides = ends[:, [1, 2, 0]] - ends
    squares = np.einsum("fkx,fkx->fk", sides, sides)
    thin = np.nonzero(np.abs(cross(sides[:, 0], sides[:, 1])) < SLIVER * squares.max(1))[0]
    if not len(thin):
        return faces
    faces = faces.copy()
    touched = np.zeros(len(points), bool)
    touched[faces[thin]] = True
    near = np.nonzero(corners(touched[faces]) > 0)[0]  # all that can be turned or stand in the way
    owner = {(f[k], f[(k + 1) % 3]): n for n, f in zip(near.tolist(), faces[near].tolist()) for k in range(3)}
    for n in thin.tolist():
        longest = squares[n].argmax()
        a, c = int(faces[n, longest]), int(faces[n, (longest + 1) % 3])
        b, other = int(faces[n, (longest + 2) % 3]), owner.get((c, a))
        if other is None or owner.get((a, c)) != n:  # on the border, or turned already
            continue
        d = int(faces[other].sum()) - a - c
        new = np.array([(b, a, d), (b, d, c)])
        if (b, d) in owner or (d, b) in owner or (_shape(points, new).min() <= _shape(points, faces[[n, other]]).min()):
            continue
        faces[n], faces[other] = new
        owner.pop((a, c)), owner.pop((c, a))
        owner |= {(int(f[k]), int(f[(k + 1) % 3])): row for row, f in zip((n, other), new) for k in range(3)}
    return faces


def _shape(points: NDArray, faces: NDArray) -> NDArray:
    """(F,) signed height over the longest side of each flat triangle, which is counter-clockwise."""
    ends = points[faces]
    return 2 * signed_areas(points, faces) / np.square(ends[:, [1, 2, 0]] - ends).sum(2).max(1)


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


def sew(panels: Sequence[Panel], labels: Sequence[NDArray], turned: Sequence[bool], spacing: float) -> Sewn:
    """Sew flat panels; any two are sewn where both have a border of one label.

    Args:
        panels: in the plane that they share.
        labels: raw, per border vertex of each panel.
        turned: which panels lie behind the body: their faces are turned over.
        spacing: the grid's cell edge [domain units].
    """
    found = [chains_of(panel, own) for panel, own in zip(panels, labels, strict=True)]
    panels = [panel for panel, _, _ in found]
    pairs = [
        (i, j, a, b)
        for i, j in combinations(range(len(panels)), 2)
        for a, b in pair_chains(panels[i], panels[j], found[i][1], found[j][1])
    ]
    grown = []
    for k, (panel, chains, per_point) in enumerate(found):
        used = [a.points for i, _, a, _ in pairs if i == k] + [b.points for _, j, _, b in pairs if j == k]
        sewn_points = np.concatenate(used) if used else np.zeros(0, np.int64)
        for chain in chains:  # chains without a partner stay open
            per_point[np.setdiff1d(chain.points, sewn_points)] = 0
        grown.append(_Growing(panel, per_point))
    seams = []
    for i, j, a, b in pairs:
        ta = arc_lengths(panels[i].points[a.points])
        tb = arc_lengths(panels[j].points[b.points])
        length = np.linalg.norm(np.diff(panels[i].points[a.points], axis=0), axis=1).sum()
        t, ia, ib = merge_parameters(ta, tb, 0.45 * spacing / max(length, spacing))
        seams.append(((i, grown[i].thread(a, t, ia)), (j, grown[j].thread(b, t, ib))))
    return _weld([split_chords(*growing.finish()) for growing in grown], seams, turned)


_Side = tuple[int, NDArray]
"""A panel and points of it along a seam."""


def _weld(parts: list, seams: list[tuple[_Side, _Side]], turned: Sequence[bool]) -> Sewn:
    """One index space, turned panels' faces turned outward, and one vertex per pair of seam points."""
    first = np.cumsum([0, *(len(points) for points, _, _ in parts)])
    sides = [[side[k][1] + first[side[k][0]] for side in seams] for k in (0, 1)]
    one, other = (np.concatenate(side) if side else np.zeros(0, np.int64) for side in sides)
    graph = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(first[-1], first[-1]))
    vertex = connected_components(graph, directed=False)[1].astype(np.int64)
    faces = [f[:, [0, 2, 1]] if over else f for (_, f, _), over in zip(parts, turned, strict=True)]
    return Sewn(
        points=np.concatenate([points for points, _, _ in parts]),
        faces=np.concatenate([f + start for f, start in zip(faces, first, strict=False)]),
        panel_of_face=np.repeat(np.arange(len(faces)), [len(f) for f in faces]),
        vertex_of_point=vertex,
        labels=np.concatenate([own for _, _, own in parts]),
    )


def sewn_to(vertex_of_point: NDArray) -> NDArray:
    """(P,) for each panel point the next one of its welded vertex, in a cycle; itself where it is alone."""
    order = np.argsort(vertex_of_point, kind="stable")
    _, first, count = np.unique(vertex_of_point[order], return_index=True, return_counts=True)
    ahead = np.roll(order, -1)
    ahead[first + count - 1] = order[first]
    partner = np.empty(len(order), np.int64)
    partner[order] = ahead
    return partner


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
