"""Open surfaces out of fields that know their sides: a signed distance across the surface, and a distance beside it.

The two outputs of our compact decoder (``UdfShape.head`` = "pair") come to mean that by themselves, though only the
length of both is learned: one changes its sign where the surface is crossed, the other grows beyond its borders. Where
a network does so no votes are needed: the surface is where the first is zero and the second small, its vertices and
borders are roots of smooth functions, and they move with the code as roots do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from recon.garments.marching import march
from recon.garments.mesh_udf import Frame, Meshing, turned_out
from recon.garments.mesh_udf_border import areas, averaged, compact
from recon.garments.panels import SNAP, border_edges, cut_at_signs, split_pinches
from recon.garments.udf_grid import Box, find_band
from recon.types import Mesh

BLUR = 0.008
"""Length over which the distance beside the surface is averaged along it before it is cut [m]."""
SMALL = 0.2
"""Pieces of less area than this share of the largest vanish."""
RIM = 3
"""Rounds in which borders are smoothed."""
LONGEST = 0.01
"""Longest step of a vertex towards the surface [m]."""
BEYOND = 0.006
"""So far beyond a border its field is asked where it is [m]."""
FLATTEST = 0.1
"""Where the distance beside a border grows more slowly than this, nothing says where the border is: it stays."""


@runtime_checkable
class Sides(Protocol):
    """A field that knows its sides."""

    def sides(self, points: Tensor) -> Tensor:
        """(N, 3) [m] -> (N, 2): signed distance across the surface, and distance beside it (at least 0) [m]."""
        ...

    def sides_slope(self, points: Tensor, column: int) -> tuple[Tensor, Tensor]:
        """One of both (N,) at points (N, 3) and its gradient (N, 3), detached."""
        ...


def mesh_sides(field: Sides, box: Box, meshing: Meshing, border: float) -> Mesh:
    """The surface where the first distance is zero and the second, averaged a little, below ``border`` [m].

    Args:
        field: see :class:`Sides`.
        box: where to look.
        meshing: resolution, steepness and floor count as for ``mesh_udf``.
        border: distance beside the surface that counts as its end.

    Returns:
        Vertices (V, 3) float32 [m] without gradient (:func:`follow_sides` attaches it) and faces (F, 3); (0, 3) both
        where there is no surface.
    """
    none = Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long))
    with torch.no_grad():
        band = find_band(lambda x: field.sides(x).norm(dim=1), box, meshing.resolution, meshing.steepness,
                         meshing.floor, slopes=False)  # fmt: skip
        if not len(band.corners):
            return none
        across = field.sides(torch.as_tensor(band.points, dtype=torch.float32))[:, 0].double().numpy()
        sign = np.where(across < 0, -1, 1).astype(np.int8)
        points, faces = march(replace(band, distance=np.abs(across)), sign)
        if not len(faces):
            return none
        beside = field.sides(torch.as_tensor(points, dtype=torch.float32))[:, 1].double().numpy()
    over = filled(smoothed(beside, faces, round((BLUR / band.cell) ** 2)) - border, faces)
    points, faces = cut_level(points, faces, over, SNAP * band.cell)
    if not len(faces):
        return none
    faces, points = split_pinches(largest_pieces(points, faces), points)
    points, faces = compact(points, faces)
    points = even_borders(field, points, faces)
    return Mesh(torch.as_tensor(points, dtype=torch.float32), torch.as_tensor(turned_out(points, faces)))


def smoothed(values: NDArray, faces: NDArray, rounds: int) -> NDArray[np.float64]:
    """(V,) values averaged with their neighbours on a mesh, so many times."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(values)
    links = coo_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(count, count)).tocsr()
    links = links + links.T
    total = np.asarray(links.sum(1)).ravel()
    for _ in range(rounds):
        values = 0.5 * values + 0.5 * (links @ values) / np.maximum(total, 1)
    return values


