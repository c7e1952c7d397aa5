"""Distance to a body, with gradients: Warp finds the closest triangle, torch recomputes the point on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.init()

REACH = 2.0
"""Closest points are searched for within this distance: more than any body's depth [m]."""

ON = 1e-7
"""Points nearer to a surface than this have no side [m]."""


@wp.kernel
def _closest(
    mesh: wp.uint64,
    reach: float,
    points: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
    sign: wp.array(dtype=float),
):
    i = wp.tid()
    hit = wp.mesh_query_point_sign_normal(mesh, points[i], reach)
    face[i] = hit.face
    weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    sign[i] = hit.sign
    if not hit.result:
        face[i] = -1


@dataclass(frozen=True)
class Nearest:
    """Where a surface is closest to the points near it, in double precision."""

    rows: NDArray
    """(N,) which of the points asked for these are."""
    corners: NDArray
    """(N, 3) vertices of the closest face."""
    weights: NDArray
    """(N, 3) barycentric weights of the closest point."""
    point: NDArray
    """(N, 3) that point [m]."""
    outward: NDArray
    """(N, 3) unit vectors from it to the point asked for, or away from that where it is inside."""
    distance: NDArray
    """(N,) never negative [m]."""


class BodyContact:
    """Signed distances to one closed body mesh; a new one for each pose."""

    def __init__(self, vertices: Tensor, faces: Tensor):
        """``vertices`` (V, 3) [m], may require gradients; ``faces`` (F, 3), outward."""
        self.vertices, self.faces = vertices, faces
        self.device = str(vertices.device)
        points = wp.from_torch(vertices.detach().float().contiguous(), dtype=wp.vec3)
        indices = wp.array(faces.cpu().numpy().astype(np.int32).ravel(), dtype=int, device=self.device)
        self.mesh = wp.Mesh(points, indices)

    def closest(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Face (N,), barycentric weights (N, 3) and side (N,) (+1 outside) of the closest points; no gradients.

        Raises ``ValueError`` for points that are not finite or further than ``REACH`` away.
        """
        n = len(points)
        if not n:
            return torch.zeros(0, dtype=torch.long, device=points.device), points.new_zeros(0, 3), points.new_zeros(0)
        asked = wp.from_torch(points.detach().float().contiguous(), dtype=wp.vec3)
        face = wp.empty(n, dtype=int, device=self.device)
        weights = wp.empty(n, dtype=wp.vec3, device=self.device)
        sign = wp.empty(n, dtype=float, device=self.device)
        wp.launch(_closest, n, inputs=[self.mesh.id, REACH, asked, face, weights, sign], device=self.device)
        face = wp.to_torch(face).long()
        if (face < 0).any():
            raise ValueError(f"{int((face < 0).sum())} of {n} points are not within {REACH} m of the body")
        return face, wp.to_torch(weights).to(points.dtype), wp.to_torch(sign).to(points.dtype)

    def nearest(self, x: NDArray, reach: float) -> Nearest:
        """Where the surface (on the CPU) is closest to those of ``x`` (N, 3) nearer than ``reach`` [m], but not on it.

        The search is in single precision, an error of 10 nm: times a contact's stiffness that is as much as cloth
        weighs. So the point is computed again on the face that was found.
        """
        vertices = self.vertices.detach().numpy().astype(np.float64)
        rows = np.flatnonzero(((x > vertices.min(0) - reach) & (x < vertices.max(0) + reach)).all(1))
        face, _, sign = (t.numpy() for t in self.closest(torch.from_numpy(x[rows])))
        corners = self.faces.numpy()[face]
        weights = closest_weights(x[rows], vertices[corners])
        point = (vertices[corners] * weights[..., None]).sum(1)
        away = (x[rows] - point) * sign[:, None]
        distance = np.linalg.norm(away, axis=1)
        near = (distance < reach) & (distance > ON)
        outward = away[near] / distance[near, None]
        return Nearest(rows[near], corners[near], weights[near], point[near], outward, distance[near])

    def signed_distance(self, points: Tensor) -> Tensor:
        """(N,) distance [m], negative inside; differentiable in ``points`` (N, 3) and in the body's vertices."""
        face, weights, sign = self.closest(points)
        corners = self.vertices.to(points.dtype)[self.faces[face]]
        away = points - (corners * weights[..., None]).sum(1)
        square = (away * away).sum(-1)
        # On the surface the direction is undefined: there the face's normal carries the gradient.
        normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat = (away * normal).sum(-1) / normal.norm(dim=-1).clamp_min(1e-12)
        on = square < 1e-12
        return torch.where(on, flat, sign * torch.where(on, torch.ones_like(square), square).sqrt())

    def penetrating(self, points: Tensor) -> Tensor:
        """(N,) bool, which points are inside the body."""
        return self.closest(points)[2] < 0


def closest_weights(x: NDArray, triangles: NDArray) -> NDArray:
    """(N, 3) barycentric weights of the points of ``triangles`` (N, 3, 3) closest to ``x`` (N, 3)."""
    a, b, c = triangles.swapaxes(0, 1)
    u, v, w = b - a, c - a, x - a
    uu, uv, vv, wu, wv = ((p * q).sum(1) for p, q in ((u, u), (u, v), (v, v), (w, u), (w, v)))
    flat = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) / flat, (uu * wv - uv * wu) / flat
    found = np.column_stack([1 - s - t, s, t])
    beside = np.flatnonzero((found < 0).any(1))
    best = np.full(len(beside), np.inf)
    corners, at = triangles[beside], x[beside]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        way = corners[:, j] - corners[:, i]
        along = ((at - corners[:, i]) * way).sum(1) / np.maximum((way * way).sum(1), 1e-30)
        along = np.clip(along, 0, 1)
        far = ((at - corners[:, i] - along[:, None] * way) ** 2).sum(1)
        rows = far < best
        best[rows], found[beside[rows]] = far[rows], 0.0
        found[beside[rows], i], found[beside[rows], j] = 1 - along[rows], along[rows]
    return found
