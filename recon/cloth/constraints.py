"""What a garment's vertices must keep to while they move: lengths, folds, waistband, legs apart, strangers apart."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.cloth.energies import Cloth
from recon.types import Garment


@dataclass(frozen=True)
class Constraints:
    """What a garment's vertices must keep to."""

    edges: NDArray
    """(E, 2) vertex pairs joined by cloth."""
    edge_lengths: NDArray
    """(E,) rest lengths [m]."""
    bends: NDArray
    """(B, 2) vertex pairs opposite of an edge."""
    bend_lengths: NDArray
    """(B,) their distance in the flat cloth [m]."""
    rest: NDArray
    """(V, 3) positions in which neighbours are close (the pattern, its panels far apart; or the garment worn): tells
    them from strangers in self contact [m]."""
    held: NDArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(H,) vertices of a waistband, held level at its mean height."""
    side: NDArray | None = None
    """(V,) 1 left leg, -1 right leg, 0 neither: legs keep to their side of the body's middle plane."""

    @classmethod
    def from_garment(cls, garment: Garment, cloth: Cloth, held: NDArray | None = None) -> Constraints:
        """Edges and bends of a garment's cloth; ``held`` (H,) vertices of its waistband."""
        return cls.from_cloth(cloth, _panel_positions(garment), held)

    @classmethod
    def from_cloth(cls, cloth: Cloth, rest: NDArray, held: NDArray | None = None) -> Constraints:
        """Edges and bends of any cloth; ``rest`` (V, 3) a shape in which neighbours are close."""
        return cls(
            edges=cloth.edges.numpy(),
            edge_lengths=cloth.edge_lengths.double().numpy(),
            bends=cloth.hinges[:, 2:].numpy(),
            bend_lengths=_flat_spans(cloth),
            rest=rest,
            held=np.zeros(0, np.int64) if held is None else held,
        )


def _panel_positions(garment: Garment) -> NDArray:
    """(V, 3) flat positions with a metre between front and back; seam vertices lie with the front."""
    vertex, points = garment.vertex_of_point.numpy(), garment.panel_points.detach().double().numpy()
    out = np.zeros((int(vertex.max()) + 1, 3))
    for side in (1, 0):
        mine = np.unique(garment.panel_faces[garment.side_of_face == side].numpy())
        out[vertex[mine], :2] = points[mine]
        out[vertex[mine], 2] = -float(side)
    return out


def _flat_spans(cloth: Cloth) -> NDArray:
    """(H,) distance between the vertices opposite of each hinge when it lies flat [m]."""
    hinges = cloth.hinges.numpy()
    edges, lengths = cloth.edges.numpy(), cloth.edge_lengths.double().numpy()
    count = int(edges.max()) + 1
    keys = edges[:, 0] * count + edges[:, 1]  # sorted, as edges are

    def length(a: NDArray, b: NDArray) -> NDArray:
        return lengths[np.searchsorted(keys, np.minimum(a, b) * count + np.maximum(a, b))]

    a, b, c, d = hinges.T
    base = length(a, b)
    feet, heights = [], []
    for tip in (c, d):
        to_a, to_b = length(a, tip), length(b, tip)
        along = (to_a**2 - to_b**2 + base**2) / (2 * base)
        feet.append(along)
        heights.append(np.sqrt(np.maximum(to_a**2 - along**2, 1e-12)))
    return np.hypot(feet[0] - feet[1], heights[0] + heights[1])


def open_rim(faces: NDArray, count: int) -> NDArray:
    """(V,) whether each of ``count`` vertices lies on an open border of a mesh: at an edge of one face only."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1).astype(np.int64)
    keys, times = np.unique(ends @ [count, 1], return_counts=True)
    rim = np.zeros(count, bool)
    rim[np.concatenate(np.divmod(keys[times == 1], count))] = True
    return rim


def held_height(x: NDArray, held: NDArray) -> float:
    """The level at which a waistband ``held`` (H,) of ``x`` (V, 3) is worn: its mean height [m]."""
    return float(x[held, 1].mean()) if len(held) else 0.0


def close_strangers(x: NDArray, rest: NDArray, distance: float) -> NDArray:
    """(K, 2) vertex pairs closer than ``distance`` in space but further than 2.5 times that at rest."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(x).query_pairs(distance, output_type="ndarray")
    if not len(pairs):
        return pairs.reshape(0, 2)
    far = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > 2.5 * distance
    return pairs[far]
