# mypy: disable-error-code="valid-type,arg-type,index,operator,call-overload,misc"
"""What rays through the image hit first, by rasterising homogeneous triangles: nothing is built, so nothing to rebuild.

A triangle with homogeneous image points p0, p1, p2 meets the ray (x, y, 1) at barycentric weights proportional to
e_i = (p_j x p_k) . (x, y, 1) and at depth det(p0, p1, p2) / (e_0 + e_1 + e_2); no division, no clipping of what reaches
behind the camera (Olano and Greer 1997). In doubles, so that a probe 1e-5 px beside an edge is on the right side of it.
Each triangle visits the samples in its bounds and leaves its depth and value there if it is the nearest: ties go to the
smaller value, so the outcome does not depend on the order, and CPU and GPU run the same kernels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from recon.render.view import NEAR

wp.config.log_level = wp.LOG_ERROR  # else it prints what it compiles
wp.init()

NOTHING = 1 << 62
"""Key of a sample that nothing covers; its value is 0."""
VALUES = 1 << 16
"""Values are smaller than this: they share 64 bits with the depth in units of 10 nm."""
BINS = 512
"""Probes are sorted into about this many bins across the image."""
_DEPTH_UNITS = wp.constant(wp.float64(1e8))
_FARTHEST = wp.constant(wp.float64(6e5))
_VALUES = wp.constant(wp.int64(VALUES))
_NEAR = wp.constant(wp.float64(NEAR))
_ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class _Triangle:
    """Weights e_i(x, y) = a_i x + b_i y + c_i, one per row, and the determinant that the depth needs."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d
    det: wp.float64


@wp.func
def _triangle(p0: wp.vec3d, p1: wp.vec3d, p2: wp.vec3d) -> _Triangle:
    out = _Triangle()
    e0, e1, e2 = wp.cross(p1, p2), wp.cross(p2, p0), wp.cross(p0, p1)
    out.a = wp.vec3d(e0[0], e1[0], e2[0])
    out.b = wp.vec3d(e0[1], e1[1], e2[1])
    out.c = wp.vec3d(e0[2], e1[2], e2[2])
    out.det = wp.dot(p0, e0)
    return out


@wp.func
def _key(t: _Triangle, at_y: wp.vec3d, x: wp.float64, value: int) -> wp.int64:
    """Depth and value of the triangle at x, where ``at_y`` = b y + c; ``NOTHING`` beside it or nearer than ``NEAR``."""
    e = t.a * x + at_y
    low, high = wp.min(e), wp.max(e)
    key = wp.int64(NOTHING)
    if (low >= _ZERO or high <= _ZERO) and t.det != _ZERO:
        depth = t.det / (e[0] + e[1] + e[2])
        if depth >= _NEAR and depth < _FARTHEST:
            key = wp.int64(depth * _DEPTH_UNITS) * _VALUES + wp.int64(value)
    return key


@wp.func
def _widened(bounds: wp.vec4d, p: wp.vec3d) -> wp.vec4d:
    x, y = p[0] / p[2], p[1] / p[2]
    return wp.vec4d(wp.min(bounds[0], x), wp.max(bounds[1], x), wp.min(bounds[2], y), wp.max(bounds[3], y))


@wp.func
def _bounds(p0: wp.vec3d, p1: wp.vec3d, p2: wp.vec3d) -> wp.vec4d:
    """x from, to, y from, to [px] of the part beyond the near plane."""
    far = wp.float64(1e30)
    out = wp.vec4d(far, -far, far, -far)
    p, q = p0, p1
    for i in range(3):
        if i == 1:
            p, q = p1, p2
        if i == 2:
            p, q = p2, p0
        if p[2] >= _NEAR:
            out = _widened(out, p)
        if (p[2] < _NEAR and q[2] >= _NEAR) or (p[2] >= _NEAR and q[2] < _NEAR):
            s = (_NEAR - p[2]) / (q[2] - p[2])
            cut = p + (q - p) * s
            out = _widened(out, wp.vec3d(cut[0], cut[1], _NEAR))
    return out


@wp.func
def _clamped(x: wp.float64, top: int) -> int:
    return int(wp.clamp(x, wp.float64(-1.0), wp.float64(top)))


@wp.kernel(enable_backward=False)
def _splat(
    points: wp.array(dtype=wp.vec3d),
    faces: wp.array2d(dtype=int),
    values: wp.array(dtype=int),
    grid: int,
    keys: wp.array2d(dtype=wp.int64),
):
    """Samples in the middle of the cells of a grid x grid in each pixel; keys (h grid, w grid)."""
    i = wp.tid()
    p0, p1, p2 = points[faces[i, 0]], points[faces[i, 1]], points[faces[i, 2]]
    height, width, n, half = keys.shape[0], keys.shape[1], wp.float64(grid), wp.float64(0.5)
    bounds = _bounds(p0, p1, p2) * n  # in cells from the image's centre
    left, top = wp.float64(width) * half - half, wp.float64(height) * half - half
    x0, x1 = _clamped(wp.ceil(bounds[0] + left), width), _clamped(wp.floor(bounds[1] + left), width)
    y0, y1 = _clamped(wp.ceil(bounds[2] + top), height), _clamped(wp.floor(bounds[3] + top), height)
    x0, x1, y0, y1 = wp.max(x0, 0), wp.min(x1, width - 1), wp.max(y0, 0), wp.min(y1, height - 1)
    if x0 > x1 or y0 > y1:
        return
    t = _triangle(p0, p1, p2)
    for row in range(y0, y1 + 1):
        at_y = t.b * ((wp.float64(row) - top) / n) + t.c
        for column in range(x0, x1 + 1):
            key = _key(t, at_y, (wp.float64(column) - left) / n, values[i])
            if key < keys[row, column]:
                wp.atomic_min(keys, row, column, key)


