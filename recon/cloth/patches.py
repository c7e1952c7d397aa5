"""Cloth laid flat: pockets beyond a closed curve of intersection, or any part that is tangled.

Where a pocket of cloth pokes through other cloth, its crossing edges cut it off from the rest of its mesh. Laid across
the curve like a soap film it lies beside what it poked through, whatever its depth, and is never longer than before
(compare the global analysis of Baraff, Witkin and Kass 2003, which colours the same regions).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from recon.cloth.intersections import Crossings

RIM_SMOOTHING = 20
"""Times that open borders are averaged with their neighbours."""
LARGEST = 0.15
"""Larger pieces of a layer's area are not pockets: then nobody knows which side is the right one."""


class Pockets:
    """Finds the pockets of layered cloth and lays them flat."""

    def __init__(self, crossings: Crossings, x: NDArray, layer: NDArray):
        """``x`` (V, 3) tells areas; ``layer`` (V,) the layer of each vertex."""
        self.edges, self.layer = crossings.edges, layer
        faces = crossings.faces
        corners = x[faces]
        size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self.area = np.bincount(faces.ravel(), np.repeat(size, 3), len(x))
        self.loops = border_numbers(crossings.rim, len(x))

    def find(self, crossing: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(V,) the vertices of all pockets; ``crossing`` (E,) whether an edge passes through a face."""
        count, link = len(self.layer), self.edges[~crossing]
        graph = sp.coo_matrix((np.ones(len(link), np.int8), (link[:, 0], link[:, 1])), shape=(count, count))
        pieces, piece = connected_components(graph, directed=False)
        whole = np.bincount(self.layer, self.area)
        of_layer = self.layer[np.unique(piece, return_index=True)[1]]
        pocket = np.bincount(piece, self.area, pieces) < LARGEST * whole[of_layer]
        pocket[self._holding_loops(piece)] = False
        return pocket[piece]

    def _holding_loops(self, piece: NDArray) -> NDArray:
        """Pieces that hold all of an open border: sleeves, legs."""
        rim = self.loops >= 0
        loops = int(self.loops.max()) + 1
        key, held = np.unique(piece[rim] * loops + self.loops[rim], return_counts=True)
        return key[held == np.bincount(self.loops[rim])[key % loops]] // loops if len(key) else key


def border_numbers(rim: NDArray, vertices: int) -> NDArray:
    """(V,) number of the open border that each vertex lies on, -1 for none; ``rim`` (R, 2) the edges of one face."""
    links = sp.coo_matrix((np.ones(len(rim), np.int8), (rim[:, 0], rim[:, 1])), shape=(vertices, vertices))
    number = connected_components(links, directed=False)[1]
    loops = np.full(vertices, -1)
    on_rim = np.unique(rim)
    loops[on_rim] = np.unique(number[on_rim], return_inverse=True)[1]
    return loops


def film(
    x: NDArray, edges: NDArray, rim: NDArray, free: NDArray[np.bool_], drawn: NDArray[np.bool_] | None = None
) -> NDArray:
    """``x`` (V, 3) with the ``free`` vertices laid like a soap film across the held ones.

    Open borders (``rim``, (R, 2) edges) would be drawn in: they are only smoothed, along themselves. Where ``drawn``
    (V,) says so they are, and lie straight between the parts of the same border that are not.
    """
    out, on_rim = x.copy(), np.zeros(len(x), bool)
    on_rim[rim] = True
    straight = np.zeros(len(x), bool) if drawn is None else free & drawn & on_rim
    loops = border_numbers(rim, len(x))
    straight &= np.isin(loops, loops[on_rim & ~straight])  # something of that border must be left
    out = laid_across(out, rim, straight)
    ends = np.concatenate([rim, rim[:, ::-1]])
    ends = ends[(free & ~straight)[ends[:, 0]]]
    chosen, which, count = np.unique(ends[:, 0], return_inverse=True, return_counts=True)
    for _ in range(RIM_SMOOTHING if len(chosen) else 0):
        middle = np.zeros((len(chosen), 3))
        np.add.at(middle, which, out[ends[:, 1]])
        out[chosen] += 0.5 * (middle / count[:, None] - out[chosen])
    return laid_across(out, edges, free & ~on_rim)


def laid_across(x: NDArray, edges: NDArray, free: NDArray[np.bool_]) -> NDArray:
    """``x`` (V, 3) with the ``free`` vertices each in the middle of its neighbours, the others held."""
    touched = edges[free[edges].any(1)]
    if not len(touched):
        return x
    number = np.cumsum(free) - 1
    a, b = np.concatenate([touched, touched[:, ::-1]]).T
    a, b = a[free[a]], b[free[a]]
    count, inside = int(free.sum()), free[b]
    links = (np.ones(inside.sum()), (number[a[inside]], number[b[inside]]))
    matrix = sp.diags(np.bincount(number[a], minlength=count) + 1e-9) - sp.coo_matrix(links, shape=(count, count))
    held = 1e-9 * x[free]
    np.add.at(held, number[a[~inside]], x[b[~inside]])
    out = x.copy()
    out[free] = splu(sp.csc_matrix(matrix)).solve(held)
    return out
