"""From world points to homogeneous image points: the space that all rays are traced in.

A pinhole image depends on x = K (R X + t) alone, and x ↦ x_xy / x_z keeps straight lines, occlusion order and depth
(x_z is the depth itself). So every renderer here moves the *vertices* by K, R and t, differentiably in torch, and then
looks at them with one fixed camera: rays (u, v, 1) from the origin. Gradients with respect to focal length, principal
point, rotation and translation need no code of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.types import Camera

NEAR = 1e-3
"""Nothing nearer to the camera than this is looked at [m]."""

Window = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels of the original image; pixel (row i, column j) covers [j, j + 1) x [i, i + 1)."""


@dataclass(frozen=True)
class Grid:
    """Rays (u, v, 1) through n x n places in each pixel, as n x n whole images one after the other: (n n, h, w)."""

    size: tuple[int, int]
    """(h, w) pixels."""
    n: int
    scale: float
    """Pixels per unit of slope."""

    def __len__(self) -> int:
        return self.size[0] * self.size[1] * self.n**2

    def slopes(self) -> Tensor:
        """(n n h w, 2) the rays' u and v."""
        n = self.n
        v, u = ((torch.arange(m * n) + 0.5).div(n).sub(m / 2).div(self.scale).reshape(m, n).T for m in self.size)
        h, w = self.size
        rows = v[:, None, :, None].expand(n, n, h, w)
        columns = u[None, :, None, :].expand(n, n, h, w)
        return torch.stack([columns.reshape(-1), rows.reshape(-1)], 1)


@dataclass(frozen=True)
class View:
    """A camera, the part of its image that is wanted, and the pixels to put it on."""

    matrix: Tensor
    """(3, 3) world -> homogeneous image, without the translation; differentiable in K and R."""
    offset: Tensor
    """(3,) its translation; differentiable in K and t."""
    size: tuple[int, int]
    """(h, w) output pixels."""

    @property
    def scale(self) -> float:
        """Pixels per unit of the traced space: a power of two, so that dividing by it is exact."""
        return float(2 ** (max(self.size) - 1).bit_length())

    def points(self, vertices: Tensor) -> Tensor:
        """(V, 3) world [m] -> (V, 3) homogeneous image points.

        x / z and y / z are output pixels from the image's centre, z is the depth [m].
        """
        return vertices @ self.matrix.T.to(vertices) + self.offset.to(vertices)

    def directions(self, world: Tensor) -> Tensor:
        """(N, 3) world directions -> homogeneous image directions (the map of points is affine)."""
        return world @ self.matrix.T.to(world)

    def traced(self, points: Tensor) -> Tensor:
        """(N, 3) homogeneous image points or directions, scaled to the traced space."""
        return points / points.new_tensor([self.scale, self.scale, 1.0])

    def grid(self, n: int) -> Grid:
        """The rays of a regular n x n grid in each pixel."""
        return Grid(self.size, n, self.scale)


def view_of(camera: Camera, size: tuple[int, int] | None = None, window: Window | None = None) -> View:
    """The view of ``camera`` on ``size`` = (h, w) output pixels (None: the original's), of the whole image or a window.

    Differentiable in the camera's K, R and t.
    """
    h, w = size if size is not None else camera.size
    x0, y0, x1, y1 = window if window is not None else (0.0, 0.0, float(camera.size[1]), float(camera.size[0]))
    if h < 1 or w < 1 or x1 <= x0 or y1 <= y0:
        raise ValueError(f"render: found size {(h, w)} and window {(x0, y0, x1, y1)}; both must have a positive area")
    ax, ay = w / (x1 - x0), h / (y1 - y0)
    crop = torch.tensor([[ax, 0.0, -ax * x0 - w / 2], [0.0, ay, -ay * y0 - h / 2], [0.0, 0.0, 1.0]])
    intrinsics = crop.to(camera.K) @ camera.K
    return View(intrinsics @ camera.R.to(camera.K), intrinsics @ camera.t.to(camera.K), (h, w))


def outcodes(points: Tensor, size: tuple[int, int]) -> Tensor:
    """(V,) uint8, one bit per half space of the image that a homogeneous point lies outside of.

    Left, right, top, bottom, behind. A face or an edge whose corners share a bit can't be seen. Holds for points behind
    the camera as well.
    """
    h, w = size
    x, y, z = points.unbind(1)
    sides = (x < -w / 2 * z, x > w / 2 * z, y < -h / 2 * z, y > h / 2 * z, z < NEAR)
    code = torch.zeros(len(points), dtype=torch.uint8, device=points.device)
    for bit, outside in enumerate(sides):
        code |= outside.to(torch.uint8) << bit
    return code
