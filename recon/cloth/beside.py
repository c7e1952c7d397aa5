"""The body beside cloth: for each vertex of a garment the plane of the body's surface that it should stay above.

Nearest vertices of the body are found by walking over its surface, from the one that was nearest at rest (so that cloth
stays with the part that it rides on) and from the nearest of a few landmarks (so that other parts that came near are
found, too). From landmarks only one walks of all that have the same vertex nearest at rest: where it ends the others
start. That takes the first time a sixth of what a search tree takes, later a tenth.
"""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True)
class Start:
    """Where the walks of a garment's vertices start."""

    near: Tensor
    """(V,) int32, the body's vertices that are nearest at rest."""
    leaders: Tensor
    """(L,) garment vertices that walk from landmarks, one of those that start at the same vertex of the body."""
    leader: Tensor
    """(V,) int32, the place among the leaders of the one whom each vertex follows."""

    @classmethod
    def at(cls, near: NDArray, device: torch.device) -> Start:
        """From the nearest vertices (V,)."""
        _, leaders, leader = np.unique(near, return_index=True, return_inverse=True)
        given = near.astype(np.int32), leaders, leader.astype(np.int32)
        return cls(*(torch.as_tensor(values, device=device) for values in given))


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
        self._marks = wp.array(spread(rest, LANDMARKS), dtype=int, device=self.device)

    def nearest_at_rest(self, x: Tensor) -> Start:
        """Where walks of a garment's vertices (V, 3) at rest start."""
        return Start.at(self._tree.query(x.detach().cpu().double().numpy())[1], x.device)

    def beside(self, body: Tensor, start: Start) -> Beside:
        """Planes for a garment whose walks start at ``start``, on bodies (B, N, 3).

        Raises:
            ValueError: bodies of another topology.
        """
        if body.dim() != 3 or body.shape[1] != self.count:
            raise ValueError(f"body: found vertices {tuple(body.shape)}; wanted (B, {self.count}, 3)")
        return Beside(self, body, start)

    def _walk(self, body: Tensor, x: Tensor, near: Tensor, found: Tensor, led: Tensor, leader: Tensor) -> None:
        above = wp.from_torch(found.view(-1, 4), dtype=wp.vec4)
        numbers = [wp.from_torch(t.view(-1)) for t in (near, led, leader)]
        given = [*self._known(body), _row(x), above, *numbers, near.shape[1], led.shape[1]]
        Launch(_walk, near.numel(), given, self.device)()

    def _led(self, body: Tensor, x: Tensor) -> Tensor:
        """(B, L) int32, where walks of leaders (B, L, 3) end."""
        found = torch.empty(x.shape[:2], dtype=torch.int32, device=x.device)
        given = [*self._known(body), _row(x), self._marks, wp.from_torch(found.view(-1)), x.shape[1]]
        Launch(_lead, found.numel(), given, self.device)()
        return found

    def _known(self, body: Tensor) -> list[Any]:
        return [self._rings, self.width, _row(body)]


class Beside:
    """Says planes (``recon.cloth.edges.planes``) whenever it is asked; walks go on from where the last ones ended."""

    def __init__(self, surface: Surface, body: Tensor, start: Start):
        self.surface, self.body, self.start = surface, body, start
        self.near = start.near.repeat(len(body), 1)
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
        x, leaders = x.contiguous(), self.start.leaders
        led = self.surface._led(self.seen, x[:, leaders]) if self.first else self.near.new_zeros(len(x), 0)
        self.surface._walk(self.seen, x, self.near, found, led, self.start.leader)
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


def _row(points: Tensor) -> wp.array:
    return wp.from_torch(points.view(-1, 3), dtype=wp.vec3)


@wp.func
def _descend(
    rings: wp.array(dtype=wp.vec2i),
    width: int,
    body: wp.array(dtype=wp.vec3),
    base: int,
    start: int,
    end: int,
    p: wp.vec3,
) -> int:
    # To the neighbour that is nearest to p, as long as one is nearer, or until it comes to where another walk ended.
    here = int(start)
    best = float(wp.length_sq(body[base + start] - p))
    last = int(-1)  # noqa: UP018 - Warp's way to say that it changes
    while here != last and here != end:
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
def _lead(
    rings: wp.array(dtype=wp.vec2i),
    width: int,
    body: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    marks: wp.array(dtype=int),
    found: wp.array(dtype=int),
    count: int,
    start: int,
):
    # From the nearest landmark.
    t = start + wp.tid()
    base = t / count * (rings.shape[0] / width)
    p = x[t]
    at = marks[0]
    best = float(wp.length_sq(body[base + at] - p))
    for k in range(1, marks.shape[0]):
        far = wp.length_sq(body[base + marks[k]] - p)
        if far < best:
            best = far
            at = marks[k]
    found[t] = _descend(rings, width, body, base, at, -1, p)


@wp.kernel
def _walk(
    rings: wp.array(dtype=wp.vec2i),
    width: int,
    body: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    above: wp.array(dtype=wp.vec4),
    near: wp.array(dtype=int),
    led: wp.array(dtype=int),
    leader: wp.array(dtype=int),
    count: int,
    leaders: int,
    start: int,
):
    t = start + wp.tid()
    drape = t / count
    base = drape * (rings.shape[0] / width)
    p = x[t]
    at = _descend(rings, width, body, base, near[t], -1, p)
    if leaders > 0:
        other = _descend(rings, width, body, base, led[drape * leaders + leader[t - drape * count]], at, p)
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
