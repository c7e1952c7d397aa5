"""Edges at which an image can jump, and their lines in the image: the geometry of edge-sampled gradients.

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
class Lines:
    """Edges as straight lines in the image, from 0 at their first end to 1 at their last."""

    ends: Tensor
    """(E, 2, 2) output pixels from the image's centre; an edge that crosses the near plane is cut there."""
    depths: Tensor
    """(E, 2) of these ends [m]."""
    cut: Tensor
    """(E, 2) where on the edge itself these ends lie, 0 = its first vertex, 1 = its second."""
    vertices: Tensor
    """(E, 2) long."""
    start: Tensor
    """(E,) the part from ``start`` to ``stop`` lies in the image; nothing does if they are equal."""
    stop: Tensor

    @property
    def direction(self) -> Tensor:
        """(E, 2) from end to end [px]."""
        return self.ends[:, 1] - self.ends[:, 0]

    @property
    def length(self) -> Tensor:
        """(E,) from end to end [px]."""
        return self.direction.norm(dim=1)

    @property
    def normal(self) -> Tensor:
        """(E, 2) unit normals in the image."""
        x, y = self.direction.unbind(1)
        return torch.stack([y, -x], 1) / self.length.clamp_min(1e-12)[:, None]

    def position(self, line: Tensor, at: Tensor) -> Tensor:
        """(N, 2) pixels from the image's centre of the points ``at`` (N,) on the lines with numbers ``line`` (N,)."""
        return self.ends[line, 0] + at[:, None] * self.direction[line]

    def share(self, line: Tensor, at: Tensor) -> Tensor:
        """(N, 2) how far the point moves when the edge's first or second vertex moves, as homogeneous image points.

        The motion is that along the normal n, from (n, -n . position) . d(vertex): for a vertex with image point X / z,
        d(X / z) = (dX - X / z dz) / z, and n . X / z is the same all along the line.
        """
        of_ends = torch.stack([1 - at, at], 1) / self.depths[line]
        of_vertices = torch.stack([1 - self.cut[line], self.cut[line]], 2)  # (N, end, vertex)
        return (of_ends[..., None] * of_vertices).sum(1)


def lines_of(points: Tensor, edges: Tensor, size: tuple[int, int]) -> Lines:
    """The image of edges (E, 2), as far as they are in front of the camera.

    points (V, 3): homogeneous image points (``View.points``), detached.
    """
    ends = points[edges]
    z = ends[..., 2]
    along = ((NEAR - z[:, 0]) / (z[:, 1] - z[:, 0])).clamp(0, 1)  # where it crosses the near plane
    cut = torch.stack([torch.where(z[:, 0] < NEAR, along, 0.0), torch.where(z[:, 1] < NEAR, along, 1.0)], 1)
    mixed = ends[:, :1] * (1 - cut[..., None]) + ends[:, 1:] * cut[..., None]
    mixed = torch.where((z < NEAR).any(1)[:, None, None], mixed, ends)  # uncut ones bit for bit
    depths = mixed[..., 2].clamp_min(NEAR)
    image = mixed[..., :2] / depths[..., None]
    return Lines(image, depths, cut, edges, *_clip(image, size))


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
