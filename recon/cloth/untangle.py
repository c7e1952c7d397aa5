"""Untangle: draped layers in, layers out that pass neither through each other, nor themselves, nor the body.

Rounds of small moves until an exact test finds nothing:

- vertices and face centres inside the body go out of it (``escape``);
- between layers the order is known: a vertex of the outer one on the wrong side of the inner one's faces goes back to
  its own side, and what is left of crossing edges is drawn apart along the inner layer's outward direction;
- within a layer nobody knows which side is right: crossing edges and faces move so that the curve along which the cloth
  passes through itself grows shorter (Volino & Magnenat-Thalmann 2006);
- where that does not help, pockets and crumples are laid flat (``patches``);
- edges are brought back to the lengths they came with, so that repairs spread instead of stretching the cloth.

Only what is tangled, and what hangs on it, moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from recon.cloth.contact import BodyContact
from recon.cloth.escape import Escape, scatter
from recon.cloth.intersections import Crossings
from recon.cloth.patches import Pockets, laid_across
from recon.cloth.xpbd import keep_lengths
from recon.types import Mesh

WORSE = 2.0
"""So many times as many crossings as at best mean that steps are too long."""
PATIENCE = 10
"""So many rounds without much progress, then pockets are laid across their curves."""
GRACE = 5
"""So many rounds after that things may look worse: laid cloth has to find its place."""
FARTHEST = 0.1
"""Where little else helps layers are recognised this deep in each other [m]."""
OWN_RINGS = 2
"""So many times only a layer's crossings with itself are laid flat, then all."""
MOST_RINGS = 6
"""Widest surroundings of crossings that are laid flat, in rings of edges."""
CALMEST = 0.1
"""Where steps had to be made shorter than this share, there is no way out."""


@dataclass(frozen=True)
class Untangling:
    """How layers are untangled."""

    rounds: int = 120
    """Most rounds."""
    body: float = 5e-4
    """Distance from the body that every vertex and face centre ends with [m]."""
    gap: float = 1e-3
    """Distance that layers are drawn apart where they cross [m]."""
    reach: float = 0.025
    """Layers deeper in each other than this are not recognised [m]."""
    curve: float = 0.6
    """Longest step against the curve of self-intersection per round, in mean edge lengths."""
    sweeps: int = 4
    """Sweeps per round over the edges near a repair."""
    stiffness: float = 0.5
    """Share of an edge's error that a sweep takes back."""


@dataclass(frozen=True)
class Untangled:
    """Where it ends."""

    vertices: list[NDArray]
    """(V, 3) of each layer, as they came [m]."""
    crossings: int
    """Pairs of faces that passed through each other before it began."""
    left: NDArray
    """(P, 2) pairs of faces that still do, faces counted through all layers; empty where it worked."""
    inside: int
    """Vertices and face centres that are still inside the body."""
    rounds: int
    """How many it took."""
    notes: tuple[str, ...] = field(default=())
    """Where it could not, one line each."""

    @property
    def clean(self) -> bool:
        """Nothing is left."""
        return not len(self.left) and not self.inside


def untangle(layers: Sequence[Mesh], body: Mesh | None = None, settings: Untangling | None = None) -> Untangled:
    """Draw apart what passes through each other.

    Args:
        layers: draped garments (V, 3), outermost first; faces counter-clockwise from outside.
        body: what they are worn on; its faces outward.
        settings: see :class:`Untangling`.

    Returns:
        The layers moved, and what is left. Layers that are clean come back as they were.
    """
    tangle = _Tangle(layers, body, settings or Untangling())
    return tangle.solve()


