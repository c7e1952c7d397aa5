"""Marching cubes on a band of cells: one vertex per crossed edge, shared by all cells around it.

The table is made here from one rule for the faces of a cell (where corners alternate, the positive ones are cut off),
which two cells that share a face follow alike: the result has no cracks.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from recon.garments.udf_grid import Band
from recon.garments.udf_signs import CELL_EDGES

FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (2, 3, 7, 6), (0, 4, 7, 3), (1, 2, 6, 5))
"""Corners of a cell's faces, counter-clockwise seen from outside."""


@cache
def table() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row (257,) of each case and its triangles (T, 3) as edges of the cell; bit k of a case: corner k negative.

    Triangles are counter-clockwise seen from the positive side.
    """
    edge = {frozenset(map(int, ends)): k for k, ends in enumerate(CELL_EDGES)}
    rows: list[tuple[int, int, int]] = []
    first = [0]
    for case in range(256):
        follows = _segments([case >> k & 1 == 1 for k in range(8)], edge)
        while follows:
            start, at = follows.popitem()
            loop = [start]
            while at != start:
                loop.append(at)
                at = follows.pop(at)
            rows += [(loop[0], loop[k], loop[k + 1]) for k in range(1, len(loop) - 1)]
        first.append(len(rows))
    return np.array(first), np.array(rows)


def _segments(negative: list[bool], edge: dict[frozenset[int], int]) -> dict[int, int]:
    """Crossed edge -> the crossed edge that follows it on the surface's outline in the cell."""
    follows = {}
    for face in FACES:
        for k in range(4):
            # A run of positive corners begins after corner k; the segment cuts off that run.
            if negative[face[k]] and not negative[face[(k + 1) % 4]]:
                last = next(m for m in range(k + 1, k + 4) if negative[face[(m + 1) % 4]])
                begin = edge[frozenset((face[k], face[(k + 1) % 4]))]
                end = edge[frozenset((face[last % 4], face[(last + 1) % 4]))]
                follows[end] = begin
    return follows


def march(band: Band, sign: NDArray[np.int8]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) [m] and faces (F, 3) where ``sign`` (N,) changes; places by the distances at both ends."""
    negative = sign < 0
    case = (negative[band.corners] << np.arange(8)).sum(1)
    mixed = (case > 0) & (case < 255)
    case, corners = case[mixed], band.corners[mixed]
    first, rows = table()
    count = first[case + 1] - first[case]
    cell = np.repeat(np.arange(len(case)), count)
    within = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    edges = rows[first[case][cell] + within]
    ends = corners[cell[:, None, None], CELL_EDGES[edges]]
    key = ends[..., 0] * np.int64(len(sign)) + ends[..., 1]
    unique, faces = np.unique(key, return_inverse=True)
    a, b = np.divmod(unique, len(sign))
    u, v = band.distance[a], band.distance[b]
    share = u / np.maximum(u + v, 1e-12)
    points = band.points
    return points[a] + share[:, None] * (points[b] - points[a]), faces.reshape(-1, 3)
