"""A user's garment mesh: read, put into metres, repaired where it can be, with a line for all that was done to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon.files.meshes import read_mesh
from recon.types import Mesh, UserError

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Metres in a unit."""
SIZES = (0.25, 2.0)
"""Longest side of garments that people wear [m]."""
SCRAP = 0.02
"""Pieces of less than this share of the area are buttons and the like."""
BODY_HEIGHT = 1.35
"""A closed piece longer than this is a body [m]."""
SHELL = 0.008
"""Sheets closer than this over most of a garment are one shell with a thickness [m]."""

SAMPLES = 800
"""Triangles that are asked for another layer."""


def read_garment_mesh(path: str | Path, unit: str = "auto") -> tuple[Mesh, list[str]]:
    """An open garment mesh in metres, and what was found and done, a line each.

    Vertices are welded; degenerate and double faces, scraps, a body left in the file and the inner layer of a shell
    whose layers are separate pieces are dropped.

    Raises:
        UserError: as :func:`read_mesh` (missing, unreadable, empty, NaN); no size that a garment may have; watertight,
            nothing but a body, or a shell whose layers are joined.
    """
    path = Path(path)
    raw = read_mesh(path)
    notes: list[str] = []
    points, faces = raw.vertices.double().numpy(), raw.faces.numpy()
    points = points * _scale(path, points[np.unique(faces)], unit, notes)
    points, faces = _weld(points, faces, notes)
    if not len(faces):
        raise UserError(f"{path}: all triangles are degenerate; wanted a surface")
    faces = _without_bodies(path, points, faces, notes)
    faces = _without_scraps(points, faces, notes)
    faces = _one_layer(path, points, faces, notes)
    if not len(_rim(faces)):
        raise UserError(
            f"{path}: watertight; wanted an open surface (neck, hem, cuffs): distance fields of cloth have one layer"
        )
    crowded = int((_edge_counts(faces) > 2).sum())
    if crowded:
        notes.append(f"{crowded} edges have three or more faces: left as they are, distances do not mind")
    used, index = np.unique(faces, return_inverse=True)
    vertices = torch.as_tensor(points[used], dtype=torch.float32)
    return Mesh(vertices, torch.as_tensor(index.reshape(-1, 3))), notes


def _scale(path: Path, points: NDArray, unit: str, notes: list[str]) -> float:
    """Metres in the file's unit, guessed by the size where it is not given."""
    size = float((points.max(0) - points.min(0)).max())
    low, high = SIZES
    if unit != "auto":
        if not low / 5 < size * UNITS[unit] < high * 2:
            raise UserError(f"{path}: {size * UNITS[unit]:.3g} m long as {unit}; wanted a garment ({low} to {high} m)")
        return UNITS[unit]
    for name in ("m", "cm", "mm"):
        if low <= size * UNITS[name] <= high:
            if name != "m":
                notes.append(f"read as {name} ({size:.4g} long); --unit says otherwise")
            return UNITS[name]
    raise UserError(f"{path}: {size:.4g} units long; wanted a garment of {low} to {high} m, or its --unit")


def _weld(points: NDArray, faces: NDArray, notes: list[str]) -> tuple[NDArray, NDArray]:
    grid = np.round(points / 1e-5).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    index = index.ravel()
    if len(first) < len(points):
        notes.append(f"{len(points) - len(first)} vertices lay on others: welded")
    points, faces = points[first], index[faces]
    sound = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    _, kept = np.unique(np.sort(faces[sound], 1), axis=0, return_index=True)
    dropped = len(faces) - len(kept)
    if dropped:
        notes.append(f"{dropped} triangles were degenerate or there twice: dropped")
    return points, faces[sound][np.sort(kept)]


