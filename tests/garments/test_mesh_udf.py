"""Open surfaces out of unsigned distance fields: closed forms, exact fields of garments, gradients."""

import numpy as np
import pytest
import torch

from recon.garments.dataset import load_garments
from recon.garments.marching import table
from recon.garments.mesh_udf import Frame, Meshing, follow, mesh_udf
from recon.garments.panels import border_loops
from recon.garments.sewing import is_manifold
from recon.garments.udf_field import MeshField
from recon.garments.udf_grid import Box, find_band, slope
from recon.garments.udf_signs import CELL_EDGES, signs
from recon.metrics import boundary_loops, compare_meshes
from recon.types import Mesh
from tests.garments.exact_udf import RADIUS, SHAPE, SLOPE, TubeDecoder
from tests.garments.fields import cylinder, disc, hemisphere, integral
from tests.garments.synthetic import tube

BOX = Box((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4))
SHAPES = {"disc": (disc, (0.25,), 1), "cylinder": (cylinder, (0.15, 0.2), 2), "hemisphere": (hemisphere, (0.25,), 1)}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("resolution", [40, 64])
def test_closed_forms_come_out_open_manifold_and_in_place(name, resolution):
    make, sizes, loops = SHAPES[name]
    mesh = mesh_udf(make(*sizes), BOX, Meshing(resolution))
    cell = 0.8 / resolution
    assert is_manifold(mesh.faces.numpy()) and boundary_loops(mesh.faces) == loops
    assert make(*sizes)(mesh.vertices).max() < 0.15 * cell
    edges = mesh.vertices[mesh.faces] - mesh.vertices[mesh.faces.roll(1, 1)]
    assert edges.norm(dim=-1).max() < 3 * cell


@pytest.mark.parametrize("name", SHAPES)
def test_borders_lie_where_the_surface_ends(name):
    make, sizes, _ = SHAPES[name]
    mesh = mesh_udf(make(*sizes), BOX, Meshing(64))
    frame = Frame.of(mesh)
    beyond = make(*sizes)(mesh.vertices[frame.border] + 0.01 * frame.outward)
    assert (beyond - 0.01).abs().median() < 2e-4 and (beyond - 0.01).abs().quantile(0.98) < 2e-3


@pytest.mark.parametrize("code", [(0.0, 0.0), (0.2, -0.3), (0.7, 0.6)])
@pytest.mark.parametrize("resolution", [48, 64])
def test_along_the_grid_borders_are_as_long_as_they_should_be(code, resolution):
    """A tube round a grid axis: whole columns of slivers end at its borders, and none may become a slit."""
    decoder = TubeDecoder()
    mesh = mesh_udf(decoder.field(torch.tensor(code)), Box(SHAPE.low, SHAPE.high), Meshing(resolution))
    loops = border_loops(mesh.faces.numpy())
    assert len(loops) == 2
    for loop in loops:
        rim = mesh.vertices[loop]
        length = (rim - rim.roll(1, 0)).norm(dim=1).sum()
        assert float(length) == pytest.approx(2 * np.pi * (RADIUS + SLOPE * code[0]), rel=0.02)


@pytest.mark.parametrize(("name", "which"), [("disc", 0), ("cylinder", 0), ("cylinder", 1), ("hemisphere", 0)])
def test_gradients_against_finite_differences_of_meshing_anew(name, which):
    """The radius moves the inside of a cylinder, its length only the borders: both terms of the gradient are there."""
    make, sizes, _ = SHAPES[name]
    mesh = mesh_udf(make(*sizes), BOX, Meshing(64))
    free = [torch.tensor(s, requires_grad=k == which) for k, s in enumerate(sizes)]
    moved = follow(make(*free), mesh, 0.0125)
    assert torch.equal(moved.vertices, mesh.vertices)
    (found,) = torch.autograd.grad(integral(moved.vertices, mesh.faces), free[which])
    ends = []
    for step in (0.02, -0.02):
        changed = [s + step * (k == which) for k, s in enumerate(sizes)]
        again = mesh_udf(make(*changed), BOX, Meshing(64))
        ends.append(integral(again.vertices, again.faces))
    wanted = (ends[0] - ends[1]) / 0.04
    assert abs(float(found / wanted) - 1) < 0.05


def test_a_vertex_follows_its_surface():
    """Closed form: where radius and length grow, every vertex moves out with the radius, border ones along as well."""
    radius, half = (torch.tensor(s, requires_grad=True) for s in (0.15, 0.2))
    mesh = mesh_udf(cylinder(0.15, 0.2), BOX, Meshing(48))
    frame = Frame.of(mesh)
    moved = follow(cylinder(radius, half), mesh, 0.015, frame)
    (out,) = torch.autograd.grad((moved.vertices * frame.normal).sum() / len(frame.normal), radius, retain_graph=True)
    rim = (moved.vertices[frame.border] * frame.outward).sum() / len(frame.border)
    (along,) = torch.autograd.grad(rim, half)
    assert abs(float(out) - 1) < 0.02 and abs(float(along) - 1) < 0.03