@wp.kernel(enable_backward=False)
def _probe(
    points: wp.array(dtype=wp.vec3d),
    faces: wp.array2d(dtype=int),
    values: wp.array(dtype=int),
    width: int,
    fine: wp.float64,
    first: wp.array(dtype=int),
    probes: wp.array(dtype=wp.vec2d),
    margin: wp.float64,
    keys: wp.array(dtype=wp.int64),
):
    """Probes sorted by bin, row by row, ``width`` bins in a row, ``fine`` bins in a pixel's side.

    Those of bin k start at first[k]; each lies within ``margin`` bins of its bin.
    """
    i = wp.tid()
    p0, p1, p2 = points[faces[i, 0]], points[faces[i, 1]], points[faces[i, 2]]
    height = (first.shape[0] - 1) / width
    bounds = _bounds(p0, p1, p2)
    bins = bounds * fine
    left, top = wp.float64(width) * wp.float64(0.5), wp.float64(height) * wp.float64(0.5)
    x0, x1 = _clamped(wp.floor(bins[0] + left - margin), width), _clamped(wp.floor(bins[1] + left + margin), width)
    y0, y1 = _clamped(wp.floor(bins[2] + top - margin), height), _clamped(wp.floor(bins[3] + top + margin), height)
    x0, x1 = wp.max(x0, 0), wp.min(x1, width - 1)
    if x0 > x1:
        return
    t = _Triangle()
    for row in range(wp.max(y0, 0), wp.min(y1, height - 1) + 1):
        for k in range(first[row * width + x0], first[row * width + x1 + 1]):
            at = probes[k]
            if at[0] >= bounds[0] and at[0] <= bounds[1] and at[1] >= bounds[2] and at[1] <= bounds[3]:
                if t.det == _ZERO:  # not yet made: few triangles get here
                    t = _triangle(p0, p1, p2)
                key = _key(t, t.b * at[1] + t.c, at[0], values[i])
                if key < keys[k]:
                    wp.atomic_min(keys, k, key)


@wp.kernel(enable_backward=False)
def _count(keys: wp.array2d(dtype=wp.int64), grid: int, coverage: wp.array3d(dtype=float)):
    row, column = wp.tid()
    share = 1.0 / float(grid * grid)
    for i in range(grid):
        for j in range(grid):
            value = int(keys[row * grid + i, column * grid + j] % _VALUES)
            if value > 0:
                coverage[value - 1, row, column] = coverage[value - 1, row, column] + share


@dataclass(frozen=True)
class Raster:
    """Triangles to look at."""

    points: Tensor
    """(V, 3) homogeneous image points (``View.points``): x / z, y / z [px] from the image's centre, z the depth [m]."""
    faces: Tensor
    """(F, 3) int32; both sides are seen."""
    values: Tensor
    """(F,) int32 >= 0: what a ray that hits the face first sees. 0 is what a ray sees that hits nothing."""

    def coverage(self, size: tuple[int, int], grid: int, n_labels: int) -> Tensor:
        """(n_labels, h, w): the share of a grid x grid in each pixel that shows the value label + 1."""
        h, w = size
        keys = self._empty(h * grid, w * grid)
        self._launch(_splat, grid, keys)
        out = torch.zeros(n_labels, h, w, device=keys.device)
        if n_labels:
            wp.launch(_count, (h, w), [_warp(keys), grid, _warp(out)], device=str(keys.device))
        return out

    def seen_beside(self, position: Tensor, offset: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Values (N,) at ``position + offset`` and at ``position - offset``, (N, 2) [px] from the image's centre."""
        fine = max(1, BINS // max(size))
        h, w = (n * fine for n in size)
        bin_of = (position * fine + position.new_tensor([w / 2, h / 2])).floor().long()
        bin_of = bin_of[:, 1].clamp(0, h - 1) * w + bin_of[:, 0].clamp(0, w - 1)
        order = torch.argsort(bin_of)
        first = torch.zeros(h * w + 1, dtype=torch.int32, device=position.device)
        first[1:] = 2 * torch.bincount(bin_of, minlength=h * w).cumsum(0)
        both = torch.stack([position + offset, position - offset], 1)[order].reshape(-1, 2).double()
        keys = self._empty(len(both))
        margin = 1e-6 + fine * float(offset.abs().max()) if len(both) else 0.0
        self._launch(_probe, w, float(fine), _warp(first), wp.from_torch(both, dtype=wp.vec2d), margin, keys)
        seen = torch.empty(len(position), 2, dtype=torch.long, device=position.device)
        seen[order] = (keys % VALUES).reshape(-1, 2)
        return seen[:, 0], seen[:, 1]

    def _empty(self, *shape: int) -> Tensor:
        return torch.full(shape, NOTHING, dtype=torch.int64, device=self.points.device)

    def _launch(self, kernel: wp.Kernel, *inputs) -> None:
        if not len(self.faces) or not inputs[-1].numel():
            return
        device = self.points.device
        points = wp.from_torch(self.points.detach().double().contiguous(), dtype=wp.vec3d)
        given = [_warp(i) if isinstance(i, Tensor) else i for i in inputs]
        arguments = [points, _warp(self.faces), _warp(self.values), *given]
        if device.type == "cuda":
            with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
                wp.launch(kernel, len(self.faces), arguments, device=str(device))
        else:
            wp.launch(kernel, len(self.faces), arguments, device="cpu")


def _warp(tensor: Tensor) -> wp.array:
    return wp.from_torch(tensor.contiguous())
