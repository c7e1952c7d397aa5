"""Out of the body: cloth leaves it where its own outside is.

The nearest way out of the body is the right one for cloth that went in a little. Of a sleeve that lies half beyond its
arm it leads to the wrong side, and the sleeve would no longer go around the arm.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray

from recon.cloth.contact import BodyContact
from recon.types import Mesh

ASTRAY = -0.2
"""Cosine between cloth's outside and the body's nearest way out below which that way is the wrong one."""
STRIDE = 0.01
"""Longest move through the body towards the right side of it [m]."""
BEHIND = 20
"""So far behind cloth the body is searched for beginning anew [cm]."""
PAD = 2e-3
"""How wrong remembered distances may be: beside sharp creases signs are not sure [m]."""
SMOOTHING = 8
"""Times that normals are averaged with their neighbours'."""


class Escape:
    """Brings vertices and face centres of cloth out of a body."""

    def __init__(self, body: Mesh, x: NDArray, faces: NDArray, edges: NDArray):
        """``body``: faces outward; the cloth as it comes: ``x`` (V, 3), ``faces`` (F, 3), ``edges`` (E, 2)."""
        self.body = BodyContact(body.vertices.detach().cpu().double(), body.faces.cpu())
        self.faces = faces
        self.outward = outward_normals(x, faces, edges)
        self.asked: NDArray | None = None
        self.known = np.zeros(0)

    def lack(self, x: NDArray, fresh: bool = False) -> NDArray[np.bool_]:
        """(V + F,) which vertices and face centres of ``x`` (V, 3) are inside.

        ``fresh``: ask all, whatever is known: where a body overlaps itself sides change without its surface being met.
        """
        if fresh:
            self.asked = None
        lack = np.zeros(len(x) + len(self.faces), bool)
        near, distance, _ = self._close(x, 0.0)
        lack[near[distance < 0]] = True
        return lack

    def leave(
        self, x: NDArray, wanted: float, eager: float, times: int, beyond: NDArray | None = None
    ) -> NDArray[np.bool_]:
        """Move ``x`` (V, 3), in place, until nothing is closer than ``wanted`` [m]; (V,) which vertices moved.

        ``eager``: factor on the steps; ``times``: most of them. What is inside goes further by ``beyond`` (V,) [m].
        """
        moved, n = np.zeros(len(x), bool), len(x)
        further = None if beyond is None else np.concatenate([beyond, beyond[self.faces[:, 0]]])
        for _ in range(times):
            near, distance, normal = self._close(x, wanted)
            lack = np.maximum(wanted - distance, 0) * eager
            if further is not None:
                lack += np.where(distance < 0, further[near], 0.0)
            if not lack.any():
                break
            astray = self._astray(x, near, distance, normal)[:, None]
            move = np.where(astray, np.minimum(lack, STRIDE)[:, None] * self.outward[near], lack[:, None] * normal)
            own = (near < n) & (lack > 0)
            x[near[own]] += move[own]
            by_face = (near >= n) & (lack > 0)
            corners = self.faces[near[by_face] - n].ravel()
            scatter(x, corners, np.repeat(move[by_face], 3, 0))
            moved[near[own]] = True
            moved[corners] = True
        return moved

    def _close(self, x: NDArray, wanted: float) -> tuple[NDArray, NDArray, NDArray]:
        """Of vertices and face centres, those that may be closer to the body than ``wanted`` [m].

        Their rows (K,), signed distances (K,) and the directions away from the body (K, 3). A point that was far away
        when it was last asked, and has not moved as far since, is not asked again.
        """
        points = np.concatenate([x, x[self.faces].mean(1)])
        if self.asked is None:
            near = np.arange(len(points))
            self.asked, self.known = points.copy(), np.zeros(len(points))
        else:
            near = np.flatnonzero(self.known - np.linalg.norm(points - self.asked, axis=1) < wanted + PAD)
        at = torch.from_numpy(points[near]).requires_grad_()
        distance = self.body.signed_distance(at)
        (normal,) = torch.autograd.grad(distance.sum(), at)
        found = distance.detach().numpy()
        self.asked[near], self.known[near] = points[near], found
        return near, found, normal.numpy()

    def _astray(self, x: NDArray, near: NDArray, distance: NDArray, normal: NDArray) -> NDArray[np.bool_]:
        """(K,) points whose nearest way out leads to the wrong side.

        Not so where behind that way out the body begins anew: that is cloth of the trunk in an arm, which goes back.
        """
        outward = self.outward[near]
        astray = (distance < 0) & ((normal * outward).sum(1) < ASTRAY)
        rows = np.flatnonzero(astray)
        if len(rows):
            points = np.concatenate([x, x[self.faces].mean(1)])[near[rows]]
            way = np.arange(1, BEHIND + 1)[:, None] * 0.01
            behind = points[:, None] - way * outward[rows, None]
            inside = self.body.penetrating(torch.from_numpy(behind.reshape(-1, 3))).numpy().reshape(len(rows), -1)
            out = np.logical_or.accumulate(~inside, 1)
            astray[rows[(out & inside).any(1)]] = False
        return astray


def outward_normals(x: NDArray, faces: NDArray, edges: NDArray) -> NDArray:
    """(V + F, 3) where outside is, at vertices and face centres, smoothed over folds."""
    normal = area_normals(x, faces)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    around = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(len(x), len(x))).tocsr()
    for _ in range(SMOOTHING):
        normal += around @ normal
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
    middle = normal[faces].mean(1)
    return np.concatenate([normal, middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-15)])


def vertex_normals(x: NDArray, faces: NDArray) -> NDArray:
    """(V, 3) unit normals, weighted by area."""
    normal = area_normals(x, faces)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def area_normals(x: NDArray, faces: NDArray) -> NDArray:
    """(V, 3) sums of the normals of the faces at each vertex, as long as twice their areas [m2]."""
    a, b, c = (x[faces[:, k]] for k in range(3))
    cross, normal = np.cross(b - a, c - a), np.zeros_like(x)
    for k in range(3):
        np.add.at(normal, faces[:, k], cross)
    return normal


def scatter(x: NDArray, vertices: NDArray, moves: NDArray) -> None:
    """Add to ``x`` (V, 3), in place, the mean of the ``moves`` (K, 3) asked for at each of ``vertices`` (K,)."""
    total, count = np.zeros_like(x), np.bincount(vertices, minlength=len(x))
    np.add.at(total, vertices, moves)
    x += total / np.maximum(count, 1)[:, None]
