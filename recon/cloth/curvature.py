"""A positive stand-in for the Hessian of cloth: what L-BFGS measures steps by, near where it was made.

The membrane's Hessian with its stresses' negative parts left out (what is pressed together pushes nowhere), bending
without the angle's second derivative (Gauss and Newton), contacts and friction as they are, and a little inertia, so
that cloth that hangs on nothing falls no further than it would in ``LONG``. Compare Teran et al. 2005, "Robust
Quasistatic Finite Elements and Flesh Simulation", and Liu et al. 2017, whose L-BFGS starts from such a matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from recon.cloth.elastic import doubles
from recon.cloth.energies import Cloth
from recon.cloth.solve import Contacts, PolishSettings

LONG = 0.3
"""A step of cloth that nothing holds is how far it falls in this time [s]."""

Blocks = tuple[NDArray, NDArray]
"""(K, n) vertices, and (K, n, n, 3, 3) what each pair of them adds [N/m]."""


class Curvature:
    """The stand-in of one cloth."""

    def __init__(self, cloth: Cloth):
        """``cloth``: in double precision, on the CPU."""
        self.fabric = cloth.fabric
        self.faces, self.hinges = cloth.faces.numpy(), cloth.hinges.numpy()
        i = doubles(cloth.inverse)
        self.ways = [np.column_stack([-i[:, 0, k] - i[:, 1, k], i[:, 0, k], i[:, 1, k]]) for k in (0, 1)]
        """Two of (F, 3): what the corners add to each column of the deformation gradient."""
        self.volumes = doubles(cloth.areas) * cloth.fabric.thickness
        self.bending = 2 * cloth.fabric.bending * doubles(cloth.hinge_weights)
        self.inertia = doubles(cloth.masses) / LONG**2
        self.edges = cloth.edges.numpy()
        self.spring = cloth.fabric.thickness * (2 * cloth.fabric.lame_mu + cloth.fabric.lame_lambda)
        count = len(cloth.masses)
        self.pattern = Pattern([self.faces, self.hinges, self.edges, np.arange(count)[:, None]], count)

    def solve(
        self, x: NDArray, contacts: Contacts, settings: PolishSettings, held: NDArray, firm: float
    ) -> Callable[[NDArray], NDArray]:
        """Multiplies (V, 3) by the inverse of the stand-in at ``x`` (V, 3); ``held`` vertices do not move.

        ``firm``: stiffness of springs along the edges that are added, in units of the membrane's: out of its plane
        flat cloth is stiff only once it has moved, and steps that don't know that are too long.
        """
        link = np.array([[1.0, -1.0], [-1.0, 1.0]])[None, :, :, None, None] * (firm * self.spring * np.eye(3))
        diagonal = self.inertia + 1e-9 * self.spring
        diagonal[held] = 1e3 * self.spring
        springs = np.broadcast_to(link, (len(self.edges), 2, 2, 3, 3))
        matrix = self.pattern([self._membrane(x), self._bends(x), springs, diagonal[:, None, None] * np.eye(3)])
        touching = [(v, b) for v, b in _touching(x, contacts, settings) if len(v)]
        if touching:
            matrix = matrix + Pattern([v for v, _ in touching], len(x))([b for _, b in touching])
        # Single precision: a third less time, and hardly more steps; the energy itself is in doubles.
        matrix = matrix.astype(np.float32)
        factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

        def times(q: NDArray) -> NDArray:
            out = factors.solve(q.ravel().astype(np.float32)).reshape(q.shape).astype(np.float64)
            out[held] = 0
            return out

        return times

    def _membrane(self, x: NDArray) -> NDArray:
        corners, (a, b) = x[self.faces], self.ways
        u, v = np.einsum("fk,fki->fi", a, corners), np.einsum("fk,fki->fi", b, corners)
        uu, vv, uv = 0.5 * ((u * u).sum(1) - 1), 0.5 * ((v * v).sum(1) - 1), 0.5 * (u * v).sum(1)
        mu, lam = self.fabric.lame_mu, self.fabric.lame_lambda
        of_uu, of_vv = a[..., None] * u[:, None], b[..., None] * v[:, None]
        of_uv = 0.5 * (a[..., None] * v[:, None] + b[..., None] * u[:, None])
        flat = np.stack([of_uu, of_vv, of_uv], 1).reshape(-1, 3, 9)  # with each corner
        stiff = np.array([[2 * mu + lam, lam, 0], [lam, 2 * mu + lam, 0], [0, 0, 4 * mu]])
        blocks = (flat.transpose(0, 2, 1) @ (stiff @ flat)).reshape(-1, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4)
        trace = lam * (uu + vv)
        stress = np.stack([2 * mu * uu + trace, 2 * mu * uv, 2 * mu * uv, 2 * mu * vv + trace], 1).reshape(-1, 2, 2)
        size, axes = np.linalg.eigh(stress)
        pulled = (axes * np.maximum(size, 0)[:, None]) @ axes.transpose(0, 2, 1)
        ways = np.stack([a, b], 1)
        blocks = blocks + (ways.transpose(0, 2, 1) @ pulled @ ways)[..., None, None] * np.eye(3)
        return blocks * self.volumes[:, None, None, None, None]

    def _bends(self, x: NDArray) -> NDArray:
        change = angle_changes(x, self.hinges)
        return (self.bending[:, None, None] * change)[:, :, None, :, None] * change[:, None, :, None, :]


def angle_changes(x: NDArray, hinges: NDArray) -> NDArray:
    """(H, 4, 3) gradients of the dihedral angles of ``hinges`` (H, 4), 0 where degenerate (Bridson et al. 2003)."""
    a, b, c, d = (x[hinges[:, k]] for k in range(4))
    edge = b - a
    left, right = np.cross(edge, c - a), np.cross(d - a, edge)
    ll, rr, length = (left * left).sum(1), (right * right).sum(1), np.linalg.norm(edge, axis=1)
    sound = ((ll * rr > 1e-26) & (length > 1e-6))[:, None]
    safe = np.where(sound[:, 0], length, 1.0)
    nl, nr = (np.where(sound, n / np.where(sound, s[:, None], 1.0), 0.0) for n, s in ((left, ll), (right, rr)))

    def share(p: NDArray, q: NDArray, end: NDArray, sign: float) -> NDArray:
        along = [sign * ((o - end) * edge).sum(1)[:, None] / safe[:, None] for o in (p, q)]
        return nl * along[0] + nr * along[1]

    return np.stack([share(c, d, b, -1.0), share(c, d, a, 1.0), -nl * length[:, None], -nr * length[:, None]], 1)


def _touching(x: NDArray, c: Contacts, s: PolishSettings) -> list[Blocks]:
    """What contacts that press, and friction, add."""
    depth = s.offset - ((x[c.vertex] - c.point) * c.normal).sum(1)
    on = depth > 0
    found = [(c.vertex[on, None], 2 * s.stiffness * _outer(c.normal[on])[:, None, None])]
    below = np.einsum("ok,oki->oi", c.weights, x[c.over[:, 1:]])
    on = s.offset - ((x[c.over[:, 0]] - below) * c.direction).sum(1) > 0
    found.append(_between(c.over[on], c.weights[on], 2 * s.stiffness * _outer(c.direction[on])))
    along = c.along(x)
    way = np.linalg.norm(along, axis=1)
    flat = np.eye(3) - _outer(c.across)
    slid = way > s.slip
    flat[slid] -= _outer(along[slid] / way[slid, None])
    found.append(_between(c.stuck, c.share, (c.grip / np.maximum(way, s.slip))[:, None, None] * flat))
    return found


def _outer(n: NDArray) -> NDArray:
    return n[:, :, None] * n[:, None, :]


def _between(vertices: NDArray, weights: NDArray, stiff: NDArray) -> Blocks:
    """A vertex against a point of a face, of stiffness (K, 3, 3) towards each other."""
    way = np.column_stack([np.ones(len(weights)), -weights])
    return vertices, (way[:, :, None] * way[:, None, :])[..., None, None] * stiff[:, None, None]


class Pattern:
    """Where the blocks of a symmetric matrix go; found once, and filled as often as needed."""

    def __init__(self, corners: Sequence[NDArray], vertices: int):
        """``corners``: of each part, (K, n) vertices; ``vertices``: V."""
        row = np.concatenate([np.repeat(v, v.shape[1], 1).ravel() for v in corners])
        column = np.concatenate([np.tile(v, (1, v.shape[1])).ravel() for v in corners])
        key, which = np.unique(row * vertices + column, return_inverse=True)
        ones, at = np.ones(len(which)), np.arange(len(which))
        self.sums = sp.csr_matrix((ones, (which.reshape(-1), at)), shape=(len(key), len(which)))
        self.columns, self.size = key % vertices, 3 * vertices
        self.starts = np.searchsorted(key // vertices, np.arange(vertices + 1))

    def __call__(self, blocks: Sequence[NDArray]) -> sp.csc_matrix:
        """(3 V, 3 V) sum of each part's blocks (K, n, n, 3, 3)."""
        data = (self.sums @ np.concatenate([b.reshape(-1, 9) for b in blocks])).reshape(-1, 3, 3)
        return sp.bsr_matrix((data, self.columns, self.starts), shape=(self.size, self.size)).tocsr().T
