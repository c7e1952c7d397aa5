"""Training samples of the implicit sewing patterns, from garments with known panels and known 2D-3D correspondence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from matplotlib.path import Path as Polygon
from numpy.typing import NDArray
from torch import Tensor

from recon.garments.isp_net import IspShape
from recon.garments.panels import border_edges, border_loops, cross, signed_areas
from recon.types import Garment

GRID = 256
"""Points along each side of the position maps."""


@dataclass(frozen=True)
class Border:
    """Border edges of one panel of one garment, domain units."""

    start: NDArray[np.float64]
    """(E, 2)."""
    end: NDArray[np.float64]
    label: NDArray[np.int64]
    """(E,) 0 = open."""
    start_3d: NDArray[np.float64]
    """(E, 3)."""
    end_3d: NDArray[np.float64]
    partner: NDArray[np.int64]
    """(E,) the panel that the edge is sewn to; -1 on open edges."""
    partner_start: NDArray[np.float64]
    """(E, 2) its point that the start is sewn to; NaN on open edges."""
    partner_end: NDArray[np.float64]
    loops: list[Polygon]
    weight: NDArray[np.float64]
    """(E,) how often to sample: length, more at corners and along narrow openings."""


@dataclass(frozen=True)
class Outline:
    """Border edges of one flat panel that was never sewn, domain units."""

    start: NDArray[np.float64]
    """(E, 2)."""
    end: NDArray[np.float64]
    label: NDArray[np.int64]
    """(E,) 0 = open."""
    loops: list[Polygon]

    @property
    def weight(self) -> NDArray[np.float64]:
        """(E,) how often to sample: length."""
        return np.linalg.norm(self.end - self.start, axis=1)


@dataclass(frozen=True)
class IspSamples:
    """All garments' samples, ready to be drawn from; domain units throughout. K panels."""

    at: Tensor
    """(n, S, 2) points of the domain."""
    distance: Tensor
    """(n, S, K) signed distances to each panel."""
    label: Tensor
    """(n, S, K) label of the closest border."""
    positions: Tensor
    """(n, GRID, GRID, K, 3) surface of each panel over the domain."""
    covered: Tensor
    """(n, GRID, GRID, K) bool, inside the panel."""
    cells: Tensor
    """(n, C, 2) grid points, inside some panel together with their neighbours, repeated to one length."""
    border_at: Tensor
    """(n, K, M, 2) points on the border of each panel."""
    border_3d: Tensor
    """(n, K, M, 3)."""
    seam_at: Tensor
    """(n, M, 2, 2) points of two panels that are sewn together."""
    seam_panel: Tensor
    """(n, M, 2) which panels."""
    seam_3d: Tensor
    """(n, M, 3)."""

    def __len__(self) -> int:
        return len(self.at)


def frame(garments: list[Garment], code: int = 32, margin: float = 1.07) -> IspShape:
    """The domain that holds all the garments' panels, and the labels that they use."""
    points = torch.cat([g.panel_points for g in garments])
    low, high = points.min(0).values, points.max(0).values
    middle = (low[1] + high[1]) / 2
    half = torch.stack([points[:, 0].abs().max(), (high[1] - low[1]) / 2]).max() * margin
    depth = torch.cat([g.mesh.vertices[:, 2] for g in garments]).std()
    first = garments[0]
    shape = IspShape(first.kind, tuple(first.seam_names), (0.0, float(middle)), float(half), float(depth), code)
    return replace(shape, panel_names=tuple(first.panel_names))


def collect(garments: list[Garment], shape: IspShape, generator: np.random.Generator, step: int = 3) -> IspSamples:
    """Draw the samples of every garment; ``step`` = grid points between the ends of a finite difference."""
    rows = [_one(g, shape, generator, step) for g in garments]
    return IspSamples(*(torch.as_tensor(np.stack(column)) for column in zip(*rows, strict=True)))


