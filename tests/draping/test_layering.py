"""Layering: forces in closed form, maps there and back, and Algorithm 1 on tubes."""

from __future__ import annotations

import pytest
import torch

from recon.bodies.rig import rotation_matrices
from recon.cloth.beneath import REACH, Beneath, repulsion, vertex_normals
from recon.cloth.contact import BodyContact
from recon.draping.layering import CHANNELS, Layering, LayeringNet, Raster, frames_of, inputs_of
from recon.files.weights import write_weights
from recon.metrics import beneath_pct, inside_pct
from recon.types import Mesh, UserError


@pytest.fixture
def shirt(flat_shirt):
    return flat_shirt(0.04)


def grown(garment, by: float) -> Mesh:
    """A batch of one: the flat shirt's two panels drawn apart, each by so much [m]."""
    x = garment.mesh.vertices.clone()
    x[:, 2] += by * torch.sign(x[:, 2])
    return Mesh(x[None], garment.mesh.faces)


def beneath(mesh: Mesh) -> Beneath:
    return Beneath.of(mesh.vertices[0], mesh.faces)


def inner_points(garment) -> torch.Tensor:
    """Vertices well inside the front panel."""
    x, y, z = garment.mesh.vertices.unbind(1)
    return (x.abs() < 0.15) & (y > 0.9) & (y < 1.2) & (z > 0)


def test_force_is_depth_and_margin(shirt) -> None:
    outer, inner = grown(shirt, 0.0), grown(shirt, 0.01)
    force = repulsion(outer.vertices, outer.faces, [beneath(inner)], 0.004)[0]
    mine = inner_points(shirt)
    torch.testing.assert_close(
        force[mine], torch.tensor([0.0, 0.0, 0.014]).expand(int(mine.sum()), 3), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("apart", [-0.005, -(REACH + 0.01)])
def test_no_force_above_or_out_of_reach(shirt, apart: float) -> None:
    inner = grown(shirt, apart if apart > -REACH else 0.0)
    outer = grown(shirt, 0.0 if apart > -REACH else -apart)
    assert not repulsion(outer.vertices, outer.faces, [beneath(inner)], 0.004)[0][inner_points(shirt)].any()


def test_no_force_beyond_an_open_border_or_between_opposite_sides(shirt) -> None:
    inner = grown(shirt, 0.01)
    low = Mesh(inner.vertices - torch.tensor([0.0, 0.3, 0.0]), inner.faces)
    outer = grown(shirt, 0.0)
    x, y, _ = shirt.mesh.vertices.unbind(1)
    above = (x.abs() < 0.05) & (y > 1.11) & (y < 1.14)  # in the lower one's neck
    assert above.any()
    assert not repulsion(outer.vertices, outer.faces, [beneath(low)])[0][above].any()
    turned = Mesh(inner.vertices, inner.faces.flip(1))
    assert not repulsion(outer.vertices, outer.faces, [beneath(turned)])[0].any()


def test_maps_go_there_and_back(shirt) -> None:
    raster = Raster.of(shirt)
    maps = raster.maps(shirt.mesh.vertices[None])
    assert maps.shape[:3] == (1, 2, 3) and all(n % 16 == 0 for n in maps.shape[3:])
    back = raster.read(maps)[0]
    assert float((back - shirt.mesh.vertices).norm(dim=1).max()) < 0.01
    assert float((back - shirt.mesh.vertices).norm(dim=1).median()) < 1e-3


def test_frames_are_rotations_that_point_outward(shirt) -> None:
    raster = Raster.of(shirt)
    inside = raster.image(raster.inside[None])[0]
    *_, frames = frames_of(raster.maps(shirt.mesh.vertices[None]), inside)
    there = inside[:, 0] > 0
    axes = frames[0].permute(0, 3, 4, 1, 2)[there]
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand(len(axes), 3, 3), atol=1e-4, rtol=0)
    normals = raster.maps(vertex_normals(shirt.mesh.vertices, shirt.mesh.faces)[None])[0].permute(0, 2, 3, 1)[there]
    agree = (axes[:, 2] * normals).sum(1)
    assert float(agree.median()) > 0.95 and float(agree.min()) > 0


def test_what_the_network_reads_does_not_turn_with_the_person(shirt) -> None:
    raster, g = Raster.of(shirt), torch.Generator().manual_seed(0)
    x = shirt.mesh.vertices[None] + 0.003 * torch.randn(1, *shirt.mesh.vertices.shape, generator=g)
    force = 0.01 * torch.randn(x.shape, generator=g)
    turn = rotation_matrices(torch.tensor([0.4, -0.8, 0.3]))
    first, _ = inputs_of(raster, x, force)
    second, _ = inputs_of(raster, x @ turn.T + 0.5, force @ turn.T)
    assert first.shape[1] == CHANNELS
    torch.testing.assert_close(first, second, atol=2e-3, rtol=0)


def test_an_untrained_network_adds_nothing_and_learns(shirt) -> None:
    raster, x = Raster.of(shirt), shirt.mesh.vertices[None]
    net, force = LayeringNet(), torch.full_like(x, 0.01)
    moved, own = net.displaced(raster, x, force)
    assert not own.any() and torch.equal(moved, x + force)
    moved.square().sum().backward()
    assert net.out.weight.grad is not None and float(net.out.weight.grad.abs().max()) > 0


def test_algorithm_1_leaves_nothing_beneath(shirt) -> None:
    inner, middle, outer = (grown(shirt, by) for by in (0.012, 0.004, 0.0))
    wanted = Layering(None)([shirt] * 3, [inner, middle, outer])
    assert wanted[0] is inner
    for i, j in ((0, 1), (0, 2), (1, 2)):
        lower, upper = (Mesh(wanted[k].vertices[0], wanted[k].faces) for k in (i, j))
        before = grown(shirt, (0.012, 0.004)[i]), grown(shirt, (0.0, 0.004, 0.0)[j])
        below = beneath_pct(Mesh(before[1].vertices[0], shirt.mesh.faces), beneath(before[0]))
        assert below > 60
        assert beneath_pct(upper, beneath(Mesh(lower.vertices[None], lower.faces))) < 0.1 * below


def test_meshes_without_panels_are_moved_by_forces(shirt) -> None:
    layers = [grown(shirt, 0.01), grown(shirt, 0.0)]
    bare = [m.with_vertices(m.vertices[0]) for m in layers]
    moved = Layering(LayeringNet())(bare, layers)
    assert float((moved[1].vertices - layers[1].vertices).norm(dim=-1).max()) > 0.01


def test_share_inside_a_body_is_that_of_the_area() -> None:
    corners = torch.tensor([[-1.0, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [0, 0, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    body = BodyContact(corners, faces)
    inside = torch.tensor([[0.0, 0, -0.9], [0.1, 0, -0.9], [0, 0.1, -0.9]])
    cloth = Mesh(torch.cat([inside, inside * 2 + torch.tensor([0.0, 0, 3.5])]), torch.tensor([[0, 1, 2], [3, 4, 5]]))
    assert inside_pct(cloth, body) == pytest.approx(100 / 5, rel=1e-3)


def test_weights_of_something_else_are_told(tmp_path) -> None:
    from recon.draping.layering import load_layering

    with pytest.raises(UserError, match="layers-isp"):
        load_layering(tmp_path)
    write_weights("layers-isp", {"first.weight": torch.zeros(3)}, {"shape": {"channels": [8] * 5}}, tmp_path)
    with pytest.raises(UserError, match="layering network"):
        load_layering(tmp_path)
