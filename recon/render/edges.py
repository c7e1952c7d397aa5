"""Edges at which an image can jump, and points on them: the geometry of edge-sampled gradients.

The image of opaque triangles is discontinuous only where the projection of an open border lies, or of a fold: an edge
with both of its faces on one side of it. Which of these are seen, and what is seen on their two sides, rays decide.
(Li et al. 2018, "Differentiable Monte Carlo Ray Tracing through Edge Sampling", for a pinhole and constant labels.)
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from recon.render.view import NEAR

LONGEST = 4096
"""Most points on one edge."""


@dataclass(frozen=True)
class Topology:
    """The edges of one mesh."""

    edges: Tensor
    """(E, 2) long vertices."""
    faces: Tensor
    """(E, 2) long, the two faces at the edge (twice the same at a border)."""
    always: Tensor
    """(E,) bool: open border or more than two faces; a candidate whatever the view."""
    flipped: Tensor
    """(E,) bool: the two faces disagree on which side is out (they run along the edge in the same direction)."""
    closed: bool
    """No border, two faces at each edge, all oriented alike: its far sides are hidden by its near sides."""


_known: OrderedDict[tuple[bytes, str], Topology] = OrderedDict()


def topology(faces: Tensor) -> Topology:
    """The edges of (F, 3) faces. The last 16 meshes are remembered by content, so unchanged meshes cost a hash."""
    array = np.ascontiguousarray(faces.detach().cpu().numpy().astype(np.int64, copy=False))
    key = (hashlib.sha1(array.data).digest() + len(array).to_bytes(8, "little"), str(faces.device))
    if key not in _known:
        _known[key] = _build(array, faces.device)
        while len(_known) > 16:
            _known.popitem(last=False)
    _known.move_to_end(key)
    return _known[key]


def _build(faces: np.ndarray, device: torch.device) -> Topology:
    vertex_bits, face_bits = (max(int(n).bit_length(), 1) for n in (faces.max(initial=0), len(faces)))
    if 2 * vertex_bits + face_bits + 1 > 63:
        raise ValueError(f"render: found a mesh of {len(faces)} faces; wanted at most about a million")
    corners, rows = faces.T.copy(), np.arange(len(faces))
    coded = []
    for one, two in ((0, 1), (1, 2), (2, 0)):  # an edge's use by a face as one number: sorting numbers is quick
        a, b = corners[one], corners[two]
        ends = (np.minimum(a, b) << vertex_bits) | np.maximum(a, b)
        coded.append((((ends << 1) | (a < b)) << face_bits) | rows)
    uses = np.sort(np.concatenate(coded))
    ends, forward, owner = uses >> (face_bits + 1), (uses >> face_bits) & 1, uses & ((1 << face_bits) - 1)
    first = np.flatnonzero(np.diff(ends, prepend=-1))
    count = np.diff(first, append=len(ends))
    second = first + (count > 1)
    flipped = (count == 2) & (forward[first] == forward[second])
    ends = ends[first]
    edges = np.stack([ends >> vertex_bits, ends & ((1 << vertex_bits) - 1)], 1)
    tensors = (edges, np.stack([owner[first], owner[second]], 1), count != 2, flipped)
    closed = len(faces) > 0 and not bool((count != 2).any() or flipped.any())
    pairs, owners, always, flips = (torch.from_numpy(a).to(device) for a in tensors)
    return Topology(pairs, owners, always, flips, closed)


@dataclass(frozen=True)
class EdgePoints:
    """Points on the candidate edges, and what moves them."""

    position: Tensor
    """(N, 2) output pixels from the image's centre."""
    normal: Tensor
    """(N, 2) unit normals of their edges in the image."""
    weight: Tensor
    """(N,) length of edge that each stands for [px]."""
    vertices: Tensor
    """(N, 2) long: the edge's end vertices."""
    share: Tensor
    """(N, 2) how far the normal motion of each end vertex's projection moves the point, see ``spread``."""


def edge_points(points: Tensor, edges: Tensor, size: tuple[int, int], step: float) -> EdgePoints:
    """Evenly spaced points, at most ``step`` px apart, on the seen part of edges in front of the camera.

    points (V, 3): homogeneous image points (``View.points``), detached; edges (E, 2).
    An edge that crosses the near plane is cut there: any two of its points describe how its line moves in the image.
    """
    ends = points[edges]
    z = ends[..., 2]
    along = ((NEAR - z[:, 0]) / (z[:, 1] - z[:, 0])).clamp(0, 1)  # where it crosses the near plane
    cut = torch.stack([torch.where(z[:, 0] < NEAR, along, 0.0), torch.where(z[:, 1] < NEAR, along, 1.0)], 1)
    mixed = ends[:, :1] * (1 - cut[..., None]) + ends[:, 1:] * cut[..., None]
    mixed = torch.where((z < NEAR).any(1)[:, None, None], mixed, ends)  # uncut ones bit for bit
    image = mixed[..., :2] / mixed[..., 2:].clamp_min(NEAR)
    start, stop = _clip(image, size)
    direction = image[:, 1] - image[:, 0]
    length = direction.norm(dim=1)
    seen = length * (stop - start)
    counts = torch.where(seen > 0, (seen / step).ceil().clamp(1, LONGEST), 0.0).long()
    k = torch.repeat_interleave(counts)
    rank = torch.arange(len(k), device=k.device) - (counts.cumsum(0) - counts)[k]
    s = start[k] + (rank + 0.5) / counts[k] * (stop - start)[k]
    normal = torch.stack([direction[:, 1], -direction[:, 0]], 1) / length.clamp_min(1e-12)[:, None]
    # share of the two (cut) image ends in the point's motion, and of each vertex in theirs: d image = d point_xy / z
    ends_share = torch.stack([1 - s, s], 1) / mixed[..., 2].clamp_min(NEAR)[k]
    share = torch.stack([1 - cut[k], cut[k]], 2)  # (N, image end, vertex)
    return EdgePoints(
        image[k, 0] + s[:, None] * direction[k],
        normal[k],
        (seen / counts.clamp_min(1))[k],
        edges[k],
        (ends_share[..., None] * share).sum(1),
    )


def _clip(image: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The stretch [start, stop] of each segment (E, 2, 2) that lies in the image; start = stop: none.

    Liang and Barsky 1984.
    """
    half = image.new_tensor([size[1] / 2, size[0] / 2])
    origin, direction = image[:, 0], image[:, 1] - image[:, 0]
    safe = torch.where(direction == 0, torch.full_like(direction, 1e-30), direction)
    one, two = (-half - origin) / safe, (half - origin) / safe
    start = torch.minimum(one, two).amax(1).clamp(0, 1)
    stop = torch.maximum(one, two).amin(1).clamp(0, 1)
    return start, torch.maximum(start, stop)
