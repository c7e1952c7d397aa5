"""Surfaces of fields that know their sides: in place, open, followed; and what networks say of sides."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.garments.mesh_udf import Frame, Meshing
from recon.garments.panels import border_loops
from recon.garments.sewing import is_manifold
from recon.garments.udf_grid import Box
from recon.garments.udf_sides import beyond_borders, cut_level, filled, follow_sides, mesh_sides
from recon.types import Mesh
from tests.garments.exact_udf import MIDDLE, RADIUS, SHAPE, SLOPE, SidedTube
from tests.garments.fields import integral

BOX, BORDER = Box(SHAPE.low, SHAPE.high), 0.004
CODE = torch.tensor([0.2, -0.3])


def meshed(code: torch.Tensor, resolution: int = 64) -> Mesh:
    return mesh_sides(SidedTube(code), BOX, Meshing(resolution, floor=BORDER + 0.002), BORDER)


@pytest.mark.parametrize("resolution", [40, 64, 96])
def test_a_tube_comes_out_open_manifold_and_in_place(resolution):
    mesh, field = meshed(CODE, resolution), SidedTube(CODE)
    loops = border_loops(mesh.faces.numpy())
    assert is_manifold(mesh.faces.numpy()) and len(loops) == 2
    sides = field.sides(mesh.vertices)
    assert sides[:, 0].abs().max() < 5e-4 and sides[:, 1].max() < BORDER + 2e-3
    for loop in loops:
        rim = mesh.vertices[loop]
        length = float((rim - rim.roll(1, 0)).norm(dim=1).sum())
        assert length == pytest.approx(2 * np.pi * (RADIUS + SLOPE * 0.2), rel=0.02)
        assert 0 <= field.sides(rim)[:, 1].median() < BORDER + 1e-3


@pytest.mark.parametrize("entry", [0, 1])
def test_gradients_against_meshing_anew(entry):
    mesh = meshed(CODE)
    free = CODE.clone().requires_grad_()
    moved = follow_sides(SidedTube(free), mesh, torch.zeros(1), Frame.of(mesh))
    assert torch.equal(moved.vertices, mesh.vertices)
    (found,) = torch.autograd.grad(integral(moved.vertices, mesh.faces), free)
    step = 0.2 * torch.eye(2)[entry]
    ends = [integral(m.vertices, m.faces) for m in (meshed(CODE + step, 96), meshed(CODE - step, 96))]
    assert float(found[entry] / ((ends[0] - ends[1]) / 0.4)) == pytest.approx(1, abs=0.05)


def tall(rim: torch.Tensor) -> float:
    """How far the upper border's middle is above the lower one's [m]."""
    y = rim[:, 1]
    return float(y[y > MIDDLE].median() - y[y < MIDDLE].median())


@pytest.mark.parametrize("change", [0.2, -0.2])
def test_vertices_and_borders_follow_a_code(change):
    code = CODE + change
    field, mesh = SidedTube(code), meshed(CODE)
    frame = Frame.of(mesh)
    before = tall(mesh.vertices[frame.border])
    level = beyond_borders(SidedTube(CODE), mesh, frame)
    for _ in range(3):
        mesh = follow_sides(field, mesh, level, frame, move=True)
    assert field.sides(mesh.vertices)[:, 0].abs().max() < 1e-4
    assert (beyond_borders(field, mesh, frame) - level).abs().median() < 1e-4
    grown = tall(mesh.vertices[frame.border]) - before
    assert grown == pytest.approx(2 * SLOPE * change, rel=0.1)


def test_islands_are_filled_and_true_borders_are_not():
    """On a sheet: what is over the border in its middle is noise, what goes on to the sheet's end is not."""
    n = 20
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    corner = (i * (n + 1) + j)[:, None]
    faces = np.concatenate([corner + [0, n + 1, n + 2], corner + [0, n + 2, 1]])
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij"))
    over = np.where((np.abs(x - 10) < 2) & (np.abs(y - 10) < 2), 0.5, -1.0)
    over = np.where(x > 15, x - 15.5, over)
    whole = filled(over, faces)
    assert (whole[x < 15] < 0).all() and np.array_equal(whole[x > 15], over[x > 15])
    points, kept = cut_level(np.stack([x, y, 0 * x], 1), faces, whole, 0.1)
    assert len(border_loops(kept)) == 1 and len(border_loops(cut_level(points[: len(x)], faces, over, 0.1)[1])) == 2
    assert points[np.unique(kept), 0].max() == pytest.approx(15.33, abs=0.4)


def test_where_there_is_no_surface_there_is_no_mesh():
    far = torch.tensor([40.0, 0.0])
    assert len(meshed(far, 32).faces) == 0
