"""Edge projection: a few rounds in which every edge draws its ends towards its own length, as a layer of a network.

Drapers say where cloth is vertex by vertex, from few numbers; what they miss is local, edges some per cent too long or
too short. A round moves each vertex by the mean of what its edges ask for (Provot 1995; position based dynamics, Müller
et al. 2007, with all edges at once), from the third round on with Chebyshev's momentum (Wang 2015), and then out of the
body, where planes beside it are given (:mod:`recon.cloth.beside`). It costs microseconds and lets gradients through, so
that networks can learn what the rounds do not do. It has no parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from recon.cloth.energies import Cloth

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

FACTOR, FAST = 1.5, 1.9
"""How much further than the mean a round goes, without and with momentum; from 2 on they would not settle."""
GAIN = 0.3
"""1 - GAIN / rounds is the convergence that Chebyshev's momentum counts on: with less of it 24 rounds leave no less
strain, with more some."""
LOOK = 8
"""Rounds between two looks at where the body is."""
OFFSET = 0.003
"""Distance above the planes that vertices are brought to [m]."""
LONGEST = 0.02
"""Most that a plane moves a vertex in one round [m]."""

Planes = tuple[Tensor, Tensor]
"""A point (B, V, 3) [m] and an outward normal (B, V, 3) for each vertex; no normal: no plane."""


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
        self.count, self.lengths, self.momentum = vertices, lengths, momentum(rounds)
        self.device = str(edges.device)
        degree = torch.bincount(edges.flatten(), minlength=vertices)
        share = 0.5 * (FAST if rounds > 2 else FACTOR) / degree.clamp_min(1)
        if held is not None:
            share[held] = 0
        ends = torch.cat([edges, edges.flip(1)])
        order = ends[:, 0].argsort(stable=True)
        self.edge_of_half = order % max(len(edges), 1)
        """(2 E,) edges, sorted by the vertex from which they are seen."""
        self.known = _Edges()
        self.known.first = self._array(torch.cat([degree.new_zeros(1), degree.cumsum(0)]), int)
        self.known.other = self._array((ends[:, 1] - ends[:, 0])[order], int)
        self.known.squares = self._array(lengths.detach().square()[self.edge_of_half], float)
        self.known.share = self._array(share, float)

    @classmethod
    def of(cls, cloth: Cloth, rounds: int, held: Tensor | None = None) -> EdgeProjection:
        """With the lengths of a cloth."""
        return cls(cloth.edges, cloth.edge_lengths, len(cloth.masses), rounds, held)

    def __call__(self, x: Tensor, beside: Callable[[Tensor], Planes] | None = None, look: int = LOOK) -> Tensor:
        """Drapes -> as many, computed in floats; differentiable (once) in them, the lengths and the planes' points.

        Args:
            x: (..., V, 3) [m]; B of them with ``beside``.
            beside: says the planes above which vertices (B, V, 3) should be, as often as it is asked.
            look: rounds between two times.
        """
        now = before = x.float().reshape(-1, self.count, 3)
        step = look if beside else max(len(self.momentum), 1)
        for k in range(0, len(self.momentum), step):
            planes = beside(now.detach()) if beside else (now.new_zeros(0, 0, 3),) * 2
            before, now = _Project.apply(before, now, self.lengths, *planes, self, self.momentum[k : k + step])
        return now.view(x.shape).to(x.dtype)

    def _array(self, values: Tensor, kind: type) -> wp.array:
        numbers = values.float() if kind is float else values.int()
        return wp.array(numbers.cpu().numpy(), dtype=kind, device=self.device)

    def launch(self, kernel: Any, drapes: int, arrays: list[wp.array], *numbers: float) -> None:
        """A kernel with one thread for each vertex of so many drapes."""
        given = [self.known, *arrays, drapes * self.count, *numbers]
        wp.launch(kernel, drapes * self.count, inputs=given, device=self.device)


def momentum(rounds: int) -> list[float]:
    """Chebyshev's weights: how far each round goes on from where the vertex was two rounds before; 1: no momentum."""
    found, square = list[float](), (1 - GAIN / max(rounds, 1)) ** 2
    for k in range(rounds):
        found.append(1.0 if k < 2 else 2 / (2 - square) if k == 2 else 4 / (4 - square * found[-1]))
    return found


