"""Exact self-intersections of a triangle mesh: a broad phase by boxes, then triangle against triangle in float64.

Two triangles intersect if an edge of one passes through the other. Triangles that share one vertex are tested by the
edges opposite of it, those that share an edge can only overlap by folding flat onto each other, which has no volume
and is not counted (the exact test of a shared edge is a matter of one plane).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def self_intersections(vertices, faces) -> NDArray:
    """(K, 2) pairs of faces that pass through each other, each pair once, sorted.

    ``vertices`` (V, 3) and ``faces`` (F, 3): arrays or tensors.
    """
    v = np.asarray(_numpy(vertices), np.float64)
    f = np.asarray(_numpy(faces), np.int64)
    pairs = _candidates(v, f)
    shared = (f[pairs[:, 0]][:, :, None] == f[pairs[:, 1]][:, None, :]).sum((1, 2))
    pairs = pairs[shared < 2]
    hits = np.zeros(len(pairs), bool)
    for a, b in ((0, 1), (1, 0)):
        for k in range(3):
            p, q = f[pairs[:, a], k], f[pairs[:, a], (k + 1) % 3]
            other = f[pairs[:, b]]
            # An edge that ends on the other triangle's corner touches it there by construction.
            free = ~((p[:, None] == other).any(1) | (q[:, None] == other).any(1)) & ~hits
            hits[free] |= segment_crosses(v[p[free]], v[q[free]], v[other[free]])
    found = np.sort(pairs[hits], axis=1)
    return found[np.lexsort((found[:, 1], found[:, 0]))]


def segment_crosses(p: NDArray, q: NDArray, triangles: NDArray) -> NDArray:
    """(N,) whether segments p-q (N, 3) cross triangles (N, 3, 3), ends and borders included; coplanar ones don't count.

    By signs of tetrahedron volumes: no division, so no tolerance.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    above, below = _volume(a, b, c, p), _volume(a, b, c, q)
    split = (above * below <= 0) & ~((above == 0) & (below == 0))
    u, v, w = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    through = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
    return split & through


def _volume(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray:
    """Six times the signed volume of tetrahedra."""
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)


def _candidates(v: NDArray, f: NDArray) -> NDArray:
    """(N, 2) pairs of faces whose boxes overlap: neighbours by centre first, then boxes."""
    from scipy.spatial import cKDTree

    corners = v[f]
    low, high = corners.min(1), corners.max(1)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
    # A few long triangles would make every search wide: they are searched for on their own.
    usual = float(np.quantile(radius, 0.98))
    small, large = np.flatnonzero(radius <= usual), np.flatnonzero(radius > usual)
    tree = cKDTree(centre[small])
    found = [small[tree.query_pairs(2 * usual, output_type="ndarray").reshape(-1, 2)]]
    near = tree.query_ball_point(centre[large], radius[large] + usual)
    found += [np.stack([np.full(len(n), i), small[n]], 1) for i, n in zip(large, near) if n]
    if len(large):
        mates = cKDTree(centre[large]).query_pairs(2 * float(radius[large].max()), output_type="ndarray")
        found.append(large[mates.reshape(-1, 2)])
    pairs = np.concatenate(found)
    overlap = ((low[pairs[:, 0]] <= high[pairs[:, 1]]) & (low[pairs[:, 1]] <= high[pairs[:, 0]])).all(1)
    return pairs[overlap]


def _numpy(values):
    return values.detach().cpu().numpy() if hasattr(values, "detach") else values
