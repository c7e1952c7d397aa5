"""Metrics against closed forms."""

import math

import pytest
import torch
import trimesh

from recon.metrics import boundary_loops, compare_meshes, largest_stretch, panel_iou, sample_surface, surface_distance
from recon.types import Mesh
from tests.garments.synthetic import tube


def sphere(radius: float) -> Mesh:
    m = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Mesh(torch.tensor(m.vertices, dtype=torch.float32), torch.tensor(m.faces))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_concentric_spheres():
    row = compare_meshes(sphere(0.50), sphere(0.51), generator(), 5000)
    assert row["surface_mm"] == pytest.approx(10, abs=0.3)
    assert row["normals"] > 0.995
    assert row["chd_surface"] == pytest.approx(2 * (0.01 / 0.51) ** 2, rel=0.06)
    assert row["chd"] > row["chd_surface"]


def test_a_mesh_is_at_no_distance_from_itself():
    row = compare_meshes(sphere(0.5), sphere(0.5), generator(), 3000)
    assert row["surface_mm"] < 1e-3 and row["normals"] > 0.9999


def test_flipped_faces_show_in_the_normals():
    ball = sphere(0.5)
    row = compare_meshes(Mesh(ball.vertices, ball.faces.flip(1)), ball, generator(), 2000)
    assert row["normals"] < -0.999


def test_exact_distances_agree_with_trimesh():
    torch.manual_seed(0)
    box = trimesh.creation.box((0.3, 0.5, 0.9))
    mesh = Mesh(torch.tensor(box.vertices, dtype=torch.float32), torch.tensor(box.faces))
    points = torch.rand(400, 3) * 2 - 1
    found, face = surface_distance(points, mesh)
    q = (points.abs() - torch.tensor([0.15, 0.25, 0.45])).double()
    wanted = (q.clamp_min(0).norm(dim=1) + q.amax(1).clamp_max(0)).abs()
    torch.testing.assert_close(found.double(), wanted, atol=1e-6, rtol=1e-5)
    assert face.max() < len(box.faces)


def test_samples_lie_on_the_surface_evenly():
    points, normals = sample_surface(sphere(1.0), 20000, generator())
    assert (points.norm(dim=1) - 1).abs().max() < 4e-3
    assert points.mean(0).norm() < 0.03
    assert ((points * normals).sum(1) > 0.99).all()


def test_borders_are_counted():
    assert boundary_loops(sphere(1.0).faces) == 0
    assert boundary_loops(tube().mesh.faces) == 2
    assert boundary_loops(tube(opening=0.05).mesh.faces) == 1


def test_a_tube_is_stretched_no_further_than_its_cut():
    stretch = largest_stretch(tube(0.25, 0.25, 0.5))
    assert stretch.median() == pytest.approx(1.0, abs=0.1) and stretch.max() < 1.2


def test_panel_overlap():
    full, short = tube(0.25, 0.25, 0.5), tube(0.25, 0.25, 0.25)
    assert panel_iou(full, full) == 1
    # the shorter panel lies in the middle of the longer one
    assert panel_iou(full, short) == pytest.approx(0.5, abs=0.02)
    assert math.isclose(panel_iou(full, short), panel_iou(short, full))