def _points(tensor: Tensor) -> wp.array:
    """(..., 3) as one row of points."""
    return wp.from_torch(tensor.reshape(-1, 3), dtype=wp.vec3)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, before: Tensor, now: Tensor, lengths: Tensor, point: Tensor, normal: Tensor,
        edges: EdgeProjection, momentum: list[float],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        at = now.new_empty(len(momentum) + 2, *now.shape)
        at[0], at[1] = before, now
        arrays = [_points(point.detach()), _points(normal), _points(at)]
        for k, gain in enumerate(momentum):
            edges.launch(_draw, len(now), arrays, k, gain)
        ctx.edges, ctx.momentum = edges, momentum
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(at, point.detach(), normal)
        return at[-2].clone(), at[-1].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        edges: EdgeProjection = ctx.edges
        at, point, normal = ctx.saved_tensors
        found = torch.zeros_like(at)
        found[-2], found[-1] = grads
        slope = at.new_zeros(at.shape[1], len(edges.edge_of_half) if ctx.needs_input_grad[2] else 0)
        of_point = torch.zeros_like(point)
        arrays = [_points(t) for t in (point, normal, at, found, of_point)]
        for k, gain in reversed(list(enumerate(ctx.momentum))):
            edges.launch(_leave_back, at.shape[1], arrays, k, gain)
            edges.launch(_draw_back, at.shape[1], [*arrays[2:4], wp.from_torch(slope.view(-1))], k, gain)
        of_lengths = None
        if slope.numel():
            of_lengths = torch.zeros_like(edges.lengths)
            of_lengths.index_add_(0, edges.edge_of_half, slope.sum(0).to(of_lengths))
            of_lengths *= 2 * edges.lengths.detach()
        return found[0], found[1], of_lengths, of_point, None, None, None


@wp.struct
class _Edges:
    first: wp.array(dtype=int)
    other: wp.array(dtype=int)
    squares: wp.array(dtype=float)
    share: wp.array(dtype=float)


@wp.func
def _vertex(e: _Edges, t: int) -> int:
    # Of one drape, all threads are spared the division.
    i = int(t)
    if t >= e.share.shape[0]:
        i = t % e.share.shape[0]
    return i


@wp.func
def _drawn(e: _Edges, at: wp.array(dtype=wp.vec3), i: int, now: int, before: int, gain: float) -> wp.vec3:
    # (q - L²) / (q + L²) is 1 - L / l to the second order of the strain, has no root, and no pole where ends meet.
    x = at[now]
    asked = wp.vec3(0.0, 0.0, 0.0)
    for h in range(e.first[i], e.first[i + 1]):
        away = x - at[now + e.other[h]]
        q = wp.length_sq(away)
        asked += away * ((q - e.squares[h]) / wp.max(q + e.squares[h], 1.0e-20))
    return at[before] + gain * (x - e.share[i] * asked - at[before])


@wp.kernel
def _draw(
    e: _Edges,
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    at: wp.array(dtype=wp.vec3),
    all: int,
    k: int,
    gain: float,
):
    t = wp.tid()
    i = _vertex(e, t)
    now = (k + 1) * all + t
    x = at[now]
    if e.share[i] > 0.0:
        x = _drawn(e, at, i, now, now - all, gain)
        if normal.shape[0] > 0:
            n = normal[t]
            lack = OFFSET - wp.dot(x - point[t], n)
            if lack > 0.0 and wp.length_sq(n) > 0.5:
                x += n * wp.min(lack, LONGEST)
    at[now + all] = x


@wp.kernel
def _leave_back(
    e: _Edges,
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    at: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    of_point: wp.array(dtype=wp.vec3),
    all: int,
    k: int,
    gain: float,
):
    # What was brought to its plane is moved out or in by the plane alone.
    t = wp.tid()
    i = _vertex(e, t)
    if normal.shape[0] > 0 and e.share[i] > 0.0:
        now = (k + 1) * all + t
        n = normal[t]
        lack = OFFSET - wp.dot(_drawn(e, at, i, now, now - all, gain) - point[t], n)
        if lack > 0.0 and lack < LONGEST and wp.length_sq(n) > 0.5:
            out = n * wp.dot(n, grad[now + all])
            grad[now + all] = grad[now + all] - out
            of_point[t] = of_point[t] + out


@wp.kernel
def _draw_back(
    e: _Edges,
    at: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    slope: wp.array(dtype=float),
    all: int,
    k: int,
    gain: float,
):
    # What an edge asks for changes with its ends by the symmetric matrix r I + 4 L² / (q + L²)² a a^T.
    t = wp.tid()
    i = _vertex(e, t)
    now = (k + 1) * all + t
    x, own, share = at[now], grad[now + all], e.share[i]
    back = own
    if share > 0.0:
        grad[now - all] = grad[now - all] + (1.0 - gain) * own
        back = gain * own
    for h in range(e.first[i], e.first[i + 1]):
        j = now + e.other[h]
        away = x - at[j]
        q, square = wp.length_sq(away), e.squares[h]
        total = wp.max(q + square, 1.0e-20)
        differ = gain * (own * share - grad[j + all] * e.share[i + e.other[h]])
        back -= differ * ((q - square) / total) + away * (4.0 * square / (total * total) * wp.dot(away, differ))
        if slope.shape[0] > 0:
            place = (t - i) / e.share.shape[0] * e.other.shape[0] + h
            slope[place] = slope[place] + gain * share * wp.dot(away, own) * 2.0 * q / (total * total)
    grad[now] = grad[now] + back
