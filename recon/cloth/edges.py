"""Edge projection: a few rounds in which every edge draws its ends towards its own length, as a layer of a network.

Drapers say where cloth is vertex by vertex, from few numbers; what they miss is local, edges some per cent too long or
too short. A round moves each vertex by the mean of what its edges ask for (Provot 1995; position based dynamics, Müller
et al. 2007, with all edges at once): it costs microseconds, looks at nothing but the cloth, and lets gradients through,
so that networks learn what the rounds do not do. It has no parameters.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
import warp as wp
from torch import Tensor

from recon.cloth.energies import Cloth

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

FACTOR = 1.5
"""How much further than the mean a round goes: the fewest rounds; from 2 on they would not settle."""


class EdgeProjection:
    """The rounds for one garment; reusable for any number of drapes."""

    def __init__(self, edges: Tensor, lengths: Tensor, vertices: int, rounds: int, held: Tensor | None = None):
        """
        Args:
            edges: (E, 2) each once.
            lengths: (E,) of each at rest [m]; with a gradient, drapes are differentiable in them, too.
            vertices: V.
            rounds: how many.
            held: (H,) vertices that stay, a waistband's.
        """
        self.rounds, self.count, self.lengths = rounds, vertices, lengths
        self.device = str(edges.device)
        one, other = torch.cat([edges, edges.flip(1)]).unbind(1)
        order = torch.argsort(one, stable=True)
        self.edge = order % max(len(edges), 1)
        degree = torch.bincount(one, minlength=vertices)
        share = 0.5 * FACTOR / degree.clamp_min(1)
        if held is not None:
            share[held] = 0
        starts = torch.cat([degree.new_zeros(1), degree.cumsum(0)])
        self.known = [*(self._kept(t.int(), int) for t in (starts, other[order])), self._kept(share.float(), float)]

    @classmethod
    def of(cls, cloth: Cloth, rounds: int, held: Tensor | None = None) -> EdgeProjection:
        """With the lengths of a cloth."""
        return cls(cloth.edges, cloth.edge_lengths, len(cloth.masses), rounds, held)

    def __call__(self, x: Tensor) -> Tensor:
        """Drapes (..., V, 3) float32 [m] -> as many; differentiable in them and the lengths (once)."""
        return _Project.apply(x, self.lengths, self) if self.rounds else x

    @cached_property
    def halves(self) -> wp.array:
        """(2 E,) the lengths as the kernels read them."""
        return self._kept(self.lengths.detach()[self.edge].float(), float)

    def _kept(self, tensor: Tensor, kind: type) -> wp.array:
        return wp.array(tensor.cpu().numpy(), dtype=kind, device=self.device)

    def round(self, kernel: Any, *tensors: Tensor) -> None:
        """One round of a kernel on (B, V, 3) each."""
        views = [wp.from_torch(t.view(-1, 3), dtype=wp.vec3) for t in tensors]
        wp.launch(kernel, (len(tensors[0]), self.count), inputs=[*self.known, self.halves, *views], device=self.device)

    def lengths_slope(self, x: Tensor, grad: Tensor) -> Tensor:
        """(E,) what one round from ``x`` adds to the lengths' gradient; ``grad`` is that of what it led to."""
        out = x.new_zeros(len(self.edge))
        for one, g in zip(x, grad, strict=True):
            at = [wp.from_torch(t, dtype=wp.vec3) for t in (one, g)]
            inputs = [*self.known, *at, wp.from_torch(out)]
            wp.launch(_lengths_back, self.count, inputs=inputs, device=self.device)
        return torch.zeros_like(self.lengths).index_add(0, self.edge, out.to(self.lengths))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, lengths: Tensor, edges: EdgeProjection) -> Tensor:
        at = [x.detach().reshape(-1, edges.count, 3).contiguous()]
        for _ in range(edges.rounds):
            at.append(torch.empty_like(at[0]))
            edges.round(_draw, *at[-2:])
        ctx.edges = edges
        if x.requires_grad or lengths.requires_grad:
            ctx.save_for_backward(*at[:-1])
        return at[-1].view(x.shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor | None, None]:
        edges: EdgeProjection = ctx.edges
        found = grads[0].reshape(-1, edges.count, 3).contiguous()
        slope = torch.zeros_like(edges.lengths) if ctx.needs_input_grad[1] else None
        for x in reversed(ctx.saved_tensors):
            if slope is not None:
                slope = slope + edges.lengths_slope(x, found)
            found, before = torch.empty_like(found), found
            edges.round(_draw_back, x, before, found)
        return found.view(grads[0].shape), slope, None


@wp.kernel
def _draw(
    starts: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    share: wp.array(dtype=float),
    lengths: wp.array(dtype=float),
    x: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    b, i = wp.tid()  # type: ignore[misc]
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
    share: wp.array(dtype=float),
    lengths: wp.array(dtype=float),
    x: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.vec3),
):
    # What an edge asks for changes with its ends by a symmetric matrix: (1 - L/l) I + (L/l) d d^T, d its direction.
    b, i = wp.tid()  # type: ignore[misc]
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


@wp.kernel
def _lengths_back(
    starts: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    share: wp.array(dtype=float),
    x: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=float),
):
    i = wp.tid()
    for k in range(starts[i], starts[i + 1]):
        away = x[i] - x[ends[k]]
        now = wp.length(away)
        if now > 1.0e-9:
            out[k] = out[k] + wp.dot(grad[i], away) * (share[i] / now)
