"""Edge projection: a few rounds in which every edge draws its ends towards its own length, as a layer of a network.

Drapers say where cloth is vertex by vertex, from few numbers; what they miss is local, edges some per cent too long or
too short. A round moves each vertex by the mean of what its edges ask for (Provot 1995; position based dynamics, Müller
et al. 2007, with all edges at once): it costs microseconds, looks at nothing but the cloth, and lets gradients through,
so that networks learn what the rounds do not do. It has no parameters.
"""

from __future__ import annotations

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
        share = 0.5 * FACTOR / torch.bincount(edges.flatten(), minlength=vertices).clamp_min(1)
        if held is not None:
            share[held] = 0
        self.known = _Edges()
        self.known.ends = wp.array(edges.int().cpu().numpy(), dtype=wp.vec2i, device=self.device)
        self.known.lengths = self._floats(lengths.detach())
        self.known.share = self._floats(share)

    @classmethod
    def of(cls, cloth: Cloth, rounds: int, held: Tensor | None = None) -> EdgeProjection:
        """With the lengths of a cloth."""
        return cls(cloth.edges, cloth.edge_lengths, len(cloth.masses), rounds, held)

    def __call__(self, x: Tensor) -> Tensor:
        """Drapes (..., V, 3) [m] -> as many, computed in floats; differentiable in them and the lengths (once)."""
        return _Project.apply(x, self.lengths, self) if self.rounds else x

    def _floats(self, tensor: Tensor) -> wp.array:
        return wp.array(tensor.float().cpu().numpy(), dtype=float, device=self.device)

    def launch(self, kernel: Any, drapes: int, *tensors: Tensor) -> None:
        """A kernel with one thread for each of so many drapes."""
        views = [wp.from_torch(t, dtype=wp.vec3 if t.dim() == 4 else None) for t in tensors]
        wp.launch(kernel, drapes, inputs=[self.known, *views], device=self.device)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, lengths: Tensor, edges: EdgeProjection) -> Tensor:
        start = x.detach().float().reshape(-1, edges.count, 3)
        at = start.new_empty(edges.rounds + 1, *start.shape)
        at[0] = start
        edges.launch(_draw, len(start), at)
        ctx.edges = edges
        if x.requires_grad or lengths.requires_grad:
            ctx.save_for_backward(at)
        return at[-1].view(x.shape).to(x.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor | None, None]:
        edges: EdgeProjection = ctx.edges
        (at,) = ctx.saved_tensors
        found = torch.empty_like(at)
        found[-1] = grads[0].reshape(at[-1].shape)
        slope = at.new_zeros(at.shape[1], len(edges.lengths) if ctx.needs_input_grad[1] else 0)
        edges.launch(_draw_back, at.shape[1], at, found, slope)
        of_x = found[0].view(grads[0].shape).to(grads[0].dtype)
        return of_x, slope.sum(0).to(edges.lengths) if slope.numel() else None, None


@wp.struct
class _Edges:
    ends: wp.array(dtype=wp.vec2i)
    lengths: wp.array(dtype=float)
    share: wp.array(dtype=float)


@wp.kernel
def _draw(e: _Edges, at: wp.array3d(dtype=wp.vec3)):
    # A drape is one thread: edges share vertices.
    b = wp.tid()
    for r in range(at.shape[0] - 1):
        x, y = at[r, b], at[r + 1, b]
        for i in range(x.shape[0]):
            y[i] = x[i]
        for k in range(e.lengths.shape[0]):
            i = e.ends[k][0]
            j = e.ends[k][1]
            away = x[i] - x[j]
            now = wp.length(away)
            if now > 1.0e-9:
                ask = away * (1.0 - e.lengths[k] / now)
                y[i] = y[i] - ask * e.share[i]
                y[j] = y[j] + ask * e.share[j]


@wp.kernel
def _draw_back(
    e: _Edges, at: wp.array3d(dtype=wp.vec3), grad: wp.array3d(dtype=wp.vec3), slope: wp.array2d(dtype=float)
):
    # What an edge asks for changes with its ends by a symmetric matrix: (1 - L/l) I + (L/l) d d^T, d its direction.
    b = wp.tid()
    for back in range(at.shape[0] - 1):
        r = at.shape[0] - 2 - back
        x, y, g = at[r, b], grad[r + 1, b], grad[r, b]
        for i in range(x.shape[0]):
            g[i] = y[i]
        for k in range(e.lengths.shape[0]):
            i = e.ends[k][0]
            j = e.ends[k][1]
            away = x[i] - x[j]
            now = wp.length(away)
            if now > 1.0e-9:
                ratio = e.lengths[k] / now
                differ = y[i] * e.share[i] - y[j] * e.share[j]
                along = wp.dot(away, differ) / now
                change = differ * (1.0 - ratio) + away * (along * ratio / now)
                g[i] = g[i] - change
                g[j] = g[j] + change
                if slope.shape[1] > 0:
                    slope[b, k] = slope[b, k] + along
