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
from recon.cloth.threads import launch

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

FACTOR, FAST = 1.5, 1.9
"""How much further than the mean a round goes, without and with momentum; from 2 on they would not settle."""
GAIN = 0.3
"""1 - GAIN / rounds is the convergence that Chebyshev's momentum counts on: with less of it 24 rounds leave no less
strain, with more some."""
LOOK = 12
"""Rounds between two looks at where the body is."""
OFFSET = 0.003
"""Distance above the planes that vertices are brought to [m]."""
LONGEST = 0.02
"""Most that a plane moves a vertex in one round [m]."""


def planes(point: Tensor, normal: Tensor, offset: float = OFFSET) -> Tensor:
    """Planes as rounds take them: (B, V, 4) normals, and the heights along them that vertices should be above [m].

    Args:
        point: (B, V, 3) on each plane [m]; differentiable in it.
        normal: (B, V, 3) outward, held; zero: no plane.
        offset: distance above the plane [m].
    """
    height = (normal * point).sum(-1, keepdim=True) + offset
    return torch.cat([normal, torch.where(normal.any(-1, keepdim=True), height, -1.0)], -1)


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
        squares = lengths.detach().square()[self.edge_of_half].clamp_min(1e-20)
        self.known = [
            self._array(torch.cat([degree.new_zeros(1), degree.cumsum(0)]), int),
            self._array((ends[:, 1] - ends[:, 0])[order], int),
            self._array(squares, float),
            self._array(share, float),
        ]

    @classmethod
    def of(cls, cloth: Cloth, rounds: int, held: Tensor | None = None) -> EdgeProjection:
        """With the lengths of a cloth."""
        return cls(cloth.edges, cloth.edge_lengths, len(cloth.masses), rounds, held)

    def __call__(self, x: Tensor, beside: Callable[[Tensor], Tensor] | None = None, look: int = LOOK) -> Tensor:
        """Drapes -> as many, computed in floats; differentiable (once) in them, the lengths and the planes' heights.

        Args:
            x: (..., V, 3) [m]; B of them with ``beside``.
            beside: says the :func:`planes` beside vertices (B, V, 3), as often as it is asked.
            look: rounds between two times.
        """
        now = before = x.float().reshape(-1, self.count, 3)
        step = look if beside else max(len(self.momentum), 1)
        for k in range(0, len(self.momentum), step):
            above = beside(now.detach()) if beside else now.new_zeros(0, 0, 4)
            before, now = _Project.apply(before, now, self.lengths, above, self, self.momentum[k : k + step])
        return now.view(x.shape).to(x.dtype)

    def _array(self, values: Tensor, kind: type) -> wp.array:
        numbers = values.float() if kind is float else values.int()
        return wp.array(numbers.cpu().numpy(), dtype=kind, device=self.device)

    def run(self, kernel: Any, drapes: int, arrays: list[wp.array], *numbers: float) -> None:
        """A kernel with one thread for each vertex of so many drapes."""
        given = [*self.known, *arrays, drapes * self.count, *numbers]
        launch(kernel, drapes * self.count, given, self.device)


def momentum(rounds: int) -> list[float]:
    """Chebyshev's weights: how far each round goes on from where the vertex was two rounds before; 1: no momentum."""
    found, square = list[float](), (1 - GAIN / max(rounds, 1)) ** 2
    for k in range(rounds):
        found.append(1.0 if k < 2 else 2 / (2 - square) if k == 2 else 4 / (4 - square * found[-1]))
    return found


def _row(tensor: Tensor, kind: Any = wp.vec3) -> wp.array:
    """(..., 3) as one row of points, or (..., 4) of planes."""
    return wp.from_torch(tensor.reshape(-1, tensor.shape[-1]), dtype=kind)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, before: Tensor, now: Tensor, lengths: Tensor, above: Tensor, edges: EdgeProjection,
        momentum: list[float],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        learning = any(ctx.needs_input_grad)
        slots = len(momentum) + 2 if learning else 3  # which stay in the cache
        at = now.new_empty(slots, *now.shape)
        at[0], at[1] = before, now
        arrays = [_row(above.detach(), wp.vec4), _row(at)]
        for k, gain in enumerate(momentum):
            edges.run(_draw, len(now), arrays, *((k + n) % slots for n in range(3)), gain)
        ctx.edges, ctx.momentum = edges, momentum
        if learning:
            ctx.save_for_backward(at, above.detach())
        return at[len(momentum) % slots].clone(), at[(len(momentum) + 1) % slots].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        edges: EdgeProjection = ctx.edges
        at, above = ctx.saved_tensors
        found = torch.zeros_like(at)
        found[-2], found[-1] = grads
        slope = at.new_zeros(at.shape[1], len(edges.edge_of_half) if ctx.needs_input_grad[2] else 0)
        of_planes = torch.zeros_like(above)
        moving, still = [_row(at), _row(found)], [_row(t, wp.vec4) for t in (above, of_planes)]
        for k, gain in reversed(list(enumerate(ctx.momentum))):
            if above.numel():
                edges.run(_leave_back, at.shape[1], [*still, *moving], k, gain)
            edges.run(_draw_back, at.shape[1], [*moving, wp.from_torch(slope.view(-1))], k, gain)
        of_lengths = None
        if slope.numel():
            of_lengths = torch.zeros_like(edges.lengths)
            of_lengths.index_add_(0, edges.edge_of_half, slope.sum(0).to(of_lengths))
            of_lengths *= 2 * edges.lengths.detach()
        return found[0], found[1], of_lengths, of_planes, None, None


