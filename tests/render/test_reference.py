"""Two renderers that share no gradient code must agree: edge sampling (ours) and projective sampling (Mitsuba's)."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from recon.render.labels import LabelRenderer
from recon.render.reference import reference_labels
from recon.types import Camera, Mesh

SIZE = (20, 26)


def sheet(n: int, corners: list[list[float]], bulge: float = 0.0) -> Mesh:
    """An open n x n patch between four corners, pushed towards the viewer in its middle."""
    a, b, c, d = torch.tensor(corners)
    s = torch.linspace(0, 1, n + 1)
    v, u = torch.meshgrid(s, s, indexing="ij")
    u, v = u.reshape(-1, 1), v.reshape(-1, 1)
    points = (a * (1 - u) + b * u) * (1 - v) + (d * (1 - u) + c * u) * v
    points = points + bulge * (math.pi * u).sin() * (math.pi * v).sin() * torch.tensor([0.0, 0.0, 1.0])
    i = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    quads = torch.stack([i, i + 1, i + n + 2, i + n + 1], 1)
    return Mesh(points, torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def tube(n: int, radius: float, low: float, high: float) -> Mesh:
    """An open tube around the y axis, like a sleeve: its inside shows through its ends."""
    angle = torch.arange(n) * (2 * math.pi / n)
    ring = torch.stack([radius * angle.sin(), torch.zeros(n), radius * angle.cos()], 1)
    points = torch.cat([ring + torch.tensor([0.0, y, 0.0]) for y in (low, (low + high) / 2, high)])
    i, j = torch.arange(n), (torch.arange(n) + 1) % n
    lower = torch.cat([torch.stack([i, j, j + n], 1), torch.stack([i, j + n, i + n], 1)])
    return Mesh(points, torch.cat([lower, lower + n]))


def camera() -> Camera:
    """From the front and above, so that the tube's inside is seen; of a larger image than the label image."""
    a = 0.35
    down = torch.tensor([[1.0, 0, 0], [0, -math.cos(a), math.sin(a)], [0, -math.sin(a), -math.cos(a)]])
    intrinsics = torch.tensor([[420.0, 0, 370], [0, 430, 270], [0, 0, 1]]).requires_grad_()
    return Camera(intrinsics, down, torch.tensor([0.05, 0.02, 3.0]).requires_grad_(), (560, 728))


def scene() -> list[Mesh]:
    """A sleeve, a bulged patch that cuts off a part of its view, and a mere occluder in front of both."""
    patch = sheet(5, [[-0.9, -0.5, 0.45], [0.15, -0.65, 0.5], [0.25, 0.3, 0.55], [-0.8, 0.2, 0.5]], bulge=0.25)
    beam = sheet(1, [[0.15, -0.9, 0.9], [0.35, -0.9, 0.9], [0.45, 0.9, 0.9], [0.25, 0.9, 0.9]])
    return [tube(14, 0.6, -0.7, 0.6), patch, beam]


def worth(labels: int) -> Tensor:
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE[0]), torch.linspace(0, 1, SIZE[1]), indexing="ij")
    return torch.stack([(5 * x + k).sin() + (4 * y + 2 * k * x).cos() for k in range(labels)])


@pytest.mark.parametrize("labels", [[0, 1, -1], [1, 3, 1]], ids=["occluder", "four labels, one shared"])
def test_gradients_agree_with_projective_sampling(labels: list[int]) -> None:
    meshes, view = scene(), camera()
    vertices = [mesh.vertices.clone().requires_grad_() for mesh in meshes]
    wanted = [*vertices, view.K, view.t]
    weight = worth(max(labels) + 1)
    ours = LabelRenderer([m.faces for m in meshes], labels, [len(v) for v in vertices], step=0.005)
    image = ours(vertices, view, SIZE, samples=1024)
    twin = reference_labels([Mesh(v, m.faces) for v, m in zip(vertices, meshes)], labels, view, SIZE, samples=6000)
    assert torch.allclose(image, twin, atol=0.03)
    mine = torch.autograd.grad((image * weight).sum(), wanted)
    theirs = torch.autograd.grad((twin * weight).sum(), wanted)
    errors = [float((a - b).norm() / b.norm()) for a, b in zip(mine, theirs)]
    assert max(errors[: len(vertices)]) < 0.01, errors  # vertices
    assert max(errors[len(vertices) :]) < 0.03, errors  # K (focal lengths, principal point), t


def test_twin_sees_both_sides_of_open_meshes() -> None:
    mesh, view = scene()[1], camera()
    flipped = Mesh(mesh.vertices, mesh.faces.flip(1))
    one, two = (reference_labels([m], [0], view, SIZE, samples=64) for m in (mesh, flipped))
    assert torch.allclose(one, two, atol=1e-6) and float(one.detach().sum()) > 20
