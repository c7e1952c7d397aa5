"""The rasteriser against rays through the same triangles, and the silhouettes' pieces against what is known of them."""

from __future__ import annotations

import math

import pytest
import torch
from render_shapes import ball, front_camera, sheet, tube
from torch import Tensor

from recon.render.edges import lines_of, topology
from recon.render.jumps import jumps
from recon.render.raster import Raster
from recon.render.rays import scene_on
from recon.render.view import view_of
from recon.types import Camera, Mesh

SIZE = (48, 64)


def homogeneous(meshes: list[Mesh], camera: Camera) -> Tensor:
    return view_of(camera, SIZE).points(torch.cat([mesh.vertices for mesh in meshes]))


def raster_of(meshes: list[Mesh], camera: Camera) -> Raster:
    first = [sum(len(m.vertices) for m in meshes[:i]) for i in range(len(meshes))]
    faces = torch.cat([mesh.faces + at for mesh, at in zip(meshes, first)]).int()
    values = torch.cat([torch.full((len(mesh.faces),), i + 1) for i, mesh in enumerate(meshes)]).int()
    return Raster(homogeneous(meshes, camera), faces, values)


def test_sees_what_rays_see() -> None:
    meshes, camera = [ball(), tube(), sheet(1.2, 0.3, 5)], front_camera()
    raster = raster_of(meshes, camera)
    coverage = raster.coverage(SIZE, 3, 3)
    view, scene = view_of(camera, SIZE), scene_on(torch.device("cpu"))
    scene.set(view.traced(raster.points), raster.faces)
    seen = scene.values(view.grid(3), raster.values).reshape(9, *SIZE)
    rays = torch.stack([(seen == k + 1).float().mean(0) for k in range(3)])
    assert (rays.sum((1, 2)) > 20).all()  # all three are seen
    assert float((coverage - rays).abs().sum()) < 0.5  # a few samples lie within a rounding error of an edge


def test_order_of_faces_does_not_matter() -> None:
    raster = raster_of([ball(), tube(), tube()], front_camera())  # the last two coincide
    order = torch.randperm(len(raster.faces), generator=torch.Generator().manual_seed(0))
    other = Raster(raster.points, raster.faces[order], raster.values[order])
    assert torch.equal(raster.coverage(SIZE, 2, 3), other.coverage(SIZE, 2, 3))
    assert float(raster.coverage(SIZE, 2, 3)[2].sum()) == 0.0  # ties go to the smaller value


def test_triangle_that_reaches_behind_the_camera() -> None:
    """A floor from before to behind the camera: its horizon is the image of its far border, however it is cut."""
    floor = Mesh(
        torch.tensor([[-9.0, -0.5, 3], [9, -0.5, 3], [9, -0.5, 9], [-9, -0.5, 9]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    )
    camera = front_camera(4.0)
    covered = raster_of([floor], camera).coverage(SIZE, 1, 1)[0]
    wide = view_of(camera, SIZE).points(torch.tensor([[0.0, -0.5, 3]]))[0]
    first_row = round(float(wide[1] / wide[2]) + SIZE[0] / 2)
    expected = torch.zeros(SIZE)
    expected[first_row:] = 1
    assert torch.equal(covered, expected)


def test_probes_tell_the_sides_of_an_edge() -> None:
    meshes, camera = [sheet(1.0)], front_camera()
    raster = raster_of(meshes, camera)
    half = float(raster.points[:, 0].max() / raster.points[0, 2])
    height = torch.linspace(-0.9, 0.9, 301, dtype=torch.float64) * float(
        raster.points[:, 1].max() / raster.points[0, 2]
    )
    at = torch.stack([torch.full_like(height, half), height], 1)
    right, left = raster.seen_beside(at, torch.tensor([[1e-5, 0.0]], dtype=torch.float64).expand(301, 2), SIZE)
    assert (right == 0).all() and (left == 1).all()


def test_nothing_to_see() -> None:
    empty = Raster(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, dtype=torch.int32))
    assert float(empty.coverage(SIZE, 2, 2).sum()) == 0.0
    none = torch.zeros(0, 2, dtype=torch.float64)
    assert [len(side) for side in empty.seen_beside(none, none, SIZE)] == [0, 0]


@pytest.mark.parametrize("step", [0.3, 1.0])
def test_pieces_make_up_the_outline(step: float) -> None:
    """A square before nothing: its pieces' sweeps add up to its outline's, each in its pixel, inside on one side."""
    mesh, camera = sheet(1.0), front_camera()
    raster, top = raster_of([mesh], camera), topology(mesh.faces)
    points = raster.points.double()
    lines = lines_of(points, top.edges[top.always], SIZE)
    found = jumps(raster, lines, SIZE, step)
    assert bool(((found.ahead == 1) ^ (found.behind == 1)).all())
    side = float(points[:, 0].max() - points[:, 0].min()) / float(points[0, 2])
    tall = float(points[:, 1].max() - points[:, 1].min()) / float(points[0, 2])
    grown = torch.where(found.behind == 1, 1.0, -1.0)  # area gained when the line moves along its normal
    motion = torch.zeros(len(points), 3, dtype=torch.float64)
    motion.index_add_(0, found.vertices.reshape(-1), (grown[:, None, None] * found.motion).reshape(-1, 3))
    centre = points[:, :2] / points[:, 2:]
    scaled = (motion[:, :2] * centre * points[:, 2:]).sum()  # growth about the image's centre: d area / d log scale
    assert math.isclose(float(scaled), 2 * side * tall, rel_tol=1e-3)


def test_pieces_end_where_something_hides_the_line() -> None:
    """A beam across the middle of a square hides as much of its border as it is wide."""
    square, camera = sheet(1.0), front_camera()
    beam = Mesh(sheet(1.0, 0.2).vertices * torch.tensor([3.0, 0.203, 1.0]), sheet().faces)
    raster, top = raster_of([square, beam], camera), topology(square.faces)
    points = raster.points.double()
    lines = lines_of(points, top.edges[top.always], SIZE)
    found = jumps(raster, lines, SIZE, 0.5)
    length = (
        found.motion.sum(1)[:, :2].norm(dim=1) * float(points[0, 2])
    ).sum()  # both vertices' shares add up to 1 / z
    whole = lines.length.sum()
    hidden = 2 * float(points[len(square.vertices) :, 1].max() - points[len(square.vertices) :, 1].min())
    hidden = hidden / float(points[-1, 2])
    assert math.isclose(float(length), float(whole) - hidden, abs_tol=0.25)  # 4 ends, each to 1/16 px
