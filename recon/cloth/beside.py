"""The body beside cloth: for each vertex of a garment the plane of the body's surface that it should stay above.

Nearest vertices of the body are found by walking over its surface, from the one that was nearest at rest (so that cloth
stays with the part that it rides on) and from the nearest of a few landmarks (so that other parts that came near are
found, too): the first time in a third of what a search tree takes, later in a tenth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from recon.cloth.edges import OFFSET, planes
from recon.cloth.threads import Launch

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
        self.count, self.width = rings.shape[:2]
        self._rings = wp.array(rings.reshape(-1, 2), dtype=wp.vec2i, device=self.device)
        self._marks = torch.as_tensor(spread(rest, LANDMARKS), device=vertices.device)

    def nearest_at_rest(self, x: Tensor) -> Tensor:
        """(V,) int32: where walks of a garment's vertices (V, 3) at rest start."""
        found = self._tree.query(x.detach().cpu().double().numpy())[1]
        return torch.as_tensor(found.astype(np.int32), device=x.device)

    def beside(self, body: Tensor, start: Tensor) -> Beside:
        """Planes for a garment whose walks start at ``start`` (V,), on bodies (B, N, 3).

        Raises:
            ValueError: bodies of another topology.
        """
        if body.dim() != 3 or body.shape[1] != self.count:
            raise ValueError(f"body: found vertices {tuple(body.shape)}; wanted (B, {self.count}, 3)")
        return Beside(self, body, start)

    def _walk(self, body: Tensor, x: Tensor, near: Tensor, found: Tensor, first: bool) -> None:
        others = self._nearest_marks(body, x) if first else near.new_zeros(0, 0)
        points = [wp.from_torch(t.view(-1, 3), dtype=wp.vec3) for t in (body, x)]
        numbers = [wp.from_torch(t.view(-1)) for t in (near, others)]
        above = wp.from_torch(found.view(-1, 4), dtype=wp.vec4)
        given: list[Any] = [self._rings, self.width, *points, above, *numbers, near.shape[1]]
        Launch(_walk, near.numel(), given, self.device)()

    def _nearest_marks(self, body: Tensor, x: Tensor) -> Tensor:
        """(B, V) int32, the nearest landmark of each point (B, V, 3); by products, whose roundings are millimetres."""
        marks = body[:, self._marks]
        apart = torch.baddbmm(marks.square().sum(-1)[:, None], x, marks.transpose(1, 2), alpha=-2)
        return self._marks[apart.argmin(-1)].int()


class Beside:
    """Says planes (``recon.cloth.edges.planes``) whenever it is asked; walks go on from where the last ones ended."""

    def __init__(self, surface: Surface, body: Tensor, start: Tensor):
        self.surface, self.body = surface, body
        self.near = start.repeat(len(body), 1)
        self.seen = body.detach().float().contiguous()
        self.first = True

    def __call__(self, x: Tensor) -> Tensor:
        """(B, V, 3) [m] -> planes (B, V, 4), their heights differentiable in the body's vertices.

        Raises:
            ValueError: not as many garments as bodies.
        """
        if x.shape[:2] != self.near.shape:
            raise ValueError(f"garment: found vertices {tuple(x.shape)}; wanted {(*self.near.shape, 3)}")
        found = x.new_empty(*x.shape[:2], 4)
        self.surface._walk(self.seen, x.contiguous(), self.near, found, self.first)
        self.first = False
        if not (torch.is_grad_enabled() and self.body.requires_grad):
            return found
        which = self.near.long()[..., None].expand(-1, -1, 3)
        return planes(self.body.float().gather(1, which), found[..., :3])


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
def _descend(
    rings: wp.array(dtype=wp.vec2i), width: int, body: wp.array(dtype=wp.vec3), base: int, start: int, p: wp.vec3
) -> int:
    # To the neighbour that is nearest to p, as long as one is nearer.
    here = int(start)
    best = float(wp.length_sq(body[base + start] - p))
    last = int(-1)  # noqa: UP018 - Warp's way to say that it changes
    while here != last:
        last = int(here)
        for k in range(last * width, (last + 1) * width):
            j = rings[k][0]
            if j < 0:
                break
            far = wp.length_sq(body[base + j] - p)
            if far < best:
                best = far
                here = j
    return here


@wp.kernel
def _walk(
    rings: wp.array(dtype=wp.vec2i),
    width: int,
    body: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    above: wp.array(dtype=wp.vec4),
    near: wp.array(dtype=int),
    others: wp.array(dtype=int),
    count: int,
    start: int,
):
    t = start + wp.tid()
    base = t / count * (rings.shape[0] / width)
    p = x[t]
    at = _descend(rings, width, body, base, near[t], p)
    if others.shape[0] > 0:
        other = _descend(rings, width, body, base, others[t], p)
        far = wp.length_sq(body[base + other] - p)
        if far < wp.length_sq(body[base + at] - p) and far < STRANGE * STRANGE:
            at = other
    near[t] = at
    out = wp.vec3(0.0, 0.0, 0.0)
    on = body[base + at]
    for k in range(at * width, (at + 1) * width):
        c = rings[k]
        if c[0] < 0:
            break
        out += wp.cross(body[base + c[0]] - on, body[base + c[1]] - on)
    normal = wp.normalize(out)
    height = float(-1.0)  # noqa: UP018 - the same
    if wp.length_sq(normal) > 0.0:
        height = wp.dot(normal, on) + OFFSET
    above[t] = wp.vec4(normal[0], normal[1], normal[2], height)
