"""Cut flat panels out of a regular grid along the zero level of a signed distance (ISP §3.1 and B.2).

The paper keeps the outer ends of crossed grid edges and projects them onto the border; that leaves slivers. Here grid
vertices near the border are snapped onto it first and the remaining crossed edges are cut, so that every triangle keeps
a decent shape. Everything here is topology, in numpy and without gradients; units are those of the domain [-1, 1]².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, depth_first_order

from recon.types import Garment

SNAP = 0.25
"""Grid vertices closer to the border than this share of a cell's edge move onto it."""

KEPT = 0.3
"""So much of its area a triangle keeps where corners are made sharp and borders projected at last: slivers tear in
every drape."""

TRIANGLE_NEIGHBOURS = np.array([[1, 1, 0], [1, 1, 1], [0, 1, 1]], bool)
"""Grid neighbours that share a triangle edge when every cell is split along its (0,0)-(1,1) diagonal."""


@dataclass(frozen=True)
class Panel:
    """One flat triangulated panel; faces counter-clockwise in the plane."""

    points: NDArray[np.float64]
    """(P, 2) domain coordinates."""
    faces: NDArray[np.int64]
    """(F, 3)."""
    loops: list[NDArray[np.int64]]
    """Border loops as vertex indices, the panel on their left; the last joins the first."""

    @property
    def border(self) -> NDArray[np.int64]:
        """All border vertices, loop after loop."""
        return np.concatenate(self.loops) if self.loops else np.zeros(0, np.int64)


def corners(mask: NDArray[np.bool_]) -> NDArray[np.int8]:
    """(F, 3) -> (F,) how many of each face's corners hold; several times as fast as a sum along so short an axis."""
    count = mask.view(np.int8)
    return count[:, 0] + count[:, 1] + count[:, 2]


def grid_axis(resolution: int) -> NDArray[np.float64]:
    """The grid's coordinates along one axis of the domain: ``resolution`` cells."""
    return np.linspace(-1.0, 1.0, resolution + 1)


def clean_signs(distance: NDArray, cell: float) -> NDArray[np.int8]:
    """Signs (-1 inside, 0 on the border, 1 outside) of a distance grid, without specks.

    Islands below 2 % of the largest piece vanish, holes below (0.08)² of the domain close: neither occurs in a pattern.
    """
    sign = np.sign(distance).astype(np.int8)
    sign[np.abs(distance) < SNAP * cell] = 0
    for edge in (sign[0], sign[-1], sign[:, 0], sign[:, -1]):
        edge[:] = 1  # nothing reaches the frame of the domain
    pieces, count = ndimage.label(sign < 0, TRIANGLE_NEIGHBOURS)
    if count > 1:
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        sign[(sizes < max(4, 0.02 * sizes.max()))[pieces] & (pieces > 0)] = 1
    holes, count = ndimage.label(sign >= 0, TRIANGLE_NEIGHBOURS)
    if count > 1:
        sizes = np.bincount(holes.ravel())
        small = sizes < (0.08 / cell) ** 2
        small[[0, holes[0, 0]]] = False
        sign[small[holes]] = -1
    return sign


def cut_panel(distance: NDArray) -> Panel:
    """Triangulate the region ``distance <= 0`` of an (R+1, R+1) grid over the domain, x along the first axis.

    Cut vertices lie on the linear zero crossings of grid edges; snapped ones still on the grid. Project both next.
    """
    n = distance.shape[0]
    axis = grid_axis(n - 1)
    cell = axis[1] - axis[0]
    sign = clean_signs(distance, cell)
    inside = (sign < 0).view(np.int8)
    count = inside[:-1, :-1] + inside[1:, :-1] + inside[1:, 1:] + inside[:-1, 1:]
    faces, cuts = cut_triangles(_halves((count > 0) & (count < 4)), sign.ravel(), n * n)
    faces = np.concatenate([_halves(count == 4), faces])
    points, faces, rim = _place(faces, cuts, distance.ravel(), sign.ravel())
    faces, points = split_pinches(faces, points, rim)
    return Panel(points, faces, border_loops(faces, np.append(rim, np.ones(len(points) - len(rim), bool))))


