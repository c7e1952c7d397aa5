"""Smoothed coordinates: a round trip, and a gradient that equals finite differences."""

import torch

from recon.cloth.smooth import SmoothCoordinates

FACES = torch.tensor([[0, 1, 2], [1, 3, 2], [2, 3, 4]])


def test_round_trip():
    x = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    coordinates = SmoothCoordinates(FACES, 5)
    torch.testing.assert_close(coordinates.decode(coordinates.encode(x)), x)


def test_translation_is_kept_and_a_spike_is_spread():
    coordinates = SmoothCoordinates(FACES, 5, stiffness=5.0)
    torch.testing.assert_close(coordinates.encode(torch.ones(5, 1)), torch.ones(5, 1))
    spike = torch.zeros(5, 1)
    spike[0] = 1
    moved = coordinates.decode(spike)
    assert (moved > 0).all() and moved.max() < 0.6


def test_gradient():
    coordinates = SmoothCoordinates(FACES, 5)
    u = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: coordinates.decode(v).sin().sum(), (u,))