# Edges are told one by one: as a struct, a round by itself took a third longer, or more.


@wp.func
def _vertex(t: int, count: int) -> int:
    # Of one drape, all threads are spared the division.
    i = int(t)
    if t >= count:
        i = t % count
    return i


@wp.func
def _drawn(
    first: wp.array(dtype=int),
    other: wp.array(dtype=int),
    squares: wp.array(dtype=float),
    share: float,
    at: wp.array(dtype=wp.vec3),
    i: int,
    now: int,
    before: int,
    gain: float,
) -> wp.vec3:
    # (q - L²) / (q + L²) is 1 - L / l to the second order of the strain, has no root, and no pole where ends meet.
    x = at[now]
    asked = wp.vec3(0.0, 0.0, 0.0)
    for h in range(first[i], first[i + 1]):
        away = x - at[now + other[h]]
        q = wp.length_sq(away)
        asked += away * ((q - squares[h]) / (q + squares[h]))
    return at[before] + gain * (x - share * asked - at[before])


@wp.kernel
def _draw(
    first: wp.array(dtype=int),
    other: wp.array(dtype=int),
    squares: wp.array(dtype=float),
    shares: wp.array(dtype=float),
    above: wp.array(dtype=wp.vec4),
    at: wp.array(dtype=wp.vec3),
    all: int,
    before: int,
    now: int,
    after: int,
    gain: float,
    start: int,
):
    # The last states lie in the slots before and now, the next one comes into after.
    t = start + wp.tid()
    i = _vertex(t, shares.shape[0])
    share = shares[i]
    x = at[now * all + t]
    if share > 0.0:
        x = _drawn(first, other, squares, share, at, i, now * all + t, before * all + t, gain)
        if above.shape[0] > 0:
            plane = above[t]
            normal = wp.vec3(plane[0], plane[1], plane[2])
            lack = plane[3] - wp.dot(x, normal)
            if lack > 0.0:
                x += normal * wp.min(lack, LONGEST)
    at[after * all + t] = x


@wp.kernel
def _leave_back(
    first: wp.array(dtype=int),
    other: wp.array(dtype=int),
    squares: wp.array(dtype=float),
    shares: wp.array(dtype=float),
    above: wp.array(dtype=wp.vec4),
    of_planes: wp.array(dtype=wp.vec4),
    at: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    all: int,
    k: int,
    gain: float,
    start: int,
):
    # What was brought to its plane is moved out or in by the plane alone.
    t = start + wp.tid()
    i = _vertex(t, shares.shape[0])
    share = shares[i]
    if share > 0.0:
        now = (k + 1) * all + t
        plane = above[t]
        normal = wp.vec3(plane[0], plane[1], plane[2])
        lack = plane[3] - wp.dot(_drawn(first, other, squares, share, at, i, now, now - all, gain), normal)
        if lack > 0.0 and lack < LONGEST:
            out = wp.dot(normal, grad[now + all])
            grad[now + all] = grad[now + all] - out * normal
            of_planes[t] = of_planes[t] + wp.vec4(0.0, 0.0, 0.0, out)


@wp.kernel
def _draw_back(
    first: wp.array(dtype=int),
    other: wp.array(dtype=int),
    squares: wp.array(dtype=float),
    shares: wp.array(dtype=float),
    at: wp.array(dtype=wp.vec3),
    grad: wp.array(dtype=wp.vec3),
    slope: wp.array(dtype=float),
    all: int,
    k: int,
    gain: float,
    start: int,
):
    # What an edge asks for changes with its ends by the symmetric matrix r I + 4 L² / (q + L²)² a a^T.
    t = start + wp.tid()
    i = _vertex(t, shares.shape[0])
    now = (k + 1) * all + t
    x, own, share = at[now], grad[now + all], shares[i]
    back = own
    if share > 0.0:
        grad[now - all] = grad[now - all] + (1.0 - gain) * own
        back = gain * own
    for h in range(first[i], first[i + 1]):
        j = now + other[h]
        away = x - at[j]
        q, square = wp.length_sq(away), squares[h]
        total = q + square
        differ = gain * (own * share - grad[j + all] * shares[i + other[h]])
        back -= differ * ((q - square) / total) + away * (4.0 * square / (total * total) * wp.dot(away, differ))
        if slope.shape[0] > 0:
            place = (t - i) / shares.shape[0] * other.shape[0] + h
            slope[place] = slope[place] + gain * share * wp.dot(away, own) * 2.0 * q / (total * total)
    grad[now] = grad[now] + back
