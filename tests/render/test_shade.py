"""Pictures for people: what they show, where, and how they are framed."""

from __future__ import annotations

import math

import pytest
import torch
from render_shapes import ball, front_camera, sheet, tube

from recon.render.shade import Look, orbit_camera, picture, turntable, vertex_normals
from recon.types import Mesh

RED, GREEN = (0.8, 0.2, 0.2), (0.2, 0.7, 0.3)


def test_picture_shows_each_mesh_in_its_colour() -> None:
    near = Mesh(sheet(0.5).vertices + torch.tensor([0.0, 0, 0.5]), sheet(0.5).faces)
    shown = picture([sheet(1.4), near], [RED, GREEN], front_camera(size=(96, 96), focal=150.0)).int()
    assert shown.shape == (96, 96, 3)
    assert (shown[0, 0] == 255).all()  # background
    red, green = shown[48, 26], shown[48, 48]
    assert red[0] > 2 * red[1] and green[1] > 1.5 * green[0]


def test_same_meshes_same_picture() -> None:
    draw = [picture([ball(12)], [RED], front_camera(), (64, 64)) for _ in range(2)]
    assert torch.equal(*draw)


def test_transparent_background_and_smooth_borders() -> None:
    shown = picture([ball(16)], [RED], front_camera(), (64, 64), Look(background=None))
    alpha = shown[..., 3]
    assert shown.shape == (64, 64, 4) and alpha[0, 0] == 0 and alpha[32, 32] == 255
    assert int(((alpha > 0) & (alpha < 255)).sum()) > 20


def test_insides_are_darker_and_never_black() -> None:
    square = sheet(1.0, n=4)
    outside = picture([square], [GREEN], front_camera(), (32, 32))[16, 16].int()
    inside = picture([Mesh(square.vertices, square.faces.flip(1))], [GREEN], front_camera(), (32, 32))[16, 16].int()
    assert 20 < inside[1] < outside[1]


def test_something_before_the_lamp_casts_a_shadow() -> None:
    floor, view = sheet(2.0), front_camera(size=(64, 64), focal=80.0)
    lid = Mesh(sheet(0.5).vertices + torch.tensor([-0.9, 0.8, 0.6]), sheet(0.5).faces)  # off the view to the lamp
    look = Look(lamp_radius=0.01, sky_light=0.2, ground_light=0.2)
    lit, shaded = (picture(meshes, [RED] * len(meshes), view, None, look).int() for meshes in ([floor], [floor, lid]))
    assert int((lit[..., 0] - shaded[..., 0] > 30).sum()) > 40
    assert (lit[50, 50] - shaded[50, 50]).abs().max() <= 3


def test_vertex_colours_blend() -> None:
    square = sheet(1.0)
    colours = torch.tensor([[1.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1]])
    shown = picture([square], [colours], front_camera(), (32, 32)).int()
    left, right = shown[16, 14], shown[16, 18]
    assert left[0] > left[2] and right[2] > right[0]


def test_nothing_in_view_is_background() -> None:
    away = Mesh(sheet().vertices + 50.0, sheet().faces)
    assert (picture([away], [RED], front_camera(), (8, 8)) == 255).all()


@pytest.mark.parametrize("azimuth", [0.0, 0.9, math.pi])
def test_orbit_camera_frames_everything(azimuth: float) -> None:
    meshes = [ball(12), Mesh(tube(12).vertices + torch.tensor([0.3, 2.0, 0]), tube(12).faces)]
    view = orbit_camera(meshes, azimuth, 0.2, (80, 60))
    assert torch.allclose(view.R @ view.R.T, torch.eye(3), atol=1e-5) and torch.linalg.det(view.R) > 0
    pixels = view.project(torch.cat([m.vertices for m in meshes]))
    assert (pixels > 0).all() and (pixels < torch.tensor([60.0, 80.0])).all()
    assert (pixels.amax(0) - pixels.amin(0)).max() > 30  # and fills the picture


def test_orbit_camera_goes_round_to_the_left() -> None:
    """From the front the wearer's left (+x) is on the right; from azimuth +90 degrees one looks at the left side."""
    points = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, -1, 0], [0, 0, 1]])
    mesh = Mesh(points, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    front, left = (orbit_camera([mesh], a).to_camera(points) for a in (0.0, math.pi / 2))
    assert front[0, 0] > front[2, 0] and front[1, 1] < front[0, 1] and front[3, 2] < front[0, 2]
    assert left[0, 2] < left[2, 2]


def test_turntable_starts_in_front_and_turns() -> None:
    mesh = Mesh(tube(12).vertices * torch.tensor([1.0, 1, 0.3]), tube(12).faces)
    shots = turntable([mesh], [GREEN], n=2, size=(40, 40), look=Look(samples=1, sky_rays=1, lamp_rays=1))
    assert len(shots) == 2 and not torch.equal(shots[0], shots[1])


def test_vertex_normals_of_a_sphere_point_out() -> None:
    mesh = ball(20, (1.0, 1.0, 1.0))
    assert ((vertex_normals(mesh.vertices, mesh.faces) * mesh.vertices).sum(1) > 0.99).all()


def test_wrong_use_is_named() -> None:
    with pytest.raises(ValueError, match="1 meshes and 2 colours"):
        picture([sheet()], [RED, GREEN], front_camera())
