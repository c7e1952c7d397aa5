"""The last layer of a network as two, the first of few units: its states fill few directions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

SAME = 1e-8
"""Directions in which states vary less than this, by the largest variance, are none."""


@torch.no_grad()
def low_rank(
    layer: nn.Linear, states: Tensor, rank: int, counted: Callable[[Tensor], Tensor]
) -> tuple[nn.Linear, nn.Linear]:
    """Layers ``few`` (W -> r) and ``out`` (r -> O) of least E |A (layer(s) - out(few(s)))|^2.

    These are the principal directions of A W s, the mean kept.

    Args:
        layer: W -> O.
        states: (N, W) that the network has.
        rank: r, at most W.
        counted: columns (O, K) -> (M, K), A times them: what of an output counts.
    """
    mean = states.double().mean(0)
    variance, axes = torch.linalg.eigh(torch.cov(states.double().T))
    kept = variance > SAME * variance[-1]
    moved = layer.weight.double() @ (axes[:, kept] * variance[kept].sqrt())
    seen = counted(moved)
    directions = torch.linalg.eigh(seen.T @ seen)[1].flip(1)[:, :rank]
    mix = (axes[:, kept] / variance[kept].sqrt() @ directions).T
    few, out = nn.Linear(len(mean), len(mix)), nn.Linear(len(mix), layer.out_features)
    few.weight.copy_(mix)
    few.bias.copy_(-mix @ mean)
    out.weight.copy_(moved @ directions)
    out.bias.copy_(layer.bias + layer.weight.double() @ mean)
    return few, out
