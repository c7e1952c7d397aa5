"""The fit of D_s' last layer to its own drapes, and of a layer in two."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from pipelines.drape_garments import Wardrobe
from pipelines.drape_training import BodySampler
from pipelines.isp_refit import Dressed, IspTeaching, _dressed, _fitted, _times
from pipelines.low_rank import low_rank
from recon.bodies import load_body
from recon.cloth.frames import FrameWeights
from recon.draping.isp import DisplacementNet, DisplacementShape, Worn
from recon.draping.skinning import SkinningDraper
from recon.draping.uv import Box, rest_features
from recon.types import PosedBody

SMALL = IspTeaching(bodies=4, steps=3, rounds=30)


@pytest.fixture(scope="module")
def body():
    return load_body()


@dataclass(frozen=True)
class Fit:
    """Two skirts, a network that has learned nothing, bodies, and the skirts draped on them."""

    net: DisplacementNet
    worn: list[Worn]
    posed: PosedBody
    dressed: list[Dressed]


@pytest.fixture(scope="module")
def fit(body) -> Fit:
    wardrobe = Wardrobe.decoded("skirt", 2, 300, body, FrameWeights(), SMALL.bodies, 0)
    garments = wardrobe.garments
    box = Box.around(torch.cat([g.panel_points for g in garments]))
    torch.manual_seed(0)
    net = DisplacementNet(DisplacementShape("skirt", (1, 2, 4, 5), body.n_shape, box, modes=50, rank=12, width=24))
    net.know(torch.stack([rest_features(g, box, net.shape.cells) for g in garments]))
    skinning = SkinningDraper(body)
    with torch.no_grad():
        worn = [Worn.of(g, net, skinning) for g in garments]
        posed = body.pose(BodySampler([], body.n_shape)(SMALL.bodies, torch.Generator().manual_seed(3)))
        basis = net.cosines(torch.eye(net.shape.modes)).flatten(1).T
        return Fit(net, worn, posed, [_dressed(net, w, (wardrobe, k), posed, SMALL, basis) for k, w in enumerate(worn)])


def start_of(net) -> torch.Tensor:
    weight = net.out.weight @ net.narrow.weight
    bias = net.out.bias + net.out.weight @ net.narrow.bias
    return net.shape.scale * torch.cat([weight.T, bias[None]]).detach()


def test_vertices_read_from_the_cosines_what_the_network_moves_them_by(fit) -> None:
    worn, dressed = fit.worn[0], fit.dressed[0]
    with torch.no_grad():
        wanted = worn.displaced(fit.net(fit.posed.transforms, fit.posed.shape, worn.code))
        found = _times(dressed.reads, dressed.states @ start_of(fit.net)).unflatten(1, (-1, 3))
    torch.testing.assert_close(found, wanted, atol=2e-5, rtol=1e-3)


def missed(dressed, c: torch.Tensor) -> float:
    """Squared distance from the drapes."""
    off = [_times(d.reads, d.states @ c).unflatten(1, (-1, 3)) - d.moved for d in dressed]
    return sum(float(o.square().sum()) for o in off)


def test_the_fit_is_nearer_to_the_drapes(fit) -> None:
    start, dressed = start_of(fit.net), fit.dressed
    few = [replace(d) for d in dressed]
    with torch.no_grad():
        found = _fitted(start, few, replace(SMALL, pushes=0))
    assert missed(dressed, found) < 0.5 * missed(dressed, start)
    for d, again in zip(dressed, few, strict=True):
        torch.testing.assert_close(again.states, d.states, atol=1e-3, rtol=1e-3)  # unwhitened at the end


def test_pushes_bring_vertices_out(fit) -> None:
    deep = [replace(d, gap=d.gap - 0.01, moved=d.moved - 0.01 * d.normal) for d in fit.dressed]

    def inside(c: torch.Tensor) -> float:
        found = [_times(d.reads, d.states @ c).unflatten(1, (-1, 3)) for d in deep]
        return sum(float((d.gap + (d.normal * (x - d.moved)).sum(-1) < 0).sum()) for d, x in zip(deep, found))

    with torch.no_grad():
        near = _fitted(start_of(fit.net), [replace(d) for d in deep], replace(SMALL, pushes=0))
        out = _fitted(start_of(fit.net), [replace(d) for d in deep], SMALL)
    assert inside(out) < 0.5 * inside(near)


def test_a_layer_in_two_is_the_layer_where_states_are_few() -> None:
    torch.manual_seed(0)
    layer, states = torch.nn.Linear(9, 20), torch.randn(50, 3) @ torch.randn(3, 9) + 1
    with torch.no_grad():
        few, out = low_rank(layer, states, 3, lambda moved: moved)
        torch.testing.assert_close(out(few(states)), layer(states), atol=1e-4, rtol=1e-4)
        few, out = low_rank(layer, states, 1, lambda moved: moved)
        assert float((out(few(states)) - layer(states)).norm()) > 0.1
