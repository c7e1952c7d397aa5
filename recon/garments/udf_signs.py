"""Pseudo-signs for an unsigned field: on which side of the surface the corners of a band lie (MeshUDF §3.1).

Two neighbouring corners vote by their distances and gradients whether the surface passes between them. Votes are wrong
here and there (creases, sheets closer than a cell, borders), and a wrong one may be as sure as any. So corners join
along the surest votes into groups, and between groups the votes of all edges count together: a wrong one is outvoted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from recon.garments.udf_grid import Band, Field, slope

CELL_EDGES = np.array([[0, 1], [3, 2], [4, 5], [7, 6], [0, 3], [1, 2], [4, 7], [5, 6], [0, 4], [1, 5], [2, 6], [3, 7]])
"""(12, 2) ends of a cell's edges, along x, then y, then z, from the lower to the upper end."""
SURE = 0.3
"""Sum of the two distances, in cells, from which a vote counts in full: closer to the surface gradients are noise."""
HIT = 0.05
"""Distance, in cells, at which a point counts as on the surface."""
LEAST = 1e-6
"""Votes that are no surer than this are none."""
SWEEPS = 6
"""Rounds in which single corners are outvoted."""


@dataclass(frozen=True)
class Ends:
    """Points and what the field says there."""

    point: NDArray[np.float64]
    """(E, 3) [m]."""
    distance: NDArray[np.float64]
    """(E,) [m]."""
    slope: NDArray[np.float64]
    """(E, 3) unit gradients."""


def signs(field: Field, band: Band, floor: float = 0.0) -> NDArray[np.int8]:
    """(N,) +1 or -1 per corner of the band, consistent within each connected piece; which side is +1 is arbitrary.

    ``floor``: distance [m] that the field may show on the surface.
    """
    edges = band_edges(band)
    vote = votes(field, band, edges, floor)
    return _outvoted(_settled(band, edges, vote), band, edges, vote)


def band_edges(band: Band) -> NDArray[np.int64]:
    """(E, 2) distinct edges of the band's cells, lower end first."""
    count = len(band.at)
    parts = []
    for k in range(3):  # a corner has one edge along each axis: a table instead of sorting
        after = np.full(count, -1, np.int64)
        for a, b in CELL_EDGES[4 * k : 4 * k + 4]:
            after[band.corners[:, a]] = band.corners[:, b]
        here = np.flatnonzero(after >= 0)
        parts.append(np.stack([here, after[here]], 1))
    return np.concatenate(parts)


def votes(field: Field, band: Band, edges: NDArray[np.int64], floor: float = 0.0) -> NDArray[np.float64]:
    """(E,) in [-1, 1]: +1 both ends surely on one side, -1 the surface surely passes between them.

    Edges that seem to be crossed are asked about once more: where two sheets pass between the ends, or the surface
    ended before it, a single crossing was a mistake, and the field where it should be says so.
    """
    a, b = (Ends(band.points[k], band.distance[k], band.slope[k]) for k in edges.T)
    vote = _vote(a, b, band.cell)
    ask = np.flatnonzero(vote < 0)
    a, b = (Ends(band.points[k], band.distance[k], band.slope[k]) for k in edges[ask].T)
    at = a.point + (a.distance / np.maximum(a.distance + b.distance, 1e-12))[:, None] * (b.point - a.point)
    u, g = (t.double().numpy() for t in slope(field, torch.as_tensor(at, dtype=torch.float32)))
    middle = Ends(at, u, g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-9))
    first, second = _vote(a, middle, band.cell), _vote(middle, b, band.cell)
    twice = np.sign(first * second) * np.minimum(np.abs(first), np.abs(second))
    vote[ask] = np.where(u < HIT * band.cell + floor, vote[ask], twice)
    return vote


def _vote(a: Ends, b: Ends, cell: float) -> NDArray[np.float64]:
    """Each end predicts the other's signed distance with its own tangent plane; what the other measures bounds it.

    On a plane this is exactly ±1; between two sheets that face each other both ends see themselves on one side.
    """
    way, u, v = b.point - a.point, a.distance, b.distance
    there = np.clip(u + (a.slope * way).sum(1), -v, v)
    back = np.clip(v - (b.slope * way).sum(1), -u, u)
    aligned = np.abs((a.slope * b.slope).sum(1))  # beside creases and borders gradients turn: no vote is sure there
    return aligned * (there + back) / np.maximum(u + v, SURE * cell)


