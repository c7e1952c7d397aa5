"""The body beside cloth: for each vertex of a garment the plane of the body's surface that it should stay above.

Nearest vertices of the body are found by walking over its surface, from the one that was nearest at rest (so that cloth
stays with the part that it rides on) and from the nearest of a few landmarks (so that other parts that came near are
found, too): twenty times as fast as a search tree, which would have to be built for each pose.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from recon.cloth.edges import Planes

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

LANDMARKS = 64
"""Vertices of the body, spread evenly, from the nearest of which a walk starts."""
STRANGE = 0.03
"""A part that cloth does not ride on counts up to this distance [m]."""


class Surface:
    """A closed body's surface at rest, in any pose to walk on."""

    def __init__(self, vertices: Tensor, faces: Tensor):
        """``vertices`` (N, 3) at rest [m], ``faces`` (F, 3) seen from outside."""
        self.device = str(vertices.device)
        rest = vertices.detach().cpu().double().numpy()
        self._tree = cKDTree(rest)
        rings = rings_of(faces.cpu().numpy(), len(rest))
        self._rings = wp.array(rings, dtype=wp.vec2i, device=self.device)
        self._marks = wp.array(spread(rest, LANDMARKS).astype(np.int32), dtype=int, device=self.device)

    def nearest_at_rest(self, x: Tensor) -> Tensor:
        """(V,) int32: where walks of a garment's vertices (V, 3) at rest start."""
        found = self._tree.query(x.detach().cpu().double().numpy())[1]
        return torch.as_tensor(found.astype(np.int32), device=x.device)

    def beside(self, body: Tensor, start: Tensor) -> Beside:
        """Planes for a garment whose walks start at ``start`` (V,), on bodies (B, N, 3).

        Raises:
            ValueError: bodies of another topology.
        """
        if body.dim() != 3 or body.shape[1] != len(self._rings):
            raise ValueError(f"body: found vertices {tuple(body.shape)}; wanted (B, {len(self._rings)}, 3)")
        return Beside(self, body, start)

    def _walk(self, body: Tensor, x: Tensor, near: Tensor, normal: Tensor, first: bool) -> None:
        views: list[Any] = [wp.from_torch(t, dtype=wp.vec3) for t in (body, x, normal)]
        given = [self._rings, self._marks, *views, wp.from_torch(near), int(first)]
        wp.launch(_walk, near.numel(), inputs=given, device=self.device)


class Beside:
    """Says planes (``recon.cloth.edges.Planes``) whenever it is asked; walks go on from where the last ones ended."""

    def __init__(self, surface: Surface, body: Tensor, start: Tensor):
        self.surface, self.body = surface, body
        self.near = start.repeat(len(body), 1)
        self.seen = body.detach().float().contiguous()
        self.first = True

    def __call__(self, x: Tensor) -> Planes:
        """(B, V, 3) [m] -> points, differentiable in the body's vertices, and normals, which are not.

        Raises:
            ValueError: not as many garments as bodies.
        """
        if x.shape[:2] != self.near.shape:
            raise ValueError(f"garment: found vertices {tuple(x.shape)}; wanted {(*self.near.shape, 3)}")
        x = x.contiguous()
        normal = torch.empty_like(x)
        self.surface._walk(self.seen, x, self.near, normal, self.first)
        self.first = False
        which = self.near.long()[..., None].expand(-1, -1, 3)
        return self.body.float().gather(1, which), normal


def rings_of(faces: NDArray, count: int) -> NDArray:
    """(count, R, 2) int32: for each vertex the other corners of its faces, in their order; -1 where there are less."""
    corner = np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    corner = corner[np.argsort(corner[:, 0], kind="stable")]
    degree = np.bincount(corner[:, 0], minlength=count)
    place = np.arange(len(corner)) - np.repeat(np.cumsum(degree) - degree, degree)
    rings = np.full((count, int(degree.max()), 2), -1, np.int32)
    rings[corner[:, 0], place] = corner[:, 1:]
    return rings


def spread(points: NDArray, count: int) -> NDArray:
    """``count`` of the points (N, 3), each the farthest from those before it."""
    chosen = [0]
    far = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


@wp.func
def _descend(rings: wp.array2d(dtype=wp.vec2i), body: wp.array2d(dtype=wp.vec3), b: int, start: int, p: wp.vec3) -> int:
    here = int(start)
    best = float(wp.length_sq(body[b, start] - p))
    last = int(-1)  # noqa: UP018 - the same
    while here != last:
        last = int(here)
        for k in range(rings.shape[1]):
            j = rings[last, k][0]
            if j < 0:
                break
            far = wp.length_sq(body[b, j] - p)
            if far < best:
                best = far
                here = j
    return here


@wp.kernel
def _walk(
    rings: wp.array2d(dtype=wp.vec2i),
    marks: wp.array(dtype=int),
    body: wp.array2d(dtype=wp.vec3),
    x: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    near: wp.array2d(dtype=int),
    first: int,
):
    t = wp.tid()
    b = t // near.shape[1]
    i = t - b * near.shape[1]
    p = x[b, i]
    at = _descend(rings, body, b, near[b, i], p)
    if first > 0:
        mark = int(0)  # noqa: UP018 - Warp's way to say that it changes
        best = float(1.0e9)  # noqa: UP018 - the same
        for k in range(marks.shape[0]):
            far = wp.length_sq(body[b, marks[k]] - p)
            if far < best:
                best = far
                mark = marks[k]
        other = _descend(rings, body, b, mark, p)
        far = wp.length_sq(body[b, other] - p)
        if far < wp.length_sq(body[b, at] - p) and far < STRANGE * STRANGE:
            at = other
    near[b, i] = at
    out = wp.vec3(0.0, 0.0, 0.0)
    for k in range(rings.shape[1]):
        c = rings[at, k]
        if c[0] < 0:
            break
        out += wp.cross(body[b, c[0]] - body[b, at], body[b, c[1]] - body[b, at])
    normal[b, i] = wp.normalize(out)
