"""Triangulate a flat panel: borders cut evenly, a regular triangle grid inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Edge:
    """One labelled piece of a panel's border."""

    label: str
    """Seam name, or "open"."""
    line: NDArray
    """(N, 2) polyline [m]."""
    held: bool = False
    """Held by the wearer's body while draping: a waistband."""


@dataclass(frozen=True)
class PanelMesh:
    """A triangulated panel."""

    points: NDArray
    """(P, 2) border points first, in the loop's order [m]."""
    faces: NDArray
    """(F, 3) counter-clockwise in the panel's plane."""
    edges: list[NDArray]
    """Per border edge the point indices along it, both ends included."""


def resample(line: NDArray, count: int) -> NDArray:
    """(count + 1, 2) points at even arc length on a polyline (N, 2)."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, length[-1], count + 1)
    return np.stack([np.interp(at, length, line[:, k]) for k in (0, 1)], 1)


def inside(points: NDArray, loop: NDArray) -> NDArray:
    """(N,) whether points (N, 2) lie inside the closed polygon (B, 2): even-odd rule."""
    x, y = points[:, :1], points[:, 1:]
    a, b = loop, np.roll(loop, -1, 0)
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    return ((crosses & (x < at)).sum(1) % 2).astype(bool)


def area(loop: NDArray) -> float:
    """Signed area of a closed polygon (B, 2) [m²], positive counter-clockwise."""
    following = np.roll(loop, -1, 0)
    return float(0.5 * (loop[:, 0] * following[:, 1] - loop[:, 1] * following[:, 0]).sum())


def triangulate(border: list[Edge], edge_length: float) -> PanelMesh:
    """Mesh one panel whose border edges form a counter-clockwise loop.

    Raises ``ValueError`` where the border cannot be kept (parts closer to each other than the edge length).
    """
    loop, runs = _cut_border(border, edge_length)
    grid = _grid(loop, edge_length)
    points = np.concatenate([loop, grid])
    faces = _delaunay(points, loop)
    for _ in range(4):
        points = _relax(points, faces, len(loop), loop, edge_length)
    faces = _delaunay(points, loop)
    _check(points, faces, loop)
    # Smallest corner first, faces in its order: neighbours in the list are neighbours in the cloth.
    first = faces.argmin(1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, 1)
    faces = faces[np.lexsort((faces[:, 2], faces[:, 1], faces[:, 0]))]
    return PanelMesh(points, faces, runs)


def _cut_border(border: list[Edge], edge_length: float) -> tuple[NDArray, list[NDArray]]:
    pieces, starts, total = [], [], 0
    for edge in border:
        length = np.linalg.norm(np.diff(edge.line, axis=0), axis=1).sum()
        count = max(2, 2 * round(length / edge_length / 2))  # even: the middle of a neckline or hem is a vertex
        pieces.append(resample(edge.line, count)[:-1])
        starts.append((total, count))
        total += count
    runs = [(np.arange(first, first + count + 1)) % total for first, count in starts]
    return np.concatenate(pieces), runs


def _grid(loop: NDArray, h: float) -> NDArray:
    """Points of a regular triangle grid, symmetric about x = 0, inside the loop and off its border."""
    from scipy.spatial import cKDTree

    low, high = loop.min(0), loop.max(0)
    reach = int(np.ceil(max(abs(low[0]), abs(high[0])) / h)) + 1
    rows = []
    for j, y in enumerate(np.arange(low[1] + h * 0.5, high[1], h * np.sqrt(3) / 2)):
        xs = np.arange(-reach, reach + 1) * h + (h / 2 if j % 2 else 0.0)
        rows.append(np.stack([xs, np.full_like(xs, y)], 1))
    grid = np.concatenate(rows)
    grid = grid[inside(grid, loop)]
    middles = (loop + np.roll(loop, -1, 0)) / 2
    distance, _ = cKDTree(np.concatenate([loop, middles])).query(grid)
    return grid[distance > 0.65 * h]


def _delaunay(points: NDArray, loop: NDArray) -> NDArray:
    from scipy.spatial import Delaunay

    faces = Delaunay(points).simplices.astype(np.int64)
    faces = faces[inside(points[faces].mean(1), loop)]
    a, b, c = (points[faces[:, k]] for k in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[doubled < 0] = faces[doubled < 0][:, [0, 2, 1]]
    return faces[np.abs(doubled) > 1e-9]


def _relax(points: NDArray, faces: NDArray, fixed: int, loop: NDArray, h: float) -> NDArray:
    """Move the points next to the border to their neighbours' mean; the regular inside stays as it is."""
    from scipy.spatial import cKDTree

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(edges[:, 0], minlength=len(points))
    total = np.stack([np.bincount(edges[:, 0], points[edges[:, 1], k], len(points)) for k in (0, 1)], 1)
    mean = total / np.maximum(count, 1)[:, None]
    near = cKDTree(loop).query(points)[0] < 2.2 * h
    near[:fixed] = False
    return np.where(near[:, None], 0.5 * points + 0.5 * mean, points)


def _check(points: NDArray, faces: NDArray, loop: NDArray) -> None:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    rim = unique[count == 1]
    n = len(loop)
    wanted = np.sort(np.stack([np.arange(n), (np.arange(n) + 1) % n], 1), 1)
    if len(rim) != n or {tuple(e) for e in rim.tolist()} != {tuple(e) for e in wanted.tolist()}:
        raise ValueError("the panel's border is too narrow for this edge length")
    if len(np.unique(faces)) != len(points):
        raise ValueError("the panel has points outside of its triangles")
