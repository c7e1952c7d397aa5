"""The open borders of a surface marched out of an unsigned field: cut where the surface ends, laid on it, smoothed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from recon.garments.panels import SNAP, border_edges, border_loops, cut_at_signs, split_pinches
from recon.garments.udf_grid import Field, slope

NOTCHES = 3
"""Rounds in which notches of the border are filled."""
SHARP = 0.3
"""Cosine of the angle of a notch."""
PEELS = 4
"""Rounds in which bad faces are taken off the border."""
FOLDED = 0.3
"""Cosine between a face's normal and its neighbours' below which it is folded over."""
SLIVER = 0.15
"""Height of a sliver over its side on the border [cells]."""


@dataclass(frozen=True)
class Cutting:
    """How a marched surface is cut, in cells of the grid that it came from."""

    cell: float
    """Side of a cell [m]."""
    beyond: float = 0.2
    """Vertices further beside the surface than this lie beyond its border."""
    scrap: float = 40.0
    """Pieces of less area [cells²] vanish."""
    pinhole: float = 40.0
    """Holes with a shorter rim close where the field says that there is a surface."""
    rounds: int = 2
    """Rounds in which borders are smoothed and laid on the surface's end."""


def cut(field: Field, points: NDArray, faces: NDArray, cutting: Cutting) -> tuple[NDArray, NDArray]:
    """Vertices (V, 3) [m] and faces (F, 3) of what really is surface.

    What lies beyond a border is cut off, and with it the flaps that signs make where none fit; scraps are dropped,
    pinholes closed, borders laid on the surface's end and smoothed.
    """
    points, faces = trim(field, points, faces, cutting)
    for _ in range(2):
        if not len(faces):
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        faces = peel(points, faces, cutting.cell)
        faces = without_scraps(points, faces, cutting.scrap * cutting.cell**2)
        faces = _two_sided(fill_notches(points, faces))
        faces, points = split_pinches(faces, points)
        points, faces = close_pinholes(field, *compact(points, faces), cutting)
        points = smooth_borders(field, points, faces, cutting)
    return points, faces


def trim(field: Field, points: NDArray, faces: NDArray, cutting: Cutting) -> tuple[NDArray, NDArray]:
    """The surface cut where its distance begins to grow along itself; the cut is laid on the closest points.

    As in ``panels``: vertices close to the cut move onto it, other edges are cut, so that no slivers arise.
    """
    distance, raw = (t.double().numpy() for t in slope(field, torch.as_tensor(points, dtype=torch.float32)))
    length = np.linalg.norm(raw, axis=1, keepdims=True)
    gradient = raw / np.maximum(length, 1e-9)
    # On the surface learned fields are flat, not zero: a short gradient there points anywhere.
    beside = _beside(points, faces, distance, raw / np.maximum(length, 1.0))
    away, near = beside > cutting.beyond * cutting.cell, SNAP * cutting.cell
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    inner, outer = ends[~away[ends[:, 0]] & away[ends[:, 1]]].T
    sign = np.where(away, 1, -1)
    sign[away & (beside < near)] = 0
    left = (1 - _share(points, inner, outer, distance, gradient)) * _length(points[inner] - points[outer])
    sign[inner[left < near]] = 0
    if (sign < 0).sum() < 3:
        return points, faces[:0]
    faces, pairs = cut_at_signs(faces, sign)
    a, b = pairs.T
    share = np.clip(1 - _share(points, a, b, distance, gradient), 0.15, 0.85)[:, None]
    border = np.concatenate([points[sign == 0], points[a] + share * (points[b] - points[a])])
    u, g = _slope(field, border)
    border -= u[:, None] * g
    points = points.copy()
    points[sign == 0] = border[: (sign == 0).sum()]
    return np.concatenate([points, border[(sign == 0).sum() :]]), faces


