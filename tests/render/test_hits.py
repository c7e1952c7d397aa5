"""First hits and the rays below them."""

from __future__ import annotations

import pytest
import torch
from render_shapes import ball, front_camera, sheet, tube

from recon.render.hits import first_hit, merge
from recon.render.rays import scene_on
from recon.types import Mesh


def test_hits_lie_where_the_pixel_looks() -> None:
    """Mesh, face, barycentrics and depth agree with projecting the point that they name."""
    meshes, view, size = [ball(12), tube(16, radius=0.75)], front_camera(size=(96, 128), focal=150.0), (48, 64)
    hit = first_hit(meshes, view, size)
    row, column = torch.nonzero(hit.mesh >= 0).unbind(1)
    merged = merge(meshes)
    face = hit.face[row, column] + merged.first_face[hit.mesh[row, column]]
    points = (merged.vertices[merged.faces[face]] * hit.barycentric[row, column][..., None]).sum(1)
    assert len(row) > 200 and set(hit.mesh.unique().tolist()) == {-1, 0, 1}
    assert torch.allclose(view.to_camera(points)[:, 2], hit.depth[row, column], atol=1e-4)
    pixels = view.project(points) / 2  # the photo has twice as many
    assert torch.allclose(pixels, torch.stack([column, row], 1) + 0.5, atol=2e-3)


def test_what_is_not_hit_is_marked() -> None:
    hit = first_hit([sheet(0.2)], front_camera(), (16, 16))
    assert hit.mesh[0, 0] == -1 and hit.face[0, 0] == -1 and torch.isinf(hit.depth[0, 0])
    assert not hit.barycentric[0, 0].any() and hit.mesh[8, 8] == 0


def test_nothing_in_view() -> None:
    away = Mesh(sheet().vertices + torch.tensor([0, 0, 50.0]), sheet().faces)
    hit = first_hit([away], front_camera(), (4, 4))
    assert (hit.mesh == -1).all() and torch.isinf(hit.depth).all()


def test_window_is_a_crop_of_the_whole() -> None:
    meshes, view = [ball(12)], front_camera(size=(64, 64))
    whole = first_hit(meshes, view)
    part = first_hit(meshes, view, (20, 30), window=(10.0, 30.0, 40.0, 50.0))
    assert float((part.face == whole.face[30:50, 10:40]).float().mean()) > 0.99


def test_rays_that_something_blocks() -> None:
    scene = scene_on(torch.device("cpu"))
    square = sheet(1.0, z=2.0)
    scene.set(square.vertices, square.faces)
    origins = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 3], [0, 0, 3]])
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, -1]])
    assert scene.blocked(origins, directions).tolist() == [True, False, False, True]
    assert not scene.blocked(origins, directions, reach=0.5).any()
    scene.set(square.vertices, square.faces[:0])
    assert not scene.blocked(origins, directions).any()


def test_wrong_use_is_named() -> None:
    with pytest.raises(ValueError, match="no meshes"):
        first_hit([], front_camera())
    with pytest.raises(ValueError, match="one at a time"):
        merge([Mesh(torch.zeros(2, 4, 3), sheet().faces)])
