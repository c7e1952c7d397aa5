"""The body beside cloth: walks end at the nearest vertices of the part that cloth rides on or of one that came near."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from recon.cloth.beside import LANDMARKS, Surface, rings_of, spread
from recon.cloth.edges import OFFSET, EdgeProjection
from recon.cloth.energies import Cloth
from recon.types import Mesh

BALL = trimesh.creation.icosphere(4, 0.5)
REST = torch.from_numpy(np.array(BALL.vertices)).float()
SURFACE = Surface(REST, torch.from_numpy(np.array(BALL.faces)))


def around(count: int, radius: float, seed: int = 0) -> torch.Tensor:
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return radius * torch.nn.functional.normalize(x, dim=1)


def test_rings_are_all_corners_of_all_faces() -> None:
    rings = rings_of(np.array(BALL.faces), len(REST))
    found = {(a, b, c) for a, ring in enumerate(rings.tolist()) for b, c in ring if b >= 0}
    wanted = {tuple(f[k:] + f[:k]) for f in BALL.faces.tolist() for k in range(3)}
    assert found == wanted


def test_landmarks_are_far_from_each_other() -> None:
    marks = REST[spread(REST.double().numpy(), LANDMARKS)]
    apart = torch.cdist(marks, marks).fill_diagonal_(9.0).amin(1)
    assert apart.min() > 0.7 * (4 * torch.pi * 0.25 / LANDMARKS) ** 0.5


def test_walks_end_at_the_nearest_vertex_wherever_they_start() -> None:
    x, bodies = around(500, 0.51)[None].repeat(2, 1, 1), torch.stack([REST, REST.flip(1)])
    start = SURFACE.nearest_at_rest(-x[0])  # the other side
    found = SURFACE.beside(bodies, start)(x)
    normal, height = found[..., :3], found[..., 3]
    for k in (0, 1):
        wanted = bodies[k][torch.cdist(x[k], bodies[k]).argmin(1)]
        torch.testing.assert_close(height[k], (wanted * normal[k]).sum(1) + OFFSET)
        if k == 0:
            assert (normal[k] * torch.nn.functional.normalize(wanted, dim=1)).sum(1).min() > 0.999
    assert torch.equal(start.near, SURFACE.nearest_at_rest(-x[0]).near)  # walks leave it as it was


def test_planes_carry_the_body_s_gradient() -> None:
    body = REST[None].clone().requires_grad_()
    x = around(40, 0.5)[None]
    found = SURFACE.beside(body, SURFACE.nearest_at_rest(x[0]))(x)
    (slope,) = torch.autograd.grad(found[..., 3].sum(), body)
    torch.testing.assert_close(slope.sum((0, 1)), found[..., :3].sum((0, 1)).detach())


def test_cloth_in_a_ball_is_brought_out_of_it() -> None:
    sheet = trimesh.creation.icosphere(3, 0.49)
    mesh = Mesh(torch.from_numpy(np.array(sheet.vertices)).float(), torch.from_numpy(np.array(sheet.faces)))
    cloth = Cloth.from_mesh(mesh.with_vertices(1.04 * mesh.vertices))
    layer = EdgeProjection.of(cloth, 12)
    x = layer(mesh.vertices[None], SURFACE.beside(REST[None], SURFACE.nearest_at_rest(mesh.vertices)))
    assert x[0].norm(dim=1).min() > 0.5 + 0.5 * OFFSET  # the ball's vertices lie on 0.5, its faces a little inside


def test_what_does_not_fit_is_refused() -> None:
    start = SURFACE.nearest_at_rest(REST[:5])
    with pytest.raises(ValueError, match="wanted \\(B, 2562, 3\\)"):
        SURFACE.beside(REST[None, :-1], start)
    with pytest.raises(ValueError, match="wanted \\(1, 5, 3\\)"):
        SURFACE.beside(REST[None], start)(REST[None, :6])