def test_follow_moves_to_a_surface_nearby():
    mesh = mesh_udf(cylinder(0.15, 0.2), BOX, Meshing(48))
    moved, frame = mesh, Frame.of(mesh)
    for _ in range(3):
        moved = follow(cylinder(0.156, 0.205), moved, 0.015, frame, held=0.015)
    assert cylinder(0.156, 0.205)(moved.vertices).max() < 7e-4
    assert (cylinder(0.156, 0.205)(moved.vertices[frame.border] + 0.015 * frame.outward) - 0.015).abs().max() < 2e-4
    assert cylinder(0.156, 0.205)(mesh.vertices).median() > 5e-3


def test_gradients_reach_the_vertices_of_an_exact_field():
    garment = tube()
    vertices = garment.mesh.vertices.clone().requires_grad_()
    field = MeshField(Mesh(vertices, garment.mesh.faces))
    mesh = mesh_udf(MeshField(garment.mesh), Box.around(garment.mesh.vertices), Meshing(64))
    lifted = follow(field, mesh, 0.01)
    (found,) = torch.autograd.grad(lifted.vertices[:, 1].mean(), vertices)
    # Only borders can move the surface up: raising everything by one raises their share of the vertices.
    share = len(Frame.of(mesh).border) / len(mesh.vertices)
    assert abs(float(found[:, 1].sum()) - share) < 0.25 * share


@pytest.mark.parametrize(("kind", "number"), [("top", 0), ("top", 13), ("skirt", 3), ("trousers", 0)])
def test_exact_fields_of_garments_have_no_holes_and_one_layer(kind, number):
    truth = load_garments(kind, "test")[number].mesh
    mesh = mesh_udf(MeshField(truth), Box.around(truth.vertices), Meshing(128))
    assert is_manifold(mesh.faces.numpy())
    assert len(border_loops(mesh.faces.numpy())) == boundary_loops(truth.faces)
    found = compare_meshes(mesh, truth, torch.Generator().manual_seed(0), 1500)
    assert found["surface_mm"] < 0.4 and found["normals"] > 0.97
    area = [float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum()) for a, b, c in map(_corners, (mesh, truth))]
    assert abs(area[0] / area[1] - 1) < 0.02  # a double layer would have twice as much


def _corners(mesh):
    return mesh.vertices[mesh.faces].unbind(1)


def test_the_search_evaluates_a_small_part_of_the_grid():
    asked = 0
    field = disc(0.25)

    def counting(x):
        nonlocal asked
        asked += len(x)
        return field(x)

    mesh_udf(counting, BOX, Meshing(96))
    assert asked < 0.12 * 97**3


def test_the_band_misses_no_cell_of_the_surface():
    truth = tube().mesh
    band = find_band(MeshField(truth), Box.around(truth.vertices), 64)
    inside = {tuple(c) for c in band.at[band.corners[:, 0]].tolist()}
    middles = truth.vertices[truth.faces].mean(1).double().numpy()
    assert all(tuple(c) in inside for c in np.floor((middles - band.low) / band.cell).astype(int).tolist())
    sign = signs(MeshField(truth), band)
    assert set(np.unique(sign)) == {-1, 1}


def test_marching_table_is_closed_on_every_case():
    """Each crossed edge of a cell is on exactly one outline, and triangles look at the positive side."""
    first, rows = table()
    for case in range(256):
        negative = np.array([case >> k & 1 for k in range(8)], bool)
        crossed = set(np.flatnonzero(negative[CELL_EDGES[:, 0]] != negative[CELL_EDGES[:, 1]]).tolist())
        triangles = rows[first[case] : first[case + 1]]
        assert set(triangles.ravel().tolist()) == crossed
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        assert len(np.unique(edges, axis=0)) == len(edges)


def test_slopes_come_from_differentiation_or_from_the_field():
    truth = tube().mesh
    x = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    field = MeshField(truth)
    distance, gradient = slope(field, x)
    plain, other = slope(lambda p: field(p), x)
    torch.testing.assert_close(distance, plain, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(gradient, other, atol=1e-3, rtol=1e-3)
    assert (gradient.norm(dim=1) - 1).abs().max() < 1e-4


def test_where_there_is_no_surface_there_is_no_mesh():
    mesh = mesh_udf(lambda x: x.square().sum(1).sqrt() + 1, BOX, Meshing(32))
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3)


@pytest.mark.parametrize("seed", range(3))
def test_rough_fields_still_give_manifolds(seed):
    """As half-learned networks are: steep and flat by turns, and never quite zero on the surface."""
    g = torch.Generator().manual_seed(seed)
    ways, phases = 25 * torch.randn(12, 3, generator=g), 6 * torch.rand(12, generator=g)
    exact = cylinder(0.15, 0.2)

    def rough(x):
        return (exact(x).square() + 0.004**2).sqrt() * (1 + 0.5 * (x @ ways.T + phases).sin().mean(1))

    mesh = mesh_udf(rough, BOX, Meshing(64, steepness=1.5, floor=0.006, beyond=0.4))
    assert len(mesh.faces) > 1000 and is_manifold(mesh.faces.numpy())
    assert border_loops(mesh.faces.numpy())