def filled(over: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(V,) how far vertices are over the border, with islands that don't reach the end of what was marched taken back:
    beyond a true border a field goes on growing."""
    away = over > 0
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = ends[away[ends].all(1)]
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(over), len(over)))
    piece = connected_components(graph, directed=False)[1]
    ended = np.zeros(piece.max() + 1, bool)
    rim = np.unique(border_edges(faces))
    ended[piece[rim[away[rim]]]] = True
    return np.where(away & ~ended[piece], -1e-6, over)


def cut_level(points: NDArray, faces: NDArray, over: NDArray, near: float) -> tuple[NDArray, NDArray]:
    """The mesh where ``over`` (V,) is at most zero; vertices within ``near`` [m] of the cut count as on it."""
    away = over > 0
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    inner, outer = ends[~away[ends[:, 0]] & away[ends[:, 1]]].T
    share = over[inner] / np.minimum(over[inner] - over[outer], -1e-12)
    size = np.linalg.norm(points[inner] - points[outer], axis=1)
    sign = np.where(away, 1, -1)
    sign[inner[share * size < near]] = 0
    if (sign < 0).sum() < 3:
        return points, faces[:0]
    faces, pairs = cut_at_signs(faces, sign)
    a, b = pairs.T
    share = np.clip(over[a] / np.minimum(over[a] - over[b], -1e-12), 0.15, 0.85)[:, None]
    return np.concatenate([points, points[a] + share * (points[b] - points[a])]), faces


def largest_pieces(points: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """Faces of the largest connected piece, and of others not much smaller."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(points), len(points)))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    area = np.bincount(piece, areas(points, faces)[1])
    return faces[area[piece] >= SMALL * area.max()]


def even_borders(field: Sides, points: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Vertices (V, 3), those on borders smoothed along the border and taken back onto the surface."""
    edges = border_edges(faces)
    if not len(edges):
        return points
    rim, index = np.unique(edges, return_inverse=True)
    points = points.copy()
    for _ in range(RIM):
        points[rim] = averaged(points[rim], index.reshape(-1, 2))
    across, slope = field.sides_slope(torch.as_tensor(points[rim], dtype=torch.float32), 0)
    points[rim] -= _newton(across, slope).double().numpy()
    return points


def _newton(value: Tensor, slope: Tensor) -> Tensor:
    """(N, 3) steps to where values (N,) are zero, by their gradients (N, 3); at most ``LONGEST``."""
    step = value[:, None] * slope / slope.square().sum(1, keepdim=True).clamp_min(0.1)
    size = step.norm(dim=1, keepdim=True)
    return step * (LONGEST / size.clamp_min(LONGEST))


def follow_sides(field: Sides, mesh: Mesh, level: Tensor, frame: Frame, move: bool = False) -> Mesh:
    """The mesh with vertices that carry the gradient of everything the field depends on.

    With s the distance across, b beside, o the direction out of a border and derivatives by the code z::

        ∂v/∂z = - ∇s ∂s/∂z / |∇s|²        and on borders, in addition,        - o ∂b/∂z / (o·∇b)

    Args:
        field: differentiable in what it depends on.
        mesh: vertices (V, 3) [m] on or near the surface.
        level: (B,) what :func:`beyond_borders` found on the field that the mesh was made from: border vertices are held
            at this, each at its own, for borders are smoother than learned distances.
        frame: of the mesh.
        move: also take vertices to where the field now says that surface and borders are.
    """
    at, rim, out = mesh.vertices.detach(), frame.border, frame.outward
    edge = at[rim] + BEYOND * out
    across, slope = field.sides_slope(at, 0)
    beside, growth = field.sides_slope(edge, 1)
    if move:
        at = at - _newton(across, slope)
        lack, steep = level - beside, (growth * out).sum(1)
        onward = torch.where(steep > FLATTEST, 0.0, lack.clamp_min(0.0))  # flat and small: the surface goes on there
        end = (_along(lack, steep) + onward).clamp(-LONGEST, LONGEST)
        return mesh.with_vertices(at.index_add(0, rim, end[:, None] * out))
    found = field.sides(torch.cat([at, edge]))
    change = found - found.detach()
    at = at - change[: len(at), :1] * slope / slope.square().sum(1, keepdim=True).clamp_min(0.1)
    end = _along(-change[len(at) :, 1], (growth * out).sum(1))
    return mesh.with_vertices(at.index_add(0, rim, end[:, None] * out))


def beyond_borders(field: Sides, mesh: Mesh, frame: Frame) -> Tensor:
    """(B,) distances beside the surface [m] a little beyond its border vertices, where they grow; no gradient."""
    with torch.no_grad():
        return field.sides(mesh.vertices[frame.border] + BEYOND * frame.outward)[:, 1]


def _along(lack: Tensor, steep: Tensor) -> Tensor:
    """(B,) how far out of the border a distance that is short by ``lack`` is met; 0 where it hardly grows that way."""
    return torch.where(steep > FLATTEST, lack / steep.clamp_min(FLATTEST), 0.0)