def _edge_counts(faces: NDArray) -> NDArray[np.int64]:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def _rim(faces: NDArray) -> NDArray[np.int64]:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def _pieces(points: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """(F,) the connected piece of each face."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(points), len(points)))
    return np.unique(connected_components(graph, directed=False)[1][faces[:, 0]], return_inverse=True)[1]


def _areas(points: NDArray, faces: NDArray) -> NDArray[np.float64]:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _without_bodies(path: Path, points: NDArray, faces: NDArray, notes: list[str]) -> NDArray:
    piece = _pieces(points, faces)
    body = np.zeros(len(faces), bool)
    for k in range(piece.max() + 1):
        own = faces[piece == k]
        at = points[np.unique(own)]
        if (at.max(0) - at.min(0)).max() > BODY_HEIGHT and not len(_rim(own)):
            body[piece == k] = True
    if body.all():
        raise UserError(f"{path}: one closed piece over {BODY_HEIGHT} m long, a body; wanted a garment without it")
    if body.any():
        notes.append(f"a closed piece over {BODY_HEIGHT} m long ({body.sum()} triangles) is a body: dropped")
    return faces[~body]


def _without_scraps(points: NDArray, faces: NDArray, notes: list[str]) -> NDArray:
    piece = _pieces(points, faces)
    area = np.bincount(piece, _areas(points, faces))
    small = area < SCRAP * area.sum()
    if small.any():
        notes.append(f"{small.sum()} small loose pieces (buttons, loops) dropped")
    if (~small).sum() > 1:
        notes.append(f"{(~small).sum()} separate pieces: taken together as one garment")
    return faces[~small[piece]]


def _one_layer(path: Path, points: NDArray, faces: NDArray, notes: list[str]) -> NDArray:
    """Without inner layers: pieces that lie within a shell's thickness of a larger one."""
    if _doubled(points, faces) < 0.5:
        return faces
    piece = _pieces(points, faces)
    area = np.bincount(piece, _areas(points, faces))
    kept: list[NDArray] = []
    dropped = 0
    for k in np.argsort(-area):
        middle = points[faces[piece == k]].mean(1)
        far = np.ones(len(middle), bool)
        if kept:
            outer = points[np.concatenate(kept)].mean(1)
            size = np.sqrt(np.median(_areas(points, np.concatenate(kept))))
            far = cKDTree(outer).query(middle)[0] > SHELL + size
        if far.mean() > 0.5:
            kept.append(faces[piece == k])
        else:
            dropped += 1
    left = np.concatenate(kept)
    if _doubled(points, left) >= 0.5:
        raise UserError(f"{path}: two layers closer than {SHELL * 1e3:.0f} mm, joined; wanted a surface of one layer")
    notes.append(f"{dropped} inner or outer layers within {SHELL * 1e3:.0f} mm of a larger one dropped")
    return left


def _doubled(points: NDArray, faces: NDArray) -> float:
    """Share of the triangles that have another straight across within a shell's thickness, facing like or unlike."""
    corners = points[faces]
    middle, size = corners.mean(1), np.linalg.norm(corners - corners.mean(1)[:, None], axis=2).max(1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-18)
    pick = np.random.default_rng(0).permutation(len(faces))[:SAMPLES]
    reach = float(np.quantile(size, 0.95)) + SHELL
    found = np.zeros(len(pick), bool)
    for row, near in enumerate(cKDTree(middle).query_ball_point(middle[pick], reach)):
        own = pick[row]
        others = np.array([k for k in near if not np.isin(faces[k], faces[own]).any()], dtype=np.int64)
        if len(others):
            found[row] = _across(middle[own], normal[own], corners[others], normal[others])
    return float(found.mean())


def _across(point: NDArray, normal: NDArray, corners: NDArray, normals: NDArray) -> bool:
    """Whether one of the triangles (K, 3, 3) is hit within a shell's thickness along the normal of a point."""
    facing = normals @ normal
    away = ((corners[:, 0] - point) * normals).sum(1) / np.where(np.abs(facing) > 0.5, facing, np.inf)
    hit = point + away[:, None] * normal
    inside = np.ones(len(corners), bool)
    for k in range(3):
        edge = np.cross(corners[:, (k + 1) % 3] - corners[:, k], hit - corners[:, k])
        inside &= (edge * normals).sum(1) >= -1e-12
    return bool((inside & (np.abs(facing) > 0.5) & (np.abs(away) < SHELL) & (np.abs(away) > 2e-4)).any())