def _halves(cells: NDArray[np.bool_]) -> NDArray:
    """The two triangles of each of the cells (n - 1, n - 1)."""
    n = len(cells) + 1
    i, j = np.nonzero(cells)
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _rotate(triangles: NDArray, first: NDArray) -> NDArray:
    """Triangles turned so that their corner ``first`` comes first."""
    return np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, 1)


def cut_triangles(triangles: NDArray, sign: NDArray, base: int) -> tuple[NDArray, NDArray]:
    """Faces of the kept parts; indices from ``base`` on point into the returned cut edges (K, 2) of grid vertices."""
    t = sign[triangles]
    kept = corners(t < 0) > 0
    triangles, t = triangles[kept], t[kept]
    positive = corners(t > 0)
    faces = [triangles[positive == 0]]
    edges: list[NDArray] = []

    def cut(inner: NDArray, outer: NDArray) -> NDArray:
        start = base + sum(len(e) for e in edges)
        edges.append(np.stack([inner, outer], 1))
        return np.arange(start, start + len(inner))

    one = _rotate(triangles[positive == 1], (t[positive == 1] > 0).argmax(1))  # outer corner first
    both = (sign[one[:, 1]] < 0) & (sign[one[:, 2]] < 0)
    quad = one[both]
    p, q = cut(quad[:, 1], quad[:, 0]), cut(quad[:, 2], quad[:, 0])
    faces += [np.stack([quad[:, 1], quad[:, 2], q], 1), np.stack([quad[:, 1], q, p], 1)]
    half = one[~both]
    left = sign[half[:, 1]] < 0  # the inner corner follows the outer one, else precedes it
    r = cut(np.where(left, half[:, 1], half[:, 2]), half[:, 0])
    faces.append(np.stack([half[:, 1], half[:, 2], r], 1))
    two = _rotate(triangles[positive == 2], (t[positive == 2] < 0).argmax(1))  # inner corner first
    faces.append(np.stack([two[:, 0], cut(two[:, 0], two[:, 1]), cut(two[:, 0], two[:, 2])], 1))
    return np.concatenate(faces), np.concatenate(edges)


def cut_at_signs(faces: NDArray, sign: NDArray) -> tuple[NDArray, NDArray]:
    """Faces of a mesh's part where ``sign`` (V,) is not positive, and its cut edges (K, 2), inner end first, each once.

    Indices from V on point into those edges; they may share ends.
    """
    count = len(sign)
    faces, cuts = cut_triangles(faces, sign, count)
    pairs, which = np.unique(cuts, axis=0, return_inverse=True)
    fresh = faces >= count
    faces[fresh] = count + which.ravel()[faces[fresh] - count]
    return faces, pairs


