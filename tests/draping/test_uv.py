"""Maps over the panels' plane: cosines, welding, and what rest maps say about a garment."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from recon.draping.uv import (
    Box,
    Welding,
    around,
    compose,
    levels,
    map_size,
    modes,
    point_areas,
    rest_features,
    splat,
)
from recon.types import Garment

BOX = Box((-0.6, 0.0), (0.6, 0.8))


def test_modes_are_smoothest_first_and_orthogonal() -> None:
    which = modes(BOX, 30)
    frequency = (which / torch.tensor(BOX.size)).norm(dim=1)
    assert which.shape == (30, 2) and which[0].tolist() == [0, 0] and (frequency.diff() > -1e-6).all()
    maps = compose(BOX, which, torch.eye(30))
    assert maps.shape == (30, *map_size(BOX))
    edge = [torch.ones(n).index_fill(0, torch.tensor([0, n - 1]), 0.5) for n in maps.shape[1:]]
    share = (edge[0][:, None] * edge[1]).flatten() / ((maps.shape[1] - 1) * (maps.shape[2] - 1))
    gram = (maps.flatten(1) * share) @ maps.flatten(1).T
    level = gram.diagonal()
    torch.testing.assert_close(gram, level.diag(), atol=1e-4, rtol=0)
    torch.testing.assert_close(level.sqrt() * torch.where(which > 0, 2**0.5, 1.0).prod(1), levels(BOX, which))
    assert level[0] == pytest.approx(1.0) and (level[1:] < 1).all() and level[-1] < 0.7 * level[1]


def test_points_between_nodes_read_what_lies_there() -> None:
    nx, ny = map_size(BOX)
    plane = torch.stack([torch.linspace(-0.6, 0.6, nx)[:, None].expand(nx, ny) * k for k in (1, -2)])
    points = torch.tensor([[0.123, 0.4], [-0.31, 0.79], [0.6, 0.0]])
    rows, shares = around(BOX, (nx, ny), points, torch.tensor([0, 1, 0]))
    torch.testing.assert_close((plane.flatten()[rows] * shares).sum(1), torch.tensor([0.123, 0.62, 0.6]))


def test_box_is_symmetric_and_holds_all_points() -> None:
    box = Box.around(torch.tensor([[0.1, 0.2], [-0.4, 0.9]]), 0.05)
    assert box.low == pytest.approx((-0.45, 0.15)) and box.high == pytest.approx((0.45, 0.95))
    assert box.unit(torch.tensor([[-9.0, 0.55]])).tolist() == [[0.0, pytest.approx(0.5)]]


def test_welding_takes_the_mean_at_seams(flat_shirt) -> None:
    garment = flat_shirt(0.05)
    welding = Welding.of(garment)
    at_points = garment.mesh.vertices[garment.vertex_of_point]
    torch.testing.assert_close(welding(at_points), garment.mesh.vertices)
    panel = garment.side_of_point
    share = welding(panel[:, None].float())[:, 0]
    assert set(share.unique().tolist()) == {0.0, 0.5, 1.0}  # front, seams, back


def test_splat_keeps_sums_and_first_moments() -> None:
    g = torch.Generator().manual_seed(0)
    points = torch.rand(50, 2, generator=g) * torch.tensor([1.2, 0.8]) + torch.tensor([-0.6, 0.0])
    panel, values = torch.randint(2, (50,), generator=g), torch.rand(50, 1, generator=g)
    found = splat(BOX, (7, 5), points, panel, values)[..., 0]
    nodes = torch.linspace(-0.6, 0.6, 7)[:, None].expand(7, 5)
    for k in (0, 1):
        mine = panel == k
        assert float(found[k].sum()) == pytest.approx(float(values[mine].sum()), rel=1e-4)
        assert float((found[k] * nodes).sum()) == pytest.approx(
            float((values[mine, 0] * points[mine, 0]).sum()), rel=1e-3
        )


def features(garment: Garment) -> torch.Tensor:
    return rest_features(garment, Box((-0.41, -0.13), (0.43, 0.87)), (12, 12))


def test_rest_features_know_the_garment_and_not_its_mesh(flat_shirt) -> None:
    coarse, fine, other = (
        features(flat_shirt(step, open_)) for step, open_ in ((0.02, False), (0.01, False), (0.02, True))
    )
    assert coarse.shape == (2 * 12 * 12 * 4,)
    assert float((coarse - fine).norm()) < 0.15 * float((coarse - other).norm())


def test_areas_of_points_sum_to_the_panels(flat_shirt) -> None:
    assert float(point_areas(flat_shirt(0.05)).sum()) == pytest.approx(0.8, rel=1e-4)


def test_rest_features_have_gradients(flat_shirt) -> None:
    garment = flat_shirt(0.1)
    x = garment.mesh.vertices.double().requires_grad_()
    points = garment.panel_points.double().requires_grad_()

    def read(x, points):
        made = replace(garment, mesh=garment.mesh.with_vertices(x), panel_points=points)
        return (features(made) * weights).sum()

    weights = torch.randn(2 * 12 * 12 * 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.autograd.gradcheck(read, (x, points), eps=1e-7, atol=1e-5, fast_mode=True)