def _one(garment: Garment, shape: IspShape, rng: np.random.Generator, step: int) -> tuple[NDArray, ...]:
    borders = [panel_border(garment, shape, k) for k in range(len(shape.panel_names))]
    at = np.concatenate([_around(b, rng) for b in borders] + [rng.uniform(-1, 1, (3072, 2))])
    measured = [signed_distance(b, at) for b in borders]
    maps = [_position_map(garment, shape, k) for k in range(len(borders))]
    covered = np.stack([m[1] for m in maps], -1)
    whole = covered.copy()
    whole[:-step] &= covered[step:]
    whole[:, :-step] &= covered[:, step:]
    whole[-step:] = whole[:, -step:] = False
    cells = np.stack(np.nonzero(whole.any(-1)), 1)
    points = [along(b, rng, 1024) for b in borders]
    seam_at, seam_panel, seam_3d = _seam(borders, rng, 1024)
    return (
        at.astype(np.float32),
        np.stack([d for d, _ in measured], 1).astype(np.float32),
        np.stack([c for _, c in measured], 1).astype(np.int64),
        np.stack([m[0] for m in maps], 2),
        covered,
        cells[rng.integers(len(cells), size=16384)].astype(np.int16),
        np.stack([p for p, _ in points]).astype(np.float32),
        np.stack([x for _, x in points]).astype(np.float32),
        seam_at.astype(np.float32),
        seam_panel,
        seam_3d.astype(np.float32),
    )


def panel_border(garment: Garment, shape: IspShape, panel: int) -> Border:
    """The border of one panel as edges with labels, 3D ends and partners."""
    faces = _upward(garment, panel)
    edges = border_edges(faces)
    vertex = garment.vertex_of_point.numpy()
    centre, half = np.array(shape.centre), shape.half
    plane = (garment.panel_points.double().numpy() - centre) / half
    space = (garment.mesh.vertices.double().numpy() - np.array([*centre, 0.0])) / half
    labels = garment.border_labels.numpy()[edges]
    sewn = ~_is_open(garment, vertex[edges])
    turns = _edge_turns(plane, edges)
    # A point's label is that of the border edge which starts there; whether the edge is sewn, the welded mesh says.
    label = np.where(sewn, np.where(labels[:, 0] > 0, labels[:, 0], labels[:, 1]), 0)
    other, partner = _partners(garment, panel, edges)
    placed = np.where((sewn & (other >= 0))[:, None, None], plane[np.maximum(partner, 0)], np.nan)
    loops = [Polygon(plane[loop]) for loop in border_loops(faces)]
    corner = _near_corner(plane, edges, label, turns, 0.03)
    length = np.linalg.norm(plane[edges[:, 1]] - plane[edges[:, 0]], axis=1)
    narrow = _narrow(plane, edges, loops, 0.12)
    weight = length * np.where(corner, 4.0, 1.0) * np.where(narrow, 3.0, 1.0)
    ends = plane[edges]
    ends_3d = space[vertex[edges]]
    return Border(
        ends[:, 0], ends[:, 1], label, ends_3d[:, 0], ends_3d[:, 1],
        np.where(sewn, other, -1), placed[:, 0], placed[:, 1], loops, weight,
    )  # fmt: skip


def _upward(garment: Garment, panel: int) -> NDArray:
    """(F, 3) faces of one panel, counter-clockwise in the plane: those behind the body look the other way."""
    faces = garment.panel_faces[garment.panel_of_face == panel].numpy()
    turned = signed_areas(garment.panel_points.double().numpy(), faces).sum() < 0
    return faces[:, [0, 2, 1]] if turned else faces


def _is_open(garment: Garment, vertex_edges: NDArray) -> NDArray:
    """Whether each edge (E, 2) of welded vertices has a single face in the sewn mesh."""
    size = len(garment.mesh.vertices)
    rim = border_edges(garment.mesh.faces.numpy())
    return np.isin(vertex_edges.min(1) * size + vertex_edges.max(1), rim.min(1) * size + rim.max(1))


