"""Small moves that draw crossing cloth apart: back to its own side between layers, out of itself within one.

A repair moves a point of one piece of cloth against a point of another; how much of it each takes is said by how far
either yields.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon.cloth.contact import BodyContact
from recon.cloth.escape import scatter, vertex_normals
from recon.cloth.intersections import Crossings

NEAR = 0.06
"""Vertices further than this from all crossings are not asked for their side [m]."""
CLOSE = 0.03
"""Cloth this close to a layer has outgrown it whatever part of the body it is worn on [m]."""
SAME_WAY = 0.3
"""A vertex is above a layer that it belongs under only if their normals agree by this cosine: sleeves hang beside."""


class Repairs:
    """Moves vertices ``x`` (V, 3) of stacked layers, outermost first, in place."""

    def __init__(
        self, crossings: Crossings, starts: NDArray, gap: float, scale: float, body: BodyContact | None = None
    ):
        """
        Args:
            crossings: of all layers as one mesh.
            starts: (L + 1,) first vertex of each layer, and their number.
            gap: distance that layers are drawn apart [m].
            scale: mean length of the edges [m].
            body: what the layers are worn on.
        """
        self.body = body
        self.crossings, self.starts, self.gap, self.scale = crossings, starts, gap, scale
        self.edges, self.faces = crossings.edges, crossings.faces
        self.layer = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        self.rims = np.zeros(len(self.layer), bool)
        self.rims[crossings.rim] = True
        self.tucked = False
        """Whether cloth goes under other layers wherever the body does that it is worn on."""
        self.yields = np.ones(len(self.layer))
        """(V,) how easily vertices give way, compared with each other."""

    def own_side(self, x: NDArray, found: NDArray, reach: float) -> NDArray[np.bool_]:
        """Vertices near crossings ``found`` (K, 2), on the wrong side of another layer and not further than ``reach``
        [m] from it, go back over or under it; (V,) which vertices moved."""
        moved, near = np.zeros(len(x), bool), self.around(x, found, NEAR)
        here = np.unique(self.layer[near])
        normals = vertex_normals(x, self.faces)
        of_face = self.layer[self.faces[:, 0]]
        for j in here if len(here) > 1 else ():
            surface = BodyContact(torch.from_numpy(x), torch.from_numpy(self.faces[of_face == j]).long())
            for k in here[here != j]:
                mine = np.flatnonzero(near & (self.layer == k))
                moved |= self._past(x, mine, surface, 1.0 if k < j else -1.0, normals, reach)
        return moved

    def outgrown(self, x: NDArray, found: NDArray, reach: float) -> NDArray[np.bool_]:
        """(V,) cloth that stands beyond layers over it, no further than ``reach`` [m], where those are worn.

        Cloth too wide for what is over it comes out along open curves, which cut nothing off. ``found`` (K, 2): only
        what hangs together with these crossings counts.
        """
        out, of_face = np.zeros(len(x), bool), self.layer[self.faces[:, 0]]
        crossing = np.sort(np.column_stack([self.layer[self.edges[found[:, 0], 0]], of_face[found[:, 1]]]), 1)
        for j, k in np.unique(crossing[crossing[:, 0] < crossing[:, 1]], axis=0):
            surface = BodyContact(torch.from_numpy(x), torch.from_numpy(self.faces[of_face == j]).long())
            mine = np.flatnonzero(self.layer == k)
            away, sign, beside, _, _ = self._beside(x, mine, surface)
            beyond = np.zeros(len(x), bool)
            beyond[mine] = (sign > 0) & ~beside & (np.linalg.norm(away, axis=1) < reach)
            far = mine[beyond[mine] & (np.linalg.norm(away, axis=1) > CLOSE)]
            beyond[far] = self._worn_under(x[far], surface)
            here = (crossing == (j, k)).all(1)
            start = np.zeros(len(x), bool)
            start[self.edges[found[here, 0]]] = True
            start[self.faces[found[here, 1]]] = True
            out |= self._hanging_on(beyond, start & (self.layer == k))
        return out

    def _hanging_on(self, mask: NDArray[np.bool_], start: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(V,) the pieces of ``mask`` (V,) that touch ``start`` (V,), and two rings around them."""
        inside = self.edges[mask[self.edges].all(1)]
        links = sp.coo_matrix((np.ones(len(inside), np.int8), (inside[:, 0], inside[:, 1])), shape=(len(mask),) * 2)
        piece = connected_components(links, directed=False)[1]
        near = start.copy()
        near[self.edges[start[self.edges].any(1)]] = True
        out = mask & np.isin(piece, piece[mask & near])
        for _ in range(2):
            out[self.edges[out[self.edges].any(1)]] = True
        return out

    def around(self, x: NDArray, found: NDArray, radius: float) -> NDArray[np.bool_]:
        """(V,) which vertices are within ``radius`` [m] of crossings."""
        at = np.concatenate([x[self.edges[found[:, 0]]].mean(1), x[self.faces[found[:, 1]]].mean(1)])
        far, _ = cKDTree(at).query(x, distance_upper_bound=radius)
        return np.isfinite(far)

    def _past(
        self, x: NDArray, mine: NDArray, surface: BodyContact, side: float, normals: NDArray, reach: float
    ) -> NDArray[np.bool_]:
        """Vertices ``mine`` go to that side of a layer's surface (1: outside) where they are on the other."""
        away, sign, beside, corners, weights = self._beside(x, mine, surface)
        distance = np.linalg.norm(away, axis=1)
        wrong = (sign * side < 0) & (distance < reach) & (distance > 1e-9) & ~beside
        if side < 0:
            other = wrong & ((normals[mine] * normals[corners].mean(1)).sum(1) <= SAME_WAY)
            wrong[other] = self._worn_under(x[mine[other]], surface)
        at = np.flatnonzero(wrong)
        push = -away[at] * (1 + self.gap / distance[at])[:, None]
        on = np.ones((len(at), 1))
        return self._part(x, mine[at, None], corners[at], on, weights[at], push)

    def _beside(self, x: NDArray, mine: NDArray, surface: BodyContact) -> tuple[NDArray, ...]:
        """For vertices ``mine`` (K,): the way from the closest point of a layer's surface (K, 3), the side, whether
        that point is on an open border, where there are no sides, and its corners and weights (K, 3)."""
        face, weights, sign = (t.numpy() for t in surface.closest(torch.from_numpy(x[mine])))
        corners = surface.faces.numpy()[face]
        away = x[mine] - (x[corners] * weights[..., None]).sum(1)
        return away, sign, (self.rims[corners] | (weights < 1e-3)).all(1), corners, weights

    def _worn_under(self, points: NDArray, surface: BodyContact) -> NDArray[np.bool_]:
        """(K,) whether the body nearest to ``points`` (K, 3) lies under a layer: so must what is worn there.

        The side of a wide shirt stands off a narrow dress over it by more than its normals tell; a sleeve beside the
        dress goes around an arm that is outside.
        """
        if self.body is None or not self.tucked:
            return np.zeros(len(points), bool)
        on, at, _ = self.body.closest(torch.from_numpy(points))
        skin = (self.body.vertices[self.body.faces[on]] * at[..., None]).sum(1)
        face, weights, sign = (t.numpy() for t in surface.closest(skin))
        beside = (self.rims[surface.faces.numpy()[face]] | (weights < 1e-3)).all(1)
        return (sign < 0) & ~beside

    def _part(
        self, x: NDArray, ours: NDArray, theirs: NDArray, on: NDArray, at: NDArray, move: NDArray
    ) -> NDArray[np.bool_]:
        """Points on cloth move against each other by ``move`` (K, 3); (V,) which vertices moved.

        ``ours`` (K, n) and ``theirs`` (K, m) are the vertices around them, ``on`` and ``at`` their weights.
        """
        mine, other = (self.yields[ours] * on).sum(1), (self.yields[theirs] * at).sum(1)
        give = (mine / np.maximum(mine + other, 1e-12))[:, None, None]
        vertices = np.concatenate([ours.ravel(), theirs.ravel()])
        moves = [give * _share(on)[..., None] * move[:, None], (give - 1) * _share(at)[..., None] * move[:, None]]
        scatter(x, vertices, np.concatenate([m.reshape(-1, 3) for m in moves]))
        moved = np.zeros(len(x), bool)
        moved[vertices] = True
        return moved

    def apart(self, x: NDArray, found: NDArray, curve: float, number: int, ordered: bool = True) -> NDArray[np.bool_]:
        """One step for each crossing of ``found`` (K, 2); (V,) which vertices moved.

        ``curve``: longest step against a curve of self-intersection, in mean edge lengths; ``number``: of the round.
        ``ordered``: layers move by their order; else they too make their curves shorter, and may end beside a border.
        """
        edge, face = self.edges[found[:, 0]], self.faces[found[:, 1]]
        p, q = x[edge[:, 0]], x[edge[:, 1]]
        a, b, c = (x[face[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
        over, under = ((p - a) * normal).sum(1), ((q - a) * normal).sum(1)
        t = np.clip(over / np.where(np.abs(over - under) < 1e-15, 1.0, over - under), 0, 1)
        at = p + t[:, None] * (q - p)
        between = (self.layer[edge[:, 0]] != self.layer[face[:, 0]]) & ordered
        own = self._shorter_curve(x, found, normal, at)
        size = np.linalg.norm(own, axis=1, keepdims=True)
        # A little of chance from round to round: equal and opposite steps would stand still for ever.
        jitter = 1 + 0.5 * np.sin(1.7 * number + np.arange(len(p)))[:, None]
        own *= curve * self.scale * jitter * np.minimum(size, 1.0) / np.maximum(size, 1e-9)
        move = np.where(between[:, None], self._by_order(edge, face, over, under, normal), own)
        return self._part(x, edge, face, np.column_stack([1 - t, t]), _barycentric(at, a, b, c), move)

    def _by_order(self, edge: NDArray, face: NDArray, over: NDArray, under: NDArray, normal: NDArray) -> NDArray:
        """(K, 3) how the edge moves against the face so that the outer layer ends outside."""
        outward = self.layer[edge[:, 0]] < self.layer[face[:, 0]]  # the edge belongs to the outer layer
        # How far the edge reaches to its wrong side of the face.
        depth = np.where(outward, -np.minimum(over, under), np.maximum(over, under))
        depth = np.clip(depth, 0, 0.5 * self.scale) + self.gap
        return np.where(outward, depth, -depth)[:, None] * normal

    def _shorter_curve(self, x: NDArray, found: NDArray, normal: NDArray, at: NDArray) -> NDArray:
        """(K, 3) direction in which the edge, moving against the face, makes the intersection curve shorter."""
        edge = self.edges[found[:, 0]]
        along = x[edge[:, 1]] - x[edge[:, 0]]
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-15)
        slope = (along * normal).sum(1)
        slope = np.where(np.abs(slope) < 0.05, np.where(slope < 0, -0.05, 0.05), slope)
        total = np.zeros_like(at)
        for side in (0, 1):
            mine = self.crossings.faces_of_edge[found[:, 0], side]
            there = mine >= 0
            corners = x[self.faces[mine]]
            own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            line = np.cross(own, normal)
            line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-15)
            inward = (corners.mean(1) - at) - ((corners.mean(1) - at) * along).sum(1)[:, None] * along
            line *= np.where((line * inward).sum(1) < 0, -1.0, 1.0)[:, None]
            step = line - (((along * line).sum(1) * 2.0 / slope)[:, None]) * normal
            total += np.where(there[:, None], step, 0.0)
        return total


def _barycentric(at: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    """(K, 3) weights of points in triangles."""
    u, v, w = b - a, c - a, at - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    det = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    return np.clip(np.column_stack([1 - s - t, s, t]), 0, 1)


def _share(weights: NDArray) -> NDArray:
    """How much each corner moves so that the weighted point moves by one."""
    return weights / np.maximum((weights**2).sum(1, keepdims=True), 1e-9)
