"""Small scenes that the render tests share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.types import Camera, Mesh


def lattice(rows: int, columns: int, wrap: bool) -> Tensor:
    """(F, 3) triangles of a rows x columns lattice of vertices, counter-clockwise for columns to the right, rows up."""
    i, j = torch.meshgrid(torch.arange(rows - 1), torch.arange(columns if wrap else columns - 1), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    return torch.cat([torch.stack([a, b, d], -1).reshape(-1, 3), torch.stack([a, d, c], -1).reshape(-1, 3)])


def ball(n: int = 24, radii: tuple[float, float, float] = (0.5, 0.9, 0.35)) -> Mesh:
    """A closed ellipsoid, oriented outward."""
    theta = torch.linspace(0, math.pi, n + 1)[1:-1, None]
    phi = torch.arange(n)[None] * (2 * math.pi / n)
    ring = [theta.sin() * phi.sin(), -theta.cos() + 0 * phi, theta.sin() * phi.cos()]
    points = torch.stack(ring, -1).reshape(-1, 3)
    points = torch.cat([points, torch.tensor([[0.0, -1, 0], [0, 1, 0]])]) * torch.tensor(radii)
    k, south, north = torch.arange(n), len(points) - 2, len(points) - 1
    after, top = (k + 1) % n, (n - 2) * n
    caps = [torch.stack([after, k, k * 0 + south], 1), torch.stack([k + top, after + top, k * 0 + north], 1)]
    return Mesh(points, torch.cat([lattice(n - 1, n, True), *caps]))


def tube(n: int = 24, radius: float = 0.6, height: float = 0.9, ripple: float = 0.04) -> Mesh:
    """An open tube around the y axis, rippled like cloth."""
    phi = torch.arange(n)[None] * (2 * math.pi / n)
    y = torch.linspace(-height / 2, height / 2, n)[:, None]
    r = radius * (1 + ripple * (5 * phi).sin() * (4 * y).cos())
    points = torch.stack([r * phi.sin(), y + 0 * phi, r * phi.cos()], -1).reshape(-1, 3)
    return Mesh(points, lattice(n, n, True))


def sheet(side: float = 1.0, z: float = 0.0, n: int = 2) -> Mesh:
    """An open square that faces +z."""
    s = torch.linspace(-side / 2, side / 2, n)
    y, x = torch.meshgrid(s, s, indexing="ij")
    return Mesh(torch.stack([x, y, 0 * x + z], -1).reshape(-1, 3), lattice(n, n, False))


def front_camera(distance: float = 4.0, focal: float = 800.0, size: tuple[int, int] = (512, 512)) -> Camera:
    """Looks along -z at the origin, y up."""
    h, w = size
    return Camera(
        torch.tensor([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]]),
        torch.diag(torch.tensor([1.0, -1, -1])),
        torch.tensor([0.0, 0, distance]),
        size,
    )
