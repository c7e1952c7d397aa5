"""Signed distance to a body: against a sphere's, and its gradients against finite differences."""

import pytest
import torch
import trimesh

from recon.cloth.contact import BodyContact


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=0.3)


def contact(ball: trimesh.Trimesh) -> BodyContact:
    return BodyContact(torch.tensor(ball.vertices), torch.tensor(ball.faces))


def around(n: int, low: float, high: float) -> torch.Tensor:
    g = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=1)
    return direction * (low + (high - low) * torch.rand(n, 1, generator=g, dtype=torch.float64))


def test_distance_is_a_spheres(ball: trimesh.Trimesh) -> None:
    points = around(500, 0.05, 0.9)
    distance = contact(ball).signed_distance(points)
    assert torch.allclose(distance, points.norm(dim=1) - 0.3, atol=6e-4)


def test_sides(ball: trimesh.Trimesh) -> None:
    points = torch.cat([around(50, 0.01, 0.29), around(50, 0.31, 1.0)])
    assert contact(ball).penetrating(points).tolist() == [True] * 50 + [False] * 50


def test_gradient_in_points_and_in_the_body(ball: trimesh.Trimesh) -> None:
    points = around(20, 0.1, 0.6).requires_grad_(True)
    vertices = torch.tensor(ball.vertices, requires_grad=True)
    distance = BodyContact(vertices, torch.tensor(ball.faces)).signed_distance(points)
    by_point, by_body = torch.autograd.grad(distance.sum(), (points, vertices))
    here = contact(ball)
    for k in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[k] = 1e-3
        difference = (here.signed_distance(points + step) - here.signed_distance(points - step)) / 2e-3
        assert torch.allclose(by_point[:, k], difference, atol=0.02)
    # Moving the body is moving the points the other way.
    assert torch.allclose(by_body.sum(0), -by_point.sum(0), atol=1e-6)


def test_gradient_on_the_surface_is_finite(ball: trimesh.Trimesh) -> None:
    points = torch.tensor(ball.vertices[:10]).requires_grad_(True)
    (gradient,) = torch.autograd.grad(contact(ball).signed_distance(points).sum(), points)
    assert torch.isfinite(gradient).all() and float(gradient.norm(dim=1).min()) > 0.9


def test_far_and_broken_points_are_refused(ball: trimesh.Trimesh) -> None:
    with pytest.raises(ValueError, match="not within"):
        contact(ball).signed_distance(torch.tensor([[9.0, 0.0, 0.0]]))
    assert contact(ball).signed_distance(torch.zeros(0, 3)).shape == (0,)
