"""Edge projection: lengths come nearer, gradients are those of the same rounds written in torch, nothing is NaN."""

from __future__ import annotations

import pytest
import torch
from sheets import sheet
from torch import Tensor

from recon.cloth import threads
from recon.cloth.edges import FACTOR, FAST, LONGEST, LOOK, OFFSET, EdgeProjection, momentum, planes
from recon.cloth.energies import Cloth
from recon.types import Mesh

SHEET = sheet(6, 4, 0.3, 0.2)
CLOTH = Cloth.from_garment(SHEET)
HELD = torch.tensor([0, 4])
ROUNDS = LOOK + 3


def twin(x: Tensor, lengths: Tensor, rounds: int, held: Tensor, on: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """The rounds as plain sums over edges."""
    one, other = CLOTH.edges.unbind(1)
    share = 0.5 * (FAST if rounds > 2 else FACTOR) / torch.bincount(CLOTH.edges.flatten(), minlength=x.shape[1]).to(x)
    share[held] = 0
    free = (share > 0).to(x)[:, None]
    before = x
    for gain in momentum(rounds):
        away = x[:, one] - x[:, other]
        q, square = away.square().sum(-1, keepdim=True), lengths.square()[:, None]
        ask = away * (q - square) / (q + square)
        moved = torch.zeros_like(x).index_add(1, one, ask).index_add(1, other, -ask)
        after = before + gain * (x - share[:, None] * moved - before)
        if on is not None:
            point, normal = on
            lack = OFFSET - ((after - point) * normal).sum(-1, keepdim=True)
            after = after + normal * lack.clamp(0, LONGEST)
        before, x = x, torch.where(free > 0, after, x)
    return x


def crumpled(scale: float) -> Tensor:
    flat = SHEET.mesh.vertices.float()
    return flat + scale * torch.randn(3, *flat.shape, generator=torch.Generator().manual_seed(0))


def strain(x: Tensor) -> Tensor:
    one, other = CLOTH.edges.unbind(1)
    return ((x[:, one] - x[:, other]).norm(dim=-1) / CLOTH.edge_lengths - 1).abs().mean(1)


def floor(x: Tensor) -> tuple[Tensor, Tensor]:
    """A plane that cuts through the sheet, beneath every other vertex."""
    normal = torch.nn.functional.normalize(torch.tensor([0.1, 0.2, 1.0]), dim=0).expand_as(x).clone()
    normal[:, ::2] = 0
    return torch.tensor([0.15, 0.1, 0.0]).expand_as(x).clone().requires_grad_(), normal


@pytest.mark.parametrize("held", [torch.zeros(0, dtype=torch.long), HELD], ids=["free", "held"])
@pytest.mark.parametrize("rounds", [1, 2, 3, ROUNDS])
def test_values_and_gradients_are_the_twins(held: Tensor, rounds: int) -> None:
    x, way, lengths = crumpled(0.005).requires_grad_(), crumpled(1.0), CLOTH.edge_lengths.clone().requires_grad_()
    y = EdgeProjection(CLOTH.edges, lengths, x.shape[1], rounds, held)(x)
    found = torch.autograd.grad((y * way).sum(), [x, lengths])
    precise = [t.detach().double().requires_grad_() for t in (x, lengths)]
    wanted = twin(precise[0], precise[1], rounds, held)
    slopes = torch.autograd.grad((wanted * way.double()).sum(), precise)
    assert (y - wanted).abs().max() < 2e-6
    for own, slope in zip(found, slopes, strict=True):
        assert (own - slope).abs().max() < 1e-3 * slope.abs().max()
    assert torch.equal(y[:, held], x[:, held])


def test_planes_hold_vertices_up_and_take_their_gradients() -> None:
    x, way, lengths = crumpled(0.005).requires_grad_(), crumpled(1.0), CLOTH.edge_lengths
    point, normal = floor(x.detach())
    y = EdgeProjection(CLOTH.edges, lengths, x.shape[1], ROUNDS, HELD)(x, lambda _: planes(point, normal))
    found = torch.autograd.grad((y * way).sum(), [x, point])
    precise = [t.detach().double().requires_grad_() for t in (x, point)]
    wanted = twin(precise[0], lengths.double(), ROUNDS, HELD, (precise[1], normal.double()))
    slopes = torch.autograd.grad((wanted * way.double()).sum(), precise)
    assert (y - wanted).abs().max() < 2e-6
    for own, slope in zip(found, slopes, strict=True):
        assert slope.abs().max() > 0.1
        assert (own - slope).abs().max() < 1e-3 * slope.abs().max()
    free = torch.ones(x.shape[1], dtype=torch.bool)
    free[HELD] = False
    above = ((y - point) * normal).sum(-1)[:, free & (normal[0].norm(dim=-1) > 0)]
    assert above.min() > OFFSET - 1e-6


def test_lengths_come_nearer_with_each_round_and_right_ones_stay() -> None:
    strains = torch.stack([strain(EdgeProjection.of(CLOTH, n)(crumpled(0.004))) for n in (0, 2, 4, 16)])
    assert (strains[1:] < 0.75 * strains[:-1]).all()
    flat = SHEET.mesh.vertices.float()[None]
    assert (EdgeProjection.of(CLOTH, 4)(flat) - flat).abs().max() < 1e-6


def test_momentum_reaches_further_than_as_many_plain_rounds() -> None:
    stretched = (SHEET.mesh.vertices.float() * torch.tensor([1.1, 1.0, 1.0]))[None]
    layer, plain = EdgeProjection.of(CLOTH, 24), EdgeProjection.of(CLOTH, 24)
    plain.momentum = [1.0] * 24
    assert strain(layer(stretched)) < 0.5 * strain(plain(stretched))


def test_threads_change_nothing(monkeypatch) -> None:
    x, way = crumpled(0.005), crumpled(1.0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    found = []
    for worth in (10**9, 10):
        monkeypatch.setattr(threads, "WORTH", worth)
        lengths, at = CLOTH.edge_lengths.clone().requires_grad_(), x.clone().requires_grad_()
        point, normal = floor(x)
        layer = EdgeProjection(CLOTH.edges, lengths, x.shape[1], ROUNDS, HELD)
        y = layer(at, lambda _, p=point, n=normal: planes(p, n))
        found.append([y, *torch.autograd.grad((y * way).sum(), [at, lengths, point])])
    for one, several in zip(*found, strict=True):
        assert torch.equal(one, several)


def test_doubles_come_back_as_doubles() -> None:
    x = crumpled(0.004).double().requires_grad_()
    y = EdgeProjection.of(CLOTH, 2)(x)
    y.sum().backward()
    assert y.dtype == torch.float64 and x.grad is not None and x.grad.dtype == torch.float64
    torch.testing.assert_close(y.float(), EdgeProjection.of(CLOTH, 2)(x.detach().float()))


def test_a_stretched_triangle_shrinks_as_computed_by_hand() -> None:
    corners = torch.tensor([[1.0, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])
    cloth = Cloth.from_mesh(Mesh(corners, torch.tensor([[0, 1, 2]])))
    y = EdgeProjection.of(cloth, 1)(1.1 * corners[None])
    ratio = (1.1**2 - 1) / (1.1**2 + 1)
    torch.testing.assert_close(y[0], 1.1 * (1 - 0.75 * FACTOR * ratio) * corners, atol=1e-6, rtol=0)


def test_ends_in_one_place_give_no_nan() -> None:
    x = torch.zeros(1, len(SHEET.mesh.vertices), 3, requires_grad=True)
    y = EdgeProjection.of(CLOTH, 5)(x)
    y.square().sum().backward()
    assert y.isfinite().all() and x.grad is not None and x.grad.isfinite().all()