class _Tangle:
    def __init__(self, layers: Sequence[Mesh], body: Mesh | None, settings: Untangling):
        self.settings = settings
        sizes = [len(m.vertices) for m in layers]
        self.starts = np.cumsum([0, *sizes])
        self.layer = np.repeat(np.arange(len(layers)), sizes)
        self.x = np.concatenate([m.vertices.detach().cpu().double().numpy() for m in layers])
        faces = [m.faces.cpu().numpy() + at for m, at in zip(layers, self.starts[:-1])]
        self.first_face = np.cumsum([0, *[len(f) for f in faces]])
        self.faces = np.concatenate(faces)
        self.crossings = Crossings(self.faces, len(self.x))
        self.edges = self.crossings.edges
        self.lengths = np.linalg.norm(self.x[self.edges[:, 0]] - self.x[self.edges[:, 1]], axis=1)
        self.scale = float(self.lengths.mean())
        self.rims = self._rims()
        self.pockets = Pockets(self.crossings, self.x, self.layer)
        self.rings = 0
        self.temper = 1.0  # factor on the steps against the curve
        self.body = Escape(body, self.x, self.faces, self.edges) if body is not None else None

    def _rims(self) -> NDArray:
        """(V,) whether a vertex lies on an open border."""
        open_edges = self.edges[self.crossings.faces_of_edge[:, 1] < 0]
        rim = np.zeros(len(self.x), bool)
        rim[open_edges] = True
        return rim

    def solve(self) -> Untangled:
        """Rounds until nothing is left; where it grows worse, back to the best so far with smaller steps."""
        s = self.settings
        found, lack = self.crossings(self.x), self._lack()
        before = len(self.crossings.pairs(found))
        best, best_x, rounds, stuck = (int(lack.sum()), len(found)), self.x.copy(), 0, 0
        while any(best) and rounds < s.rounds and self.temper > CALMEST:
            if stuck >= PATIENCE:
                self._lay_pockets(found)
                found, stuck = self.crossings(self.x), 0
            self._round(found, rounds)
            found, lack = self.crossings(self.x), self._lack()
            rounds += 1
            now = int(lack.sum()), len(found)
            stuck += 1
            if now < best:
                stuck = stuck if now[1] > 0.8 * best[1] else 0
                best, best_x, self.temper = now, self.x.copy(), min(1.0, 1.15 * self.temper)
            elif stuck > GRACE and len(found) > WORSE * best[1] + 50:
                self.x, self.temper = best_x.copy(), self.temper * 0.7
                found = self.crossings(self.x)
        if best_x is not self.x:
            self.x = best_x
            found, lack = self.crossings(self.x), self._lack()
        left = self.crossings.pairs(found)
        layers = [self.x[a:b] for a, b in zip(self.starts[:-1], self.starts[1:])]
        inside = int(lack.sum())
        return Untangled(layers, before, left, inside, rounds, self._notes(left, inside))

    def _round(self, found: NDArray, number: int) -> None:
        """One round of small moves, for the crossings ``found`` (K, 2)."""
        moved = np.zeros(len(self.x), bool)
        if len(found):
            if len(self.starts) > 2 and number % 4 == 0:
                moved |= self._back_to_own_side()
                found = self.crossings(self.x)
            moved |= self._draw_apart(found, number)
        moved |= self._leave_body(number)
        self._relax(moved, number)
        self._leave_body(number, 10)

    def _lay_pockets(self, found: NDArray) -> None:
        """Pockets that poke through other cloth are laid across the curve where they do."""
        crossing = np.zeros(len(self.edges), bool)
        crossing[found[:, 0]] = True
        free = self.pockets.find(crossing) | self._crumpled(found)
        self.x = laid_across(self.x, self.edges, free, self.settings.gap)
        mine = free[self.edges].any(1)
        ends = self.x[self.edges[mine]]
        self.lengths[mine] = np.minimum(self.lengths[mine], np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))

    def _crumpled(self, found: NDArray) -> NDArray:
        """(V,) where a layer passes through itself, later through any, and each time it is asked a ring more."""
        self.rings += 1
        edge, face = self.edges[found[:, 0]], self.faces[found[:, 1]]
        own = (self.layer[edge[:, 0]] == self.layer[face[:, 0]]) | (self.rings > OWN_RINGS)
        out = np.zeros(len(self.x), bool)
        out[edge[own]] = out[face[own]] = True
        for _ in range(min(self.rings, MOST_RINGS)):
            out[self.edges[out[self.edges].any(1)]] = True
        return out

    def _notes(self, left: NDArray, inside: int) -> tuple[str, ...]:
        lines = []
        of = np.searchsorted(self.first_face, left, side="right") - 1
        for pair in np.unique(np.sort(of, 1), axis=0) if len(left) else []:
            mine = left[(np.sort(of, 1) == pair).all(1)]
            at = self.x[self.faces[mine[:, 0]]].mean((0, 1))
            who = f"layer {pair[0]}" if pair[0] == pair[1] else f"layers {pair[0]} and {pair[1]}"
            place = ", ".join(f"{v:.3f}" for v in at)
            lines.append(f"{who}: {len(mine)} pairs of faces still cross around ({place}) m")
        if inside:
            lines.append(f"{inside} vertices and face centres are still inside the body")
        return tuple(lines)

    def _lack(self) -> NDArray:
        """(V + F,) whether vertices and face centres are inside the body."""
        return self.body.lack(self.x) if self.body else np.zeros(len(self.x) + len(self.faces), bool)

    def _leave_body(self, number: int, times: int = 3) -> NDArray:
        """Vertices and face centres closer to the body than the margin go out; returns which vertices moved."""
        if self.body is None:
            return np.zeros(len(self.x), bool)
        late = max(0.0, 2 * number / self.settings.rounds - 1)
        return self.body.leave(self.x, self.settings.body * (1 - 0.9 * late), 1.05 + 3 * late, times)

    def _scatter(self, vertices: NDArray, moves: NDArray) -> None:
        scatter(self.x, vertices, moves)

    def _back_to_own_side(self) -> NDArray:
        """Outer vertices beneath an inner layer's faces go back over them, each gives way by half."""
        moved = np.zeros(len(self.x), bool)
        for k in range(len(self.starts) - 2):
            for j in range(k + 1, len(self.starts) - 1):
                moved |= self._over(k, j)
        return moved

    def _over(self, k: int, j: int) -> NDArray:
        s = self.settings
        outer, inner = slice(*self.starts[k : k + 2]), slice(*self.starts[j : j + 2])
        faces = self.faces[self.first_face[j] : self.first_face[j + 1]] - self.starts[j]
        surface = BodyContact(torch.from_numpy(self.x[inner].copy()), torch.from_numpy(faces))
        face, weights, sign = (t.numpy() for t in surface.closest(torch.from_numpy(self.x[outer].copy())))
        corners = faces[face] + self.starts[j]
        away = self.x[outer] - (self.x[corners] * weights[..., None]).sum(1)
        distance = np.linalg.norm(away, axis=1)
        wrong = (sign < 0) & (distance < min(s.reach * (1 + self.rings), FARTHEST)) & (distance > 1e-9)
        wrong &= ~(self.rims[corners] | (weights < 1e-3)).all(1)  # beside an open border there are no sides
        at = np.flatnonzero(wrong)
        size = (distance[at] + s.gap)[:, None]
        push = -away[at] / distance[at, None] * size
        vertices = np.concatenate([at + self.starts[k], corners[at].ravel()])
        # The corners share the inner's half; weights squared make the point itself move by it.
        share = weights[at] / np.maximum((weights[at] ** 2).sum(1, keepdims=True), 1e-9)
        moves = np.concatenate([0.5 * push, (-0.5 * share[..., None] * push[:, None]).reshape(-1, 3)])
        self._scatter(vertices, moves)
        moved = np.zeros(len(self.x), bool)
        moved[vertices] = True
        return moved

    def _draw_apart(self, found: NDArray, number: int) -> NDArray:
        """One step for each crossing edge and face; returns which vertices moved."""
        edge, face = self.edges[found[:, 0]], self.faces[found[:, 1]]
        p, q = self.x[edge[:, 0]], self.x[edge[:, 1]]
        a, b, c = (self.x[face[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
        over, under = ((p - a) * normal).sum(1), ((q - a) * normal).sum(1)
        t = np.clip(over / np.where(np.abs(over - under) < 1e-15, 1.0, over - under), 0, 1)
        at = p + t[:, None] * (q - p)
        between = self.layer[edge[:, 0]] != self.layer[face[:, 0]]
        move = np.where(
            between[:, None],
            self._by_order(edge, face, over, under, normal),
            self._shorter_curve(found, p, q, normal, at, number),
        )
        on_edge = np.column_stack([1 - t, t])
        on_face = _barycentric(at, a, b, c)
        vertices = np.concatenate([edge.ravel(), face.ravel()])
        moves = np.concatenate(
            [
                (0.5 * _share(on_edge)[..., None] * move[:, None]).reshape(-1, 3),
                (-0.5 * _share(on_face)[..., None] * move[:, None]).reshape(-1, 3),
            ]
        )
        self._scatter(vertices, moves)
        moved = np.zeros(len(self.x), bool)
        moved[vertices] = True
        return moved

    def _by_order(self, edge: NDArray, face: NDArray, over: NDArray, under: NDArray, normal: NDArray) -> NDArray:
        """(K, 3) how the edge moves against the face so that the outer layer ends outside."""
        outward = self.layer[edge[:, 0]] < self.layer[face[:, 0]]  # the edge belongs to the outer layer
        # How far the edge reaches to its wrong side of the face.
        depth = np.where(outward, -np.minimum(over, under), np.maximum(over, under))
        depth = np.clip(depth, 0, 0.5 * self.scale) + self.settings.gap
        return np.where(outward, depth, -depth)[:, None] * normal

    def _shorter_curve(
        self, found: NDArray, p: NDArray, q: NDArray, normal: NDArray, at: NDArray, number: int
    ) -> NDArray:
        """(K, 3) how the edge moves against the face so that the intersection curve shrinks."""
        along = (q - p) / np.maximum(np.linalg.norm(q - p, axis=1, keepdims=True), 1e-15)
        slope = (along * normal).sum(1)
        slope = np.where(np.abs(slope) < 0.05, np.where(slope < 0, -0.05, 0.05), slope)
        total = np.zeros_like(p)
        for side in (0, 1):
            mine = self.crossings.faces_of_edge[found[:, 0], side]
            there = mine >= 0
            corners = self.x[self.faces[mine]]
            own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            line = np.cross(own, normal)
            line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-15)
            inward = (corners.mean(1) - at) - ((corners.mean(1) - at) * along).sum(1)[:, None] * along
            line *= np.where((line * inward).sum(1) < 0, -1.0, 1.0)[:, None]
            step = line - (((along * line).sum(1) * 2.0 / slope)[:, None]) * normal
            total += np.where(there[:, None], step, 0.0)
        size = np.linalg.norm(total, axis=1, keepdims=True)
        longest = self.temper * self.settings.curve * self.scale
        # A little of chance from round to round: equal and opposite steps would stand still for ever.
        jitter = 1 + 0.5 * np.sin(1.7 * number + np.arange(len(p)))[:, None]
        return total / np.maximum(size, 1e-9) * longest * jitter * np.minimum(size, 1.0)

    def _relax(self, moved: NDArray, number: int) -> None:
        """Edges near what moved go back towards the lengths that they came with."""
        near = moved.copy()
        for _ in range(4):
            near[self.edges[near[self.edges].any(1)]] = True
        mine = near[self.edges].all(1)
        if not mine.any():
            return
        stiffness = self.settings.stiffness * (1 - 0.8 * number / self.settings.rounds)
        self.x = keep_lengths(self.x, self.edges[mine], self.lengths[mine], stiffness, self.settings.sweeps)


def _barycentric(at: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    """(K, 3) weights of points in triangles."""
    u, v, w = b - a, c - a, at - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    det = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    return np.clip(np.column_stack([1 - s - t, s, t]), 0, 1)


def _share(weights: NDArray) -> NDArray:
    """How much each corner moves so that the weighted point moves by one."""
    return weights / np.maximum((weights**2).sum(1, keepdims=True), 1e-9)
