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


def quickly(net: nn.Sequential, x: Tensor, fine: bool = True) -> Tensor:
    """An ``mlp`` at (N, C) points without gradient, its inner layers in half precision where that is faster.

    ``fine``: the last one in full; else in halves too.
    """
    first, *inner, last = (layer for layer in net if isinstance(layer, nn.Linear))
    halves = torch.bfloat16 if halves_are_fast(x.device) and x.dtype == torch.float32 else x.dtype
    hidden = [(layer.weight.to(halves), layer.bias.to(halves)) for layer in inner]
    out = x.new_empty(len(x), last.out_features)
    for rows, part in zip(out.split(CHUNK), x.split(CHUNK), strict=True):
        h = F.silu(first(part), inplace=True).to(halves)
        for k, (weight, bias) in enumerate(hidden, 1):
            h = F.linear(h, weight, bias)
            h = F.silu(h.to(x.dtype) if fine and k == len(hidden) else h, inplace=True)
        if fine:
            torch.addmm(last.bias, h.to(x.dtype), last.weight.T, out=rows)
        else:
            rows.copy_(F.linear(h, last.weight.to(halves), last.bias.to(halves)))
    return out


def silent(net: nn.Module, *inputs: Tensor) -> bool:
    """Whether nobody asks for gradients through a network."""
    return not torch.is_grad_enabled() or not any(t.requires_grad for t in (*inputs, *net.parameters()))
