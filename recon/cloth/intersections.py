"""Where edges pass through faces: the exact test behind self-intersections and untangling, compiled.

A box hierarchy (Warp) proposes, signs of tetrahedron volumes in doubles decide: no division, so no tolerance, but for
edges in the plane of a face up to rounding, where signs say nothing: these don't count. Edges that share a vertex with
a face are not tested against it.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

DEVICE = "cpu"
GROW = 1.0e-6
"""Boxes are grown by this share of their coordinates: they are single precision, the test is not."""
ROUNDING = wp.constant(wp.float64(1e-12))
"""A point this much nearer to a face's plane than the face is long lies in it."""


@wp.func
def _volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    return wp.dot(wp.cross(b - a, c - a), d - a)


@wp.func
def _through(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    zero = wp.float64(0.0)
    above = _volume(a, b, c, p)
    below = _volume(a, b, c, q)
    if (above > zero and below > zero) or (above < zero and below < zero):
        return False
    plane = ROUNDING * wp.length(b - a) * wp.length(c - a)
    if wp.abs(above) <= plane * wp.length(p - a) and wp.abs(below) <= plane * wp.length(q - a):
        return False
    u = _volume(p, q, a, b)
    v = _volume(p, q, b, c)
    w = _volume(p, q, c, a)
    return (u >= zero and v >= zero and w >= zero) or (u <= zero and v <= zero and w <= zero)


@wp.kernel
def _find(
    mesh: wp.uint64,
    x: wp.array(dtype=wp.vec3d),
    which: wp.array(dtype=int),
    edges: wp.array(dtype=wp.vec2i),
    faces: wp.array(dtype=wp.vec3i),
    pad: float,
    found: wp.array(dtype=wp.vec2i),
    count: wp.array(dtype=int),
):
    i = which[wp.tid()]
    e = edges[i]
    p = x[e[0]]
    q = x[e[1]]
    a = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    b = wp.vec3(float(q[0]), float(q[1]), float(q[2]))
    grow = wp.vec3(pad, pad, pad)
    query = wp.mesh_query_aabb(mesh, wp.min(a, b) - grow, wp.max(a, b) + grow)
    k = int(0)  # noqa: UP018 (a literal would be a constant of the kernel)
    while wp.mesh_query_aabb_next(query, k):
        f = faces[k]
        apart = f[0] != e[0] and f[1] != e[0] and f[2] != e[0] and f[0] != e[1] and f[1] != e[1] and f[2] != e[1]
        if apart and _through(p, q, x[f[0]], x[f[1]], x[f[2]]):
            at = wp.atomic_add(count, 0, 1)
            if at < found.shape[0]:
                found[at] = wp.vec2i(i, k)


class Crossings:
    """Finds the crossings of one mesh (of several pieces, if you like) with itself, wherever its vertices move."""

    def __init__(self, faces: NDArray, vertices: int):
        """``faces`` (F, 3); ``vertices``: how many there are."""
        self.faces = np.ascontiguousarray(faces, np.int32)
        ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        self.edges, which = np.unique(ends, axis=0, return_inverse=True)
        self.faces_of_edge = faces_of_edges(which.reshape(-1), len(self.edges), len(faces))
        """(E, 2) the faces that meet at each edge, -1 where there is none; of more than two, the first and the last."""
        self.rim = self.edges[self.faces_of_edge[:, 1] < 0]
        """(R, 2) the edges of one face: open borders."""
        points = wp.zeros(vertices, dtype=wp.vec3, device=DEVICE)
        self.mesh = wp.Mesh(points, wp.array(self.faces.ravel(), dtype=int, device=DEVICE))
        self._x = wp.zeros(vertices, dtype=wp.vec3d, device=DEVICE)
        self._edges = wp.array(self.edges.astype(np.int32), dtype=wp.vec2i, device=DEVICE)
        self._faces = wp.array(self.faces, dtype=wp.vec3i, device=DEVICE)
        self._found = wp.zeros(4096, dtype=wp.vec2i, device=DEVICE)
        self._which = wp.array(np.arange(len(self.edges), dtype=np.int32), dtype=int, device=DEVICE)
        self._built = False

    def __call__(self, x: NDArray, moved: NDArray | None = None) -> NDArray:
        """(K, 2) rows of ``edges`` and of ``faces`` that pass through each other at ``x`` (V, 3), sorted.

        ``moved`` (V,): what does not touch any of these vertices is known not to cross, and most of it is not asked.
        """
        self._x.numpy()[:] = x
        self.mesh.points.numpy()[:] = x
        if self._built:
            self.mesh.refit()
        else:  # a hierarchy made of points that were all alike would be useless for good
            self.mesh = wp.Mesh(self.mesh.points, self.mesh.indices)
            self._built = True
        pad = float(GROW * max(np.abs(x).max(), 1.0)) if len(x) else 0.0
        which = self._which if moved is None else self._near(x, moved)
        while True:
            count = wp.zeros(1, dtype=int, device=DEVICE)
            inputs = [self.mesh.id, self._x, which, self._edges, self._faces, pad, self._found, count]
            wp.launch(_find, len(which), inputs=inputs, device=DEVICE)
            total = int(count.numpy()[0])
            if total <= len(self._found):
                found = self._found.numpy()[:total].astype(np.int64)
                return found[np.lexsort((found[:, 1], found[:, 0]))]
            self._found = wp.zeros(2 * total, dtype=wp.vec2i, device=DEVICE)

    def _near(self, x: NDArray, moved: NDArray) -> wp.array:
        """Rows of the edges in cells of a grid beside those where faces with ``moved`` (V,) vertices are."""
        touched = np.unique(self.faces[moved[self.faces].any(1)])
        if not len(touched):
            return wp.zeros(0, dtype=int, device=DEVICE)
        ends = x[self.edges]
        size = 1.01 * np.abs(ends[:, 0] - ends[:, 1]).max()  # no edge or face reaches beyond the next cell
        low = x[touched].min(0) - 1.5 * size
        cell = np.floor((x - low) / size).astype(np.int64)
        count = cell[touched].max(0) + 2
        grid = np.zeros(count, bool)
        grid[tuple(cell[touched].T)] = True
        grid = binary_dilation(grid, np.ones((3, 3, 3), bool))
        close = ((cell >= 0) & (cell < count)).all(1)
        close[close] = grid[tuple(cell[close].T)]
        rows = np.flatnonzero(close[self.edges].any(1))
        return wp.array(rows.astype(np.int32), dtype=int, device=DEVICE)

    def pairs(self, crossings: NDArray) -> NDArray:
        """(P, 2) pairs of faces that pass through each other, each once, sorted, of what a call returned."""
        both = self.faces_of_edge[crossings[:, 0]]
        pairs = np.concatenate([np.column_stack([both[:, k], crossings[:, 1]]) for k in (0, 1)])
        pairs = np.sort(pairs[pairs[:, 0] >= 0], 1)
        return np.unique(pairs, axis=0)


def self_intersections(vertices, faces) -> NDArray:
    """(K, 2) pairs of faces that pass through each other, each pair once, sorted.

    Triangles that share an edge can only overlap by folding flat onto each other, which has no volume and is not
    counted. ``vertices`` (V, 3) and ``faces`` (F, 3): arrays or tensors.
    """
    x, f = (v.detach().cpu().numpy() if hasattr(v, "detach") else np.asarray(v) for v in (vertices, faces))
    found = Crossings(f, len(x))
    return found.pairs(found(x.astype(np.float64)))


def faces_of_edges(which: NDArray, edges: int, faces: int) -> NDArray:
    """(E, 2) faces at each edge; ``which`` (3 F) is the edge of each face's sides, all first sides first."""
    out = np.full((edges, 2), -1, np.int64)
    face = np.tile(np.arange(faces), 3)
    out[which[::-1], 0] = face[::-1]
    out[which, 1] = face
    out[out[:, 0] == out[:, 1], 1] = -1
    return out
