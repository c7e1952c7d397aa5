"""The last layer of a network as two, the first of few units: its states fill few directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from recon.cloth.energies import Cloth
from recon.draping.gaps import GapsNet
from recon.types import Mesh

SAME = 1e-8
"""Directions in which states vary less than this, by the largest variance, are none."""
PLACE = 0.3
"""Moving by this counts as much as edges that change by their length, where drapes are left out [m]."""


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


@torch.no_grad()
def narrowed(net: GapsNet, states: Tensor, rest: Mesh, rank: int) -> GapsNet:
    """The nearest network whose last layer mixes ``rank`` drapes, near in edges by their length and in places.

    Lengths count because a tenth of a millimetre is nothing for a place, but not for an edge of a fine mesh.

    Args:
        net: without a basis and few drapes, of V vertices.
        states: (N, W) that it has on motions.
        rest: the garment (V, 3).
        rank: drapes, at most W.
    """
    cloth = Cloth.from_mesh(rest)
    few, out = low_rank(net.out, states, rank, lambda moved: _counted(moved.unflatten(0, (-1, 3)), cloth))
    found = GapsNet(replace(net.shape, rank=few.out_features))
    found.gru.load_state_dict(net.gru.state_dict())
    found.few.load_state_dict(few.state_dict())
    found.out.load_state_dict(out.state_dict())
    return found


def _counted(moved: Tensor, cloth: Cloth) -> Tensor:
    """Displacements (V, 3, N) -> (3 E + 3 V, N), whose squares add up."""
    one, other = cloth.edges.unbind(1)
    length = cloth.edge_lengths.to(moved).clamp_min(1e-9) * len(one) ** 0.5
    edges = (moved[one] - moved[other]) / length[:, None, None]
    return torch.cat([edges.flatten(0, 1), moved.flatten(0, 1) / (PLACE * len(moved) ** 0.5)])