def _partners(garment: Garment, panel: int, edges: NDArray) -> tuple[NDArray, NDArray]:
    """For border edges (E, 2) of a panel: the other panel with an edge of the same welded vertices (E,), -1 if there is
    none, and its points at start and end (E, 2)."""
    vertex, size = garment.vertex_of_point.numpy(), len(garment.mesh.vertices)

    def keys(pairs: NDArray) -> NDArray:
        ends = vertex[pairs]
        return ends.min(1) * size + ends.max(1)

    found, points = np.full(len(edges), -1), np.full(edges.shape, -1)
    for other in range(len(garment.panel_names)):
        theirs = border_edges(_upward(garment, other)) if other != panel else edges[:0]
        _, mine, row = np.intersect1d(keys(edges), keys(theirs), return_indices=True)
        turned = vertex[edges[mine, 0]] != vertex[theirs[row, 0]]
        found[mine] = other
        points[mine] = np.where(turned[:, None], theirs[row][:, ::-1], theirs[row])
    return found, points


def _edge_turns(plane: NDArray, edges: NDArray) -> NDArray:
    """(E, 2) how much the border turns [rad] at each edge's start and end."""
    direction = plane[edges[:, 1]] - plane[edges[:, 0]]
    angle = np.arctan2(direction[:, 1], direction[:, 0])
    arriving = np.zeros(len(plane))
    leaving = np.zeros(len(plane))
    arriving[edges[:, 1]], leaving[edges[:, 0]] = angle, angle
    turn = np.abs((leaving - arriving + np.pi) % (2 * np.pi) - np.pi)
    return turn[edges]


def _near_corner(plane: NDArray, edges: NDArray, label: NDArray, turns: NDArray, reach: float) -> NDArray:
    """(E,) whether an edge's middle lies within ``reach`` of a corner or a change of label."""
    after = np.full(len(plane), -1)
    after[edges[:, 0]] = label
    is_corner = (turns[:, 1] > np.radians(30)) | (after[edges[:, 1]] != label)
    corners = plane[edges[is_corner, 1]]
    middle = plane[edges].mean(1)
    if not len(corners):
        return np.zeros(len(edges), bool)
    return np.linalg.norm(middle[:, None] - corners[None], axis=2).min(1) < reach


