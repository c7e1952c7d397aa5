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
import torch.nn.functional as F
import warp as wp
from torch import Tensor

from recon.cloth.energies import Cloth
from recon.cloth.threads import Launch

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
LANES = 8
"""Vertices that a kernel computes side by side, as many as a CPU's registers hold floats: a third to a half of the time
that one after the other takes."""

Lanes = wp.types.vector(LANES, float)
Places = wp.types.vector(LANES, int)
Tile = wp.types.matrix((3, LANES), float)
"""Points side by side: their x, their y, their z."""


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
        self.groups = -(-vertices // LANES)
        self.device = str(edges.device)
        degree = torch.bincount(edges.flatten(), minlength=LANES * self.groups)
        share = 0.5 * (FAST if rounds > 2 else FACTOR) / degree.clamp_min(1)
        if held is not None:
            share[held] = 0
        ends = torch.cat([edges, edges.flip(1)])
        order = ends[:, 0].argsort(stable=True)
        own, other = ends[order].unbind(1)
        rows = degree.view(-1, LANES).amax(1)
        first = F.pad(rows.cumsum(0), (1, 0))
        self.rows = int(first[-1])
        """R: what a group's vertices ask for lies in as many rows as one of them has edges at most."""
        self.edge_of_half = order % max(len(edges), 1)
        """(2 E,) edges, sorted by the vertex from which they are seen."""
        vertex = torch.arange(len(degree), device=edges.device)
        group, lane = vertex // LANES, vertex % LANES
        spot = 3 * LANES * group + lane  # of a vertex' x among the numbers of a drape's tiles
        shift = LANES * (first[group] - degree.cumsum(0) + degree) + lane
        self.place_of_half = LANES * torch.arange(len(own), device=edges.device) + shift[own]
        """(2 E,) where each lies in the rows; what is left of them draws a vertex to itself, that is nowhere."""
        places = spot.view(-1, LANES).repeat_interleave(rows, 0).flatten()
        squares = torch.ones_like(places, dtype=torch.float32)
        places[self.place_of_half] = spot[other]
        squares[self.place_of_half] = lengths.detach().square()[self.edge_of_half].float().clamp_min(1e-20)
        self.known = [
            self._array(first, int),
            self._array(places.view(-1, LANES), Places),
            self._array(squares.view(-1, LANES), Lanes),
            self._array(share.float().view(-1, LANES), Lanes),
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
        now = before = self._tiles(x.float().reshape(-1, self.count, 3))
        step = look if beside else max(len(self.momentum), 1)
        for k in range(0, len(self.momentum), step):
            on = self._planes(now.detach(), beside)
            before, now = _Project.apply(before, now, self.lengths, *on, self, self.momentum[k : k + step])
        return self._points(now).reshape(x.shape).to(x.dtype)

    def _planes(self, now: Tensor, beside: Callable[[Tensor], Tensor] | None) -> tuple[Tensor, Tensor]:
        """Normals (B, G, 3, LANES) and heights (B, G, 1, LANES) of what ``beside`` says; zeros: no planes."""
        if beside is None:
            return torch.zeros_like(now), torch.zeros_like(now[:, :, :1])
        above = beside(self._points(now))
        return self._tiles(above[..., :3].detach()), self._tiles(above[..., 3:])

    def launch(self, kernel: Any, drapes: int, arrays: list[wp.array]) -> Launch:
        """A kernel on so many drapes, one of its points for each group of their vertices."""
        given = [*self.known, *arrays, drapes * self.groups]
        return Launch(kernel, drapes * self.groups, given, self.device, LANES)

    def _array(self, values: Tensor, kind: Any) -> wp.array:
        numbers = values if values.is_floating_point() else values.int()
        return wp.array(numbers.cpu().numpy(), dtype=kind, device=self.device)

    def _tiles(self, values: Tensor) -> Tensor:
        """(B, V, C) -> (B, G, C, LANES), group by group side by side."""
        filled = F.pad(values, (0, 0, 0, LANES * self.groups - self.count))
        return filled.unflatten(1, (self.groups, LANES)).transpose(2, 3).contiguous()

    def _points(self, tiles: Tensor) -> Tensor:
        """And back."""
        return tiles.transpose(2, 3).flatten(1, 2)[:, : self.count]


def momentum(rounds: int) -> list[float]:
    """Chebyshev's weights: how far each round goes on from where the vertex was two rounds before; 1: no momentum."""
    found, square = list[float](), (1 - GAIN / max(rounds, 1)) ** 2
    for k in range(rounds):
        found.append(1.0 if k < 2 else 2 / (2 - square) if k == 2 else 4 / (4 - square * found[-1]))
    return found


def _array(tensor: Tensor, kind: Any) -> wp.array:
    """(..., 3, LANES) as a row of tiles, (..., LANES) of lanes, or of single numbers."""
    shape = {Tile: (-1, 3, LANES), Lanes: (-1, LANES), wp.float32: (-1,)}[kind]
    return wp.from_torch(tensor.view(shape), dtype=kind)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, before: Tensor, now: Tensor, lengths: Tensor, normals: Tensor, heights: Tensor,
        edges: EdgeProjection, momentum: list[float],
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        learning = any(ctx.needs_input_grad)
        slots = len(momentum) + 2 if learning else 2  # which stay in the cache
        at = now.new_empty(slots, *now.shape)
        at[0], at[1] = before, now
        on = [_array(normals, Tile), _array(heights.detach(), Lanes)]
        draw = edges.launch(_draw, len(now), [*on, _array(at, Tile), _array(at, wp.float32)])
        for k, gain in enumerate(momentum):
            draw(*((k + n) % slots for n in range(3)), gain)
        last, end = (at[(len(momentum) + n) % slots] for n in range(2))
        if not learning:
            return last, end
        ctx.edges, ctx.momentum = edges, momentum
        ctx.save_for_backward(at, normals, heights.detach())
        return last.clone(), end.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        edges: EdgeProjection = ctx.edges
        at, normals, heights = ctx.saved_tensors
        found, pulls = torch.zeros_like(at), torch.empty_like(normals)
        found[-2], found[-1] = grads
        of_heights = torch.zeros_like(heights)
        slope = at.new_zeros(at.shape[1], edges.rows if ctx.needs_input_grad[2] else 0, LANES)
        on = [_array(t, Lanes) for t in (heights, of_heights)]
        moving = [_array(at, Tile), _array(at, wp.float32), _array(found, Tile), _array(pulls, Tile)]
        leave = edges.launch(_leave_back, at.shape[1], [_array(normals, Tile), *on, *moving])
        draw = edges.launch(_draw_back, at.shape[1], [*moving, _array(pulls, wp.float32), _array(slope, Lanes)])
        for k, gain in reversed(list(enumerate(ctx.momentum))):
            leave(k, gain)
            draw(k, gain)
        of_lengths = None
        if slope.numel():
            of_lengths = torch.zeros_like(edges.lengths)
            of_halves = slope.sum(0).flatten()[edges.place_of_half]
            of_lengths.index_add_(0, edges.edge_of_half, of_halves.to(of_lengths))
            of_lengths *= 2 * edges.lengths.detach()
        return found[0], found[1], of_lengths, None, of_heights, None, None


# Edges are told one by one: as a struct, a round by itself took a third longer, or more.


@wp.func
def _gathered(at: wp.array(dtype=float), base: int, places: Places) -> Tile:
    out = Tile()
    for lane in range(LANES):
        for k in range(3):
            out[k, lane] = at[base + places[lane] + LANES * k]
    return out


@wp.func
def _dot(one: Tile, other: Tile) -> Lanes:
    return wp.vec3(1.0, 1.0, 1.0) @ wp.cw_mul(one, other)


@wp.func
def _scaled(factors: Lanes, points: Tile) -> Tile:
    return wp.cw_mul(wp.outer(wp.vec3(1.0, 1.0, 1.0), factors), points)


@wp.func
def _drawn(
    first: wp.array(dtype=int),
    other: wp.array(dtype=Places),
    squares: wp.array(dtype=Lanes),
    share: Lanes,
    at: wp.array(dtype=Tile),
    numbers: wp.array(dtype=float),
    g: int,
    now: int,
    before: int,
    gain: float,
) -> Tile:
    # (q - L²) / (q + L²) is 1 - L / l to the second order of the strain, has no root, and no pole where ends meet.
    x = at[now]
    asked = Tile()
    for h in range(first[g], first[g + 1]):
        away = x - _gathered(numbers, (now - g) * 3 * LANES, other[h])
        q = _dot(away, away)
        asked += _scaled(wp.cw_div(q - squares[h], q + squares[h]), away)
    return at[before] + gain * (x - _scaled(share, asked) - at[before])


@wp.kernel
def _draw(
    first: wp.array(dtype=int),
    other: wp.array(dtype=Places),
    squares: wp.array(dtype=Lanes),
    shares: wp.array(dtype=Lanes),
    normals: wp.array(dtype=Tile),
    heights: wp.array(dtype=Lanes),
    at: wp.array(dtype=Tile),
    numbers: wp.array(dtype=float),
    all: int,
    before: int,
    now: int,
    after: int,
    gain: float,
    start: int,
):
    # The last states lie in the slots before and now, the next one comes into after, which may be before. What is held
    # stays: it was in one place before and now, nothing draws it, and planes are kept from it.
    t = start + wp.tid()
    g = t % shares.shape[0]
    share = shares[g]
    x = _drawn(first, other, squares, share, at, numbers, g, now * all + t, before * all + t, gain)
    push = heights[t] - _dot(x, normals[t])
    for lane in range(LANES):
        push[lane] = wp.where(share[lane] > 0.0, wp.clamp(push[lane], 0.0, LONGEST), 0.0)
    at[after * all + t] = x + _scaled(push, normals[t])


@wp.kernel
def _leave_back(
    first: wp.array(dtype=int),
    other: wp.array(dtype=Places),
    squares: wp.array(dtype=Lanes),
    shares: wp.array(dtype=Lanes),
    normals: wp.array(dtype=Tile),
    heights: wp.array(dtype=Lanes),
    of_heights: wp.array(dtype=Lanes),
    at: wp.array(dtype=Tile),
    numbers: wp.array(dtype=float),
    grad: wp.array(dtype=Tile),
    pulls: wp.array(dtype=Tile),
    all: int,
    k: int,
    gain: float,
    start: int,
):
    # What was brought to its plane is moved out or in by the plane alone.
    t = start + wp.tid()
    g = t % shares.shape[0]
    now = (k + 1) * all + t
    share, own = shares[g], grad[now + all]
    lack = heights[t] - _dot(_drawn(first, other, squares, share, at, numbers, g, now, now - all, gain), normals[t])
    out = _dot(normals[t], own)
    for lane in range(LANES):
        out[lane] = wp.where(share[lane] > 0.0 and lack[lane] > 0.0 and lack[lane] < LONGEST, out[lane], 0.0)
    of_heights[t] = of_heights[t] + out
    left = own - _scaled(out, normals[t])
    grad[now + all] = left
    pulls[t] = _scaled(share, left)


@wp.kernel
def _draw_back(
    first: wp.array(dtype=int),
    other: wp.array(dtype=Places),
    squares: wp.array(dtype=Lanes),
    shares: wp.array(dtype=Lanes),
    at: wp.array(dtype=Tile),
    numbers: wp.array(dtype=float),
    grad: wp.array(dtype=Tile),
    pulls: wp.array(dtype=Tile),
    pull_numbers: wp.array(dtype=float),
    slope: wp.array(dtype=Lanes),
    all: int,
    k: int,
    gain: float,
    start: int,
):
    # What an edge asks for changes with its ends by the symmetric matrix r I + 4 L² / (q + L²)² a a^T.
    t = start + wp.tid()
    g = t % shares.shape[0]
    now = (k + 1) * all + t
    x, pull = at[now], gain * pulls[t]
    back = gain * grad[now + all]
    grad[now - all] = grad[now - all] + (1.0 - gain) * grad[now + all]
    for h in range(first[g], first[g + 1]):
        away = x - _gathered(numbers, (now - g) * 3 * LANES, other[h])
        differ = pull - gain * _gathered(pull_numbers, (t - g) * 3 * LANES, other[h])
        q, square = _dot(away, away), squares[h]
        total = q + square
        steep = wp.cw_div(2.0 * _dot(away, differ), wp.cw_mul(total, total))
        back -= _scaled(wp.cw_div(q - square, total), differ) + _scaled(2.0 * wp.cw_mul(square, steep), away)
        if slope.shape[0] > 0:
            place = t / shares.shape[0] * other.shape[0] + h
            steep = wp.cw_div(2.0 * _dot(away, pull), wp.cw_mul(total, total))
            slope[place] = slope[place] + wp.cw_mul(q, steep)
    grad[now] = grad[now] + back