def peel(points: NDArray, faces: NDArray, cell: float) -> NDArray[np.int64]:
    """Faces without those on the border that are slivers along it or folded over: no direction out of the surface fits
    them. Slivers that only end at the border stay: grids make whole columns of them, and each would bare the next.
    """
    zone, rest = _zone(faces)
    inner = _touched(rest, len(points))
    for _ in range(PEELS):
        area, size = areas(points, zone)
        half = np.concatenate([zone[:, [0, 1]], zone[:, [1, 2]], zone[:, [2, 0]]])
        key = half.min(1) * np.int64(len(points)) + half.max(1)
        edge, which, count = np.unique(key, return_inverse=True, return_counts=True)
        which = which.reshape(3, -1)
        sums = np.stack([np.bincount(which.ravel(), np.tile(area[:, k], 3), len(edge)) for k in range(3)], 1)
        around = sums[which].sum(0) - 3 * area  # the neighbours' areas, each once
        agree = (around * area).sum(1) / np.maximum(_length(around) * _length(area), 1e-18)
        rim = (count[which] == 1) & ~inner[half].all(1).reshape(3, -1)
        along = np.where(rim, _length(points[half[:, 0]] - points[half[:, 1]]).reshape(3, -1), 0.0).max(0)
        bad = rim.any(0) & ((agree < FOLDED) | (2 * size < SLIVER * cell * along))
        if not bad.any():
            break
        zone = zone[~bad]
    return np.concatenate([rest, zone])


def _two_sided(faces: NDArray) -> NDArray[np.int64]:
    """Faces without those that run along an edge in a direction that another one has: rough fields can make such."""
    while len(faces):
        half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        key = half[:, 0] * (np.int64(faces.max()) + 1) + half[:, 1]
        order = np.argsort(key)
        again = np.zeros(len(key), bool)
        again[order[1:]] = key[order[1:]] == key[order[:-1]]
        bad = again.reshape(3, -1).any(0)
        if not bad.any():
            break
        faces = faces[~bad]
    return faces


def _zone(faces: NDArray, rings: int = 3) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces within a few rings of the borders, and the others."""
    near = np.zeros(faces.max() + 1, bool)
    near[border_edges(faces).ravel()] = True
    for _ in range(rings):
        inside = near[faces].any(1)
        near[faces[inside].ravel()] = True
    return faces[inside], faces[~inside]


def _touched(faces: NDArray, count: int) -> NDArray[np.bool_]:
    touched = np.zeros(count, bool)
    touched[faces.ravel()] = True
    return touched


def fill_notches(points: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """Faces with one more wherever the border turns sharply into the surface: what peeling left is no wider than a
    cell."""
    if not len(faces):
        return faces
    zone, rest = _zone(faces)
    inner = _touched(rest, len(points))
    for _ in range(NOTCHES):
        edges = border_edges(zone)
        edges = edges[~inner[edges].all(1)]
        before, after = np.full(len(points), -1), np.full(len(points), -1)
        after[edges[:, 0]], before[edges[:, 1]] = edges[:, 1], edges[:, 0]
        once = (np.bincount(edges[:, 0], minlength=len(points)) == 1) & (
            np.bincount(edges[:, 1], minlength=len(points)) == 1
        )
        v = np.flatnonzero(once & once[after] & once[before] & (after >= 0) & (before >= 0))
        a, b = before[v], after[v]
        back, on = points[a] - points[v], points[b] - points[v]
        sharp = (back * on).sum(1) > SHARP * np.maximum(_length(back) * _length(on), 1e-18)
        inward = (np.cross(back, on) * vertex_normals(points, zone)[v]).sum(1) > 0
        new = np.stack([a, b, v], 1)[sharp & inward & (a != b)]
        taken = np.concatenate([zone[:, [0, 1]], zone[:, [1, 2]], zone[:, [2, 0]]])
        known = set(map(tuple, taken[np.isin(taken[:, 0], new[:, :2].ravel(), kind="table")].tolist()))
        free = [t for t in new.tolist() if (t[0], t[1]) not in known and (t[1], t[0]) not in known]  # no edge twice
        if not free:
            break
        zone = _with(zone, free)
    return np.concatenate([rest, zone])


def _with(faces: NDArray[np.int64], new: list[list[int]]) -> NDArray[np.int64]:
    """Faces with those of ``new`` that share no vertex with one before them."""
    used: set[int] = set()
    kept = []
    for triangle in new:
        if not used & set(triangle):
            kept.append(triangle)
            used |= set(triangle)
    return np.concatenate([faces, np.array(kept)])


def areas(points: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Normals (F, 3) as long as twice the area, and areas (F,)."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return normal, 0.5 * _length(normal)


def _share(points: NDArray, inner: NDArray, outer: NDArray, distance: NDArray, gradient: NDArray) -> NDArray:
    """(E,) how far along the edge back from its outer end the border is, by the distance there: in [0, 1]."""
    back = ((points[inner] - points[outer]) * -gradient[outer]).sum(1)
    return np.clip(distance[outer] / np.maximum(back, 1e-9), 0.0, 1.0)


def _length(v: NDArray) -> NDArray:
    return np.linalg.norm(v, axis=1)


def _slope(field: Field, points: NDArray) -> tuple[NDArray, NDArray]:
    """Distances and unit gradients."""
    u, g = (t.double().numpy() for t in slope(field, torch.as_tensor(points, dtype=torch.float32)))
    return u, g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-9)


def vertex_normals(points: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(V, 3) unit normals, weighted by area; zero where faces have none."""
    area, _ = areas(points, faces)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(area[:, k], 3), len(points)) for k in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _beside(points: NDArray, faces: NDArray, distance: NDArray, gradient: NDArray) -> NDArray:
    """(V,) how far vertices lie beside the surface [m]: what their distance has along the marched surface."""
    normal = vertex_normals(points, faces)
    along = gradient - (gradient * normal).sum(1, keepdims=True) * normal
    return distance * np.linalg.norm(along, axis=1)