def _narrow(plane: NDArray, edges: NDArray, loops: list[Polygon], width: float) -> NDArray:
    """(E,) whether the outside is narrower than ``width`` there: jacket openings, armpits, between the legs."""
    direction = plane[edges[:, 1]] - plane[edges[:, 0]]
    outward = np.stack([direction[:, 1], -direction[:, 0]], 1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    found = np.zeros(len(edges), bool)
    for reach in np.linspace(0.02, width, 6):
        found |= _inside(loops, plane[edges].mean(1) + reach * outward)
    return found


def _inside(loops: list[Polygon], points: NDArray) -> NDArray:
    found = np.zeros(len(points), bool)
    for loop in loops:
        found ^= loop.contains_points(points)
    return found


def signed_distance(border: Border | Outline, at: NDArray) -> tuple[NDArray, NDArray]:
    """(N,) exact signed distance, negative inside, and label of the closest border edge, at points (N, 2)."""
    start = torch.as_tensor(border.start, dtype=torch.float32)
    along_edge = torch.as_tensor(border.end - border.start, dtype=torch.float32)
    squared = along_edge.square().sum(1).clamp_min(1e-12)
    distances, nearest = [], []
    for points in torch.as_tensor(at, dtype=torch.float32).split(4096):
        away = points[:, None] - start
        share = ((away * along_edge).sum(2) / squared).clamp(0, 1)
        best, edge = (away - share[..., None] * along_edge).square().sum(2).min(1)
        distances.append(best.sqrt())
        nearest.append(edge)
    distance = torch.cat(distances).double().numpy()
    sign = np.where(_inside(border.loops, at), -1.0, 1.0)
    return sign * distance, border.label[torch.cat(nearest).numpy()]


def along(border: Border, rng: np.random.Generator, count: int) -> tuple[NDArray, NDArray]:
    """Weighted random border points (count, 2) with their places in space (count, 3)."""
    edge, t, flat = on_border(border, rng, count)
    return flat, border.start_3d[edge] + t * (border.end_3d[edge] - border.start_3d[edge])


def on_border(border: Border | Outline, rng: np.random.Generator, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """Weighted random border points: their edges (count,), places along these (count, 1), and points (count, 2)."""
    edge = rng.choice(len(border.weight), size=count, p=border.weight / border.weight.sum())
    t = rng.random((count, 1))
    return edge, t, border.start[edge] + t * (border.end[edge] - border.start[edge])


def _around(border: Border, rng: np.random.Generator, count: int = 5120) -> NDArray:
    """Points near the border at two ranges."""
    spread = np.where(rng.random((count, 1)) < 0.65, 0.012, 0.05)
    return np.clip(along(border, rng, count)[0] + rng.normal(size=(count, 2)) * spread, -1, 1)


def _seam(borders: list[Border], rng: np.random.Generator, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """Pairs of sewn points (count, 2, 2), their panels (count, 2) and their common place (count, 3)."""
    panel = np.repeat(np.arange(len(borders)), [len(b.start) for b in borders])

    def all_of(name: str) -> NDArray:
        return np.concatenate([getattr(border, name) for border in borders])

    partner = all_of("partner")
    # Each seam once, from the first of its panels.
    known = (partner > panel) & (all_of("label") > 0)
    weight = np.where(known, all_of("weight"), 0.0)
    edge = rng.choice(len(weight), size=count, p=weight / weight.sum())
    t = rng.random((count, 1))

    def between(start: str, end: str) -> NDArray:
        return (1 - t) * all_of(start)[edge] + t * all_of(end)[edge]

    flat = np.stack([between("start", "end"), between("partner_start", "partner_end")], 1)
    return flat, np.stack([panel[edge], partner[edge]], 1), between("start_3d", "end_3d")


def _position_map(garment: Garment, shape: IspShape, panel: int) -> tuple[NDArray, NDArray]:
    """(GRID, GRID, 3) surface positions over the domain and (GRID, GRID) whether the panel covers the point."""
    on = garment.panel_of_face == panel
    plane = (garment.panel_points.double().numpy() - np.array(shape.centre)) / shape.half
    space = (garment.mesh.vertices.double().numpy() - np.array([*shape.centre, 0.0])) / shape.half
    triangles = plane[garment.panel_faces[on].numpy()]
    corners = space[garment.mesh.faces[on].numpy()]
    h = 2 / (GRID - 1)
    low = np.ceil((triangles.min(1) + 1) / h - 1e-6).astype(int)
    high = np.floor((triangles.max(1) + 1) / h + 1e-6).astype(int)
    size = max(1, int((high - low).max()) + 1)
    offsets = np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), -1).reshape(-1, 2)
    index = low[:, None] + offsets
    valid = (index <= high[:, None]).all(2) & (index >= 0).all(2) & (index < GRID).all(2)
    a = triangles[:, None, 0]
    u, v, w = triangles[:, None, 1] - a, triangles[:, None, 2] - a, index * h - 1 - a
    area = cross(u, v)
    s, t = cross(w, v) / area, cross(u, w) / area
    valid &= (s >= -1e-6) & (t >= -1e-6) & (s + t <= 1 + 1e-6)
    face, spot = np.nonzero(valid)
    s, t = s[face, spot, None], t[face, spot, None]
    place = corners[face, 0] * (1 - s - t) + corners[face, 1] * s + corners[face, 2] * t
    positions = np.zeros((GRID, GRID, 3), np.float32)
    covered = np.zeros((GRID, GRID), bool)
    i, j = index[face, spot].T
    positions[i, j] = place
    covered[i, j] = True
    return positions, covered
