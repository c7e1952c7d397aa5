"""Functions read between lattice nodes: exact for what is linear, second order for what is smooth, differentiable."""

from __future__ import annotations

import pytest
import torch

from recon.draping.nodes import Nodes

X = 0.4 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - torch.tensor([0.1, -1.0, 0.3])


def made(width: float) -> Nodes:
    nodes = Nodes.around(X, width, most=9.0)
    assert nodes is not None
    return nodes


def test_linear_functions_are_met_and_shares_sum_to_one():
    nodes = made(0.03)
    assert torch.allclose(nodes.shares.sum(1), torch.ones(len(X)), atol=1e-5)
    assert torch.allclose(nodes(nodes.at), X, atol=1e-5)


def test_smooth_functions_are_met_to_second_order():
    def wave(x):
        return (8 * x).sin().sum(1, keepdim=True)

    coarse, fine = ((made(w)(wave(made(w).at)) - wave(X)).abs().max() for w in (0.04, 0.02))
    assert coarse < 3 * 64 * 0.04**2 / 8 * 1.01
    assert fine < 0.35 * coarse


def test_gradients_reach_the_values_and_agree_with_what_is_read_without():
    nodes = made(0.05)
    values = torch.randn(len(nodes.at), 2, requires_grad=True)
    out = nodes(values)
    with torch.no_grad():
        assert torch.allclose(nodes(values), out, atol=1e-5)
    out.sum().backward()
    assert values.grad is not None
    assert values.grad.sum().item() == pytest.approx(2 * len(X), rel=1e-4)


def test_where_points_are_few_or_no_numbers_there_are_none():
    assert Nodes.around(X, 0.001) is None
    assert Nodes.around(torch.full((4, 3), torch.nan), 0.1) is None
    assert Nodes.around(torch.tensor([[0.0, 0, 0], [1e3, 1e3, 1e3]]), 0.01) is None
    assert Nodes.around(torch.zeros(0, 3), 0.01) is None