def without_scraps(points: NDArray, faces: NDArray, least: float) -> NDArray:
    if not len(faces):
        return faces
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(points), len(points)))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    area = np.bincount(piece, areas(points, faces)[1])
    return faces[area[piece] >= least]


def compact(points: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    used, faces = np.unique(faces, return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def close_pinholes(field: Field, points: NDArray, faces: NDArray, cutting: Cutting) -> tuple[NDArray, NDArray]:
    """Holes of a few cells filled by a fan, where the field says that their middle is surface."""
    fans, middles = [], []
    for loop in border_loops(faces):
        rim = points[loop]
        length = np.linalg.norm(rim - np.roll(rim, 1, 0), axis=1).sum()
        if length < cutting.pinhole * cutting.cell:
            fans.append(loop)
            middles.append(rim.mean(0))
    if not fans:
        return points, faces
    distance, gradient = _slope(field, np.array(middles))
    for loop, middle, u, g in zip(fans, middles, distance, gradient, strict=True):
        if u < cutting.cell:
            tip = np.full(len(loop), len(points))
            faces = np.concatenate([faces, np.stack([np.roll(loop, -1), loop, tip], 1)])
            points = np.concatenate([points, (middle - u * g)[None]])
    return points, faces


def outward(
    points: NDArray, edges: NDArray[np.int64], normal: NDArray
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Border vertices (B,) and the unit directions (B, 3) out of the surface there, at right angles to the border.

    edges (E, 2): the border's directed edges, the surface on their left. Directions are averaged along the border: in a
    notch only the neighbours know which way is out.
    """
    rim, index = np.unique(edges, return_inverse=True)
    index = index.reshape(-1, 2)
    along = np.zeros((len(rim), 3))
    for ends in index.T:
        np.add.at(along, ends, points[edges[:, 1]] - points[edges[:, 0]])
    out = np.cross(along, normal[rim])  # faces lie to the left of their edges
    for _ in range(3):
        out = averaged(out, index)
    return rim, out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def smooth_borders(field: Field, points: NDArray, faces: NDArray, cutting: Cutting) -> NDArray[np.float64]:
    """Vertices (V, 3), those on borders smoothed along the border and taken back onto the surface's end.

    What is a cell beyond a border has its closest point on it: that brings vertices back.
    """
    edges = border_edges(faces)
    if not len(edges):
        return points
    rim, index = np.unique(edges, return_inverse=True)
    index = index.reshape(-1, 2)
    points = points.copy()
    fringe = faces[_touched(rim, len(points))[faces].any(1)]
    for _ in range(cutting.rounds):
        points[rim] = averaged(averaged(points[rim], index), index)
        _, way = outward(points, edges, vertex_normals(points, fringe))
        beyond = points[rim] + cutting.cell * way
        distance, gradient = _slope(field, beyond)
        step = beyond - distance[:, None] * gradient - points[rim]
        step[distance < 0.3 * cutting.cell] = 0.0  # that was not out of the surface
        points[rim] += step
    return points


def averaged(values: NDArray, links: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values (B, 3) along closed borders, each half its own and half its two neighbours'."""
    sums = np.zeros_like(values)
    np.add.at(sums, links[:, 0], values[links[:, 1]])
    np.add.at(sums, links[:, 1], values[links[:, 0]])
    return 0.5 * values + 0.25 * sums
