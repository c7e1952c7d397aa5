"""Small fully connected networks of points in space, and how they are asked quickly."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.garments.isp_net import CHUNK, halves_are_fast


def waves(x: Tensor, octaves: int) -> Tensor:
    """(N, 3) points [m] -> (N, 3 + 6 octaves): themselves and sines and cosines of half a turn a metre and up."""
    scale = torch.pi * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    angle = (x[:, None] * scale[:, None]).flatten(1)
    return torch.cat([x, angle.sin(), angle.cos()], 1)


def mlp(inputs: int, width: int, depth: int, outputs: int, last: float = 1.0) -> nn.Sequential:
    """``depth`` SiLU layers and a linear one, whose weights start ``last`` times as large as usual."""
    layers: list[nn.Module] = []
    for k in range(depth):
        layers += [nn.Linear(inputs if k == 0 else width, width), nn.SiLU()]
    out = nn.Linear(width, outputs)
    with torch.no_grad():
        out.weight.mul_(last)
        out.bias.zero_()
    return nn.Sequential(*layers, out)


Linear = tuple[Tensor, Tensor]
"""Weight (out, in) and bias (out,) of a layer."""


def layers_of(net: nn.Sequential) -> list[Linear]:
    """The linear layers of an ``mlp``."""
    return [(layer.weight, layer.bias) for layer in net if isinstance(layer, nn.Linear)]


def with_known(layer: Linear, known: Tensor) -> Linear:
    """A layer whose last inputs are the same (K,) at every point, those folded into its bias."""
    weight, bias = layer
    free = weight.shape[1] - len(known)
    return weight[:, :free], torch.addmv(bias, weight[:, free:], known)


def quickly(net: nn.Sequential | list[Linear], x: Tensor, fine: bool = True) -> Tensor:
    """An ``mlp``, or its layers, at (N, C) points without gradient, inner layers in halves where that is faster.

    ``fine``: the last one in full; else in halves too.
    """
    (first, shift), *inner, (last, add) = layers_of(net) if isinstance(net, nn.Sequential) else net
    halves = torch.bfloat16 if halves_are_fast(x.device, vectors=True) and x.dtype == torch.float32 else x.dtype
    hidden = [(weight.to(halves), bias.to(halves)) for weight, bias in inner]
    out = x.new_empty(len(x), len(add))
    for rows, part in zip(out.split(CHUNK), x.split(CHUNK), strict=True):
        h = F.silu(F.linear(part, first, shift), inplace=True).to(halves)
        for k, (weight, bias) in enumerate(hidden, 1):
            h = F.linear(h, weight, bias)
            h = F.silu(h.to(x.dtype) if fine and k == len(hidden) else h, inplace=True)
        if fine:
            torch.addmm(add, h.to(x.dtype), last.T, out=rows)
        else:
            rows.copy_(F.linear(h, last.to(halves), add.to(halves)))
    return out


def silent(net: nn.Module, *inputs: Tensor) -> bool:
    """Whether nobody asks for gradients through a network."""
    return not torch.is_grad_enabled() or not any(t.requires_grad for t in (*inputs, *net.parameters()))