def _settled(band: Band, edges: NDArray[np.int64], vote: NDArray) -> NDArray[np.int8]:
    """Signs from the votes: groups join along the surest of their summed votes, until no vote is left between any.

    In each round every group names its surest neighbour, and the surer half of these join.
    """
    count = len(band.at)
    sign, group = np.ones(count, np.int8), np.arange(count)
    a, b, vote, groups = *edges.T, vote, count
    while True:
        counts = np.abs(vote) > LEAST
        a, b, vote = a[counts], b[counts], vote[counts]
        if not len(vote):
            return sign
        best = _surest(a, b, np.abs(vote), groups)
        sure = np.abs(vote[best])
        best = best[sure >= np.median(sure)]
        flip, label = _joined(a[best], b[best], vote[best], groups)
        sign *= flip[group]
        group, groups = label[group], int(label.max()) + 1
        a, b, vote = _together(label[a], label[b], vote * flip[a] * flip[b], groups)


def _surest(a: NDArray, b: NDArray, sure: NDArray, count: int) -> NDArray[np.int64]:
    """Which links are the surest of a node at either of their ends."""
    order = np.argsort(sure, kind="stable")
    best = np.full((2, count), -1)
    for side, ends in zip(best, (a, b), strict=True):
        side[ends[order]] = order  # the last that is written stays
    known = np.append(sure, -1.0)
    return np.setdiff1d(np.where(known[best[0]] >= known[best[1]], *best), -1)


def _together(a: NDArray, b: NDArray, vote: NDArray, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """All votes between the same two groups added up."""
    between = a != b
    low, high = np.minimum(a, b)[between], np.maximum(a, b)[between]
    key, which = np.unique(low * np.int64(count) + high, return_inverse=True)
    return *np.divmod(key, count), np.bincount(which, vote[between], len(key))


def _joined(a: NDArray, b: NDArray, vote: NDArray, count: int) -> tuple[NDArray[np.int8], NDArray[np.int64]]:
    """Signs (count,) along the tree of the surest votes, and which nodes it joins."""
    if not len(a):
        return np.ones(count, np.int8), np.arange(count)
    cost = 1e-3 + 1 - np.abs(vote) / max(float(np.abs(vote).max()), 1e-12)
    tree = minimum_spanning_tree(csr_matrix((cost, (a, b)), shape=(count, count))).tocoo()
    order = a * np.int64(count) + b
    rank = np.argsort(order)
    flip = (vote < 0)[rank[np.searchsorted(order[rank], tree.row.astype(np.int64) * count + tree.col)]]
    pieces, piece = connected_components(tree, directed=False)
    return _follow(tree, flip, piece, pieces), piece.astype(np.int64)


def _follow(tree: coo_matrix, flip: NDArray[np.bool_], piece: NDArray, pieces: int) -> NDArray[np.int8]:
    """Signs from the root of each piece of a forest outwards; ``flip`` says along which links they change."""
    root = len(piece)  # one more node, linked to one of each piece
    first = np.full(pieces, root)
    np.minimum.at(first, piece, np.arange(root))
    rows, columns = np.concatenate([tree.row, np.full(pieces, root)]), np.concatenate([tree.col, first])
    links = np.concatenate([np.where(flip, 2.0, 1.0), np.ones(pieces)])
    graph = coo_matrix((links, (rows, columns)), shape=(root + 1, root + 1)).tocsr()
    graph = (graph + graph.T).tocsr()
    _, before = breadth_first_order(graph, root, directed=True)
    before[root] = root
    sign = np.ones(root + 1, np.int8)
    link = np.asarray(graph[np.arange(root), before[:root]]).ravel()
    sign[:root] = np.where(link > 1.5, -1, 1)
    while (before != root).any():  # pointer jumping: after k rounds a sign has come from 2^k links away
        sign *= sign[before]
        before = before[before]
    return sign[:root]


def _outvoted(sign: NDArray[np.int8], band: Band, edges: NDArray[np.int64], vote: NDArray) -> NDArray[np.int8]:
    """Corners that most of their neighbours' votes speak against change sides, even and odd ones in turn."""
    odd = band.at.sum(1) % 2 == 1
    for sweep in range(SWEEPS):
        agree = vote * sign[edges[:, 0]] * sign[edges[:, 1]]
        gain = np.bincount(edges.ravel(), np.repeat(agree, 2), len(sign))
        sign = np.where((gain < 0) & (odd == (sweep % 2 == 1)), -sign, sign).astype(np.int8)
    return sign