def _place(faces: NDArray, cuts: NDArray, distance: NDArray, sign: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Merge equal cut vertices, drop unused ones, give every vertex its place; last, who may lie on the border."""
    n = int(len(distance) ** 0.5)
    axis = grid_axis(n - 1)
    keys, which = np.unique(cuts[:, 0] * (n * n) + cuts[:, 1], return_inverse=True)
    inner, outer = keys // (n * n), keys % (n * n)
    old = faces.ravel()
    used = np.zeros(n * n + len(keys), bool)
    new = np.where(old < n * n, old, 0)
    is_cut = old >= n * n
    new[is_cut] = n * n + which[old[is_cut] - n * n]
    used[new] = True
    number = np.cumsum(used) - 1
    grid = np.nonzero(used[: n * n])[0]
    share = distance[inner] / (distance[inner] - distance[outer])
    start = np.stack([axis[inner // n], axis[inner % n]], 1)
    end = np.stack([axis[outer // n], axis[outer % n]], 1)
    crossing = start + np.clip(share, 0.15, 0.85)[:, None] * (end - start)
    points = np.concatenate([np.stack([axis[grid // n], axis[grid % n]], 1), crossing[used[n * n :]]])
    rim = np.append(sign[grid] == 0, np.ones(len(points) - len(grid), bool))
    return points, number[new].reshape(-1, 3), rim


def border_edges(faces: NDArray, rim: NDArray | None = None) -> NDArray:
    """(E, 2) directed edges that have one face only, the face on their left; ``rim`` (V,) says who may lie there."""
    size = int(faces.max()) + 1 if len(faces) else 1
    if rim is not None:
        faces = faces[corners(rim[faces]) >= 2]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    if rim is not None:
        edges = edges[rim[edges[:, 0]] & rim[edges[:, 1]]]
    keys = edges.min(1) * size + edges.max(1)
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    alone = np.ones(len(ranked), bool)
    alone[1:] &= ranked[1:] != ranked[:-1]
    alone[:-1] &= ranked[:-1] != ranked[1:]
    return edges[order[alone]]


def split_pinches(faces: NDArray, points: NDArray, rim: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Give every fan of faces around a border vertex its own copy, so that borders are simple loops."""
    edges = border_edges(faces, rim)
    starts, counts = np.unique(edges[:, 0], return_counts=True)
    faces = faces.copy()
    extra: list[NDArray] = []
    for vertex in starts[counts > 1]:
        around = np.nonzero(corners(faces == vertex))[0]
        fans = [{int(f)} for f in around]
        rims = [set(faces[f].tolist()) - {int(vertex)} for f in around]
        k = 0
        while k < len(fans):
            other = next((m for m in range(k + 1, len(fans)) if rims[k] & rims[m]), None)
            if other is None:
                k += 1
                continue
            fans[k] |= fans.pop(other)
            rims[k] |= rims.pop(other)
        for fan in fans[1:]:
            rows = faces[sorted(fan)]
            rows[rows == vertex] = len(points) + len(extra)
            faces[sorted(fan)] = rows
            extra.append(points[vertex])
    return faces, np.concatenate([points, np.array(extra)]) if extra else points


def border_loops(faces: NDArray, rim: NDArray | None = None) -> list[NDArray]:
    """Closed border loops of a mesh without pinched vertices, longest first; ``rim`` as in ``border_edges``."""
    edges = border_edges(faces, rim)
    names, ends = np.unique(edges, return_inverse=True)
    ends = ends.reshape(-1, 2)
    following = csr_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(len(names), len(names)))
    count, loop_of = connected_components(following, directed=False)
    starts = np.unique(loop_of, return_index=True)[1]
    walks = [depth_first_order(following, start, return_predecessors=False) for start in starts]
    return sorted((names[walk] for walk in walks), key=len, reverse=True)


def waistband(garment: Garment) -> NDArray:
    """(H,) vertices of the highest open border of a garment: the waistband of trousers and skirts."""
    loops = border_loops(garment.mesh.faces.cpu().numpy())
    heights = garment.mesh.vertices.detach().cpu().numpy()[:, 1]
    return max(loops, key=lambda loop: heights[loop].mean())


def signed_areas(points: NDArray, faces: NDArray) -> NDArray:
    """(F,) signed areas of flat triangles."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return 0.5 * cross(b - a, c - a)


def cross(u: NDArray, v: NDArray) -> NDArray:
    """(...,) out-of-plane component of the cross product of flat vectors (..., 2)."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def move_safely(points: NDArray, faces: NDArray, index: NDArray, target: NDArray, least: float = 0.2) -> NDArray:
    """Points with ``index`` moved to ``target``, less far (down to not at all) where a triangle would flip.

    ``least``: so much of its area every triangle keeps.
    """
    start = points[index]
    share = np.ones(len(index))
    row = np.full(len(points), -1)
    row[index] = np.arange(len(index))
    moving = row >= 0
    near = faces[corners(moving[faces]) > 0]
    areas = signed_areas(points, near)
    side, floor = np.sign(areas), least * np.abs(areas)
    moved = points.copy()
    for attempt in range(4):
        moved[index] = start + share[:, None] * (target - start)
        flipped = near[side * signed_areas(moved, near) < floor]
        rows = row[np.unique(flipped)]
        rows = rows[rows >= 0]
        if not len(rows):
            break
        share[rows] = 0.0 if attempt == 2 else 0.5 * share[rows]
    return moved
