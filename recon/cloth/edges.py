"""Edge projection: a few rounds in which every edge draws its ends towards its own length, as a layer of a network.

Drapers say where cloth is vertex by vertex, from few numbers; what they miss is local, edges some per cent too long or
too short. A round moves each vertex by the mean of what its edges ask for (Provot 1995; position based dynamics, Müller
et al. 2007, with all edges at once): it costs microseconds, looks at nothing but the cloth, and lets gradients through,
so that networks learn what the rounds do not do. It has no parameters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from recon.cloth.energies import Cloth

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

FACTOR = 1.5
"""How much further than the mean a round goes: the fewest rounds; from 2 on they would not settle."""


class EdgeProjection:
    """The rounds for one garment; reusable for any number of drapes."""

    def __init__(self, cloth: Cloth, rounds: int, held: Tensor | None = None):
        """``held``: (H,) vertices that stay, a waistband's."""
        self.rounds, self.count = rounds, len(cloth.masses)
        self.device = str(cloth.masses.device)
        one, other = np.concatenate([e := cloth.edges.cpu().numpy(), e[:, ::-1]]).T
        order = np.argsort(one, kind="stable")
        length = np.tile(cloth.edge_lengths.cpu().numpy(), 2)[order]
        degree = np.bincount(one, minlength=self.count)
        share = 0.5 * FACTOR / np.maximum(degree, 1)
        if held is not None:
            share[np.asarray(held)] = 0
        starts = np.concatenate([[0], np.cumsum(degree)])

        def whole(a: NDArray) -> wp.array:
            return wp.array(a.astype(np.int32), dtype=int, device=self.device)

        def real(a: NDArray) -> wp.array:
            return wp.array(a.astype(np.float32), dtype=float, device=self.device)

        self.starts, self.ends = whole(starts), whole(other[order])
        self.lengths, self.share = real(length), real(share)

    def __call__(self, x: Tensor) -> Tensor:
        """Drapes (..., V, 3) float32 [m] -> as many, differentiable in x (once)."""
        return _Project.apply(x, self) if self.rounds else x

    def round(self, kernel: Any, out: Tensor, *inputs: Tensor) -> Tensor:
        """One round of a kernel from (B, V, 3) to ``out``, like them."""
        tensors = [wp.from_torch(t.view(-1, 3), dtype=wp.vec3) for t in (*inputs, out)]
        known = [self.starts, self.ends, self.lengths, self.share]
        wp.launch(kernel, (len(out), self.count), inputs=[*known, *tensors], device=self.device)
        return out


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, edges: EdgeProjection) -> Tensor:
        at = [x.detach().reshape(-1, edges.count, 3).contiguous()]
        for _ in range(edges.rounds):
            at.append(edges.round(_draw, torch.empty_like(at[0]), at[-1]))
        ctx.edges = edges
        if x.requires_grad:
            ctx.save_for_backward(*at[:-1])
        return at[-1].view(x.shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (grad,) = grads
        found = grad.reshape(-1, ctx.edges.count, 3).contiguous()
        for x in reversed(ctx.saved_tensors):
            found = ctx.edges.round(_draw_back, torch.empty_like(found), x, found)
        return found.view(grad.shape), None


@wp.kernel
def _draw(
    starts: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    lengths: wp.array(dtype=float),
    share: wp.array(dtype=float),
    x: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    b, i = wp.tid()
    first = b * share.shape[0]
    p = x[first + i]
    move = wp.vec3()
    for k in range(starts[i], starts[i + 1]):
        away = p - x[first + ends[k]]
        now = wp.length(away)
        if now > 1.0e-9:
            move += away * (1.0 - lengths[k] / now)
    out[first + i] = p - move * share[i]


@wp.kernel
def _draw_back(
    starts: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    lengths: wp.array(dtype=float),
    share: wp.array(dtype=float),
    x: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    # What an edge asks for changes with its ends by a symmetric matrix: (1 - L/l) I + (L/l) d d^T, d its direction.
    b, i = wp.tid()
    first = b * share.shape[0]
    p = x[first + i]
    own = grad[first + i]
    total = own
    for k in range(starts[i], starts[i + 1]):
        j = ends[k]
        away = p - x[first + j]
        now = wp.length(away)
        if now > 1.0e-9:
            ratio = lengths[k] / now
            differ = own * share[i] - grad[first + j] * share[j]
            along = away * (wp.dot(away, differ) / (now * now))
            total = total - differ * (1.0 - ratio) - along * ratio
    out[first + i] = total
