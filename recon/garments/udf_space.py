"""The space that distance fields live in: what is left and right of the middle plane is moved apart.

Two surfaces closer than a field's own resolution grow together in it: hems of wide trousers, which all but touch
between the legs. A strip about x = 0 is stretched, by twenty in the middle and by less towards its sides; beyond it
space is only shifted. The map is one-to-one and smooth, so that a skirt, which crosses the plane, stays whole.
"""

from __future__ import annotations

import torch
from torch import Tensor

STEEPEST = 0.05
"""How far a step of 1 in the spread space leads in the world, in the middle plane; 1 from the strip's sides on."""


def spread(points: Tensor, apart: float) -> Tensor:
    """(..., 3) [m] -> (..., 3) with both sides moved away from x = 0 by ``apart`` [m], as a whole beyond the strip.

    In the strip x = x' (r + (1 - r)² |x'| / (4 apart)), a parabola with slope r = ``STEEPEST`` in the middle and 1 at
    |x'| = 2 apart / (1 - r). Differentiable; 0: nothing moves.
    """
    if not apart:
        return points
    x, ratio = points[..., :1], STEEPEST
    inside = 2 * x / (ratio + (ratio**2 + (1 - ratio) ** 2 * x.abs() / apart).sqrt())
    side = apart * (1 + ratio) / (1 - ratio)
    return torch.cat([torch.where(x.abs() < side, inside, x + apart * x.sign()), points[..., 1:]], -1)


def gathered(points: Tensor, apart: float) -> Tensor:
    """(..., 3) of the spread space -> (..., 3) [m]: the inverse of :func:`spread`."""
    if not apart:
        return points
    x, ratio = points[..., :1], STEEPEST
    inside = x * (ratio + (1 - ratio) ** 2 * x.abs() / (4 * apart))
    side = 2 * apart / (1 - ratio)
    return torch.cat([torch.where(x.abs() < side, inside, x - apart * x.sign()), points[..., 1:]], -1)
