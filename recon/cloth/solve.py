"""Quasi-static rest of a garment on a body: minimise elastic energy, gravity and contact by L-BFGS.

Energy and gradient are those of :mod:`recon.cloth.energies` (tests compare them), in one compiled kernel in doubles
on one thread: the digits suffice for a line search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import scipy.sparse as sp
import warp as wp
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsv
from scipy.sparse.linalg import splu

from recon.cloth.constraints import Constraints, close_strangers, held_height
from recon.cloth.contact import BodyContact
from recon.cloth.elastic import Elastic, elastic, hinge, membrane
from recon.cloth.energies import Cloth

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

DEVICE = "cpu"


@dataclass(frozen=True)
class PolishSettings:
    """A short minimisation that takes a simulator's last ripples out."""

    rounds: int = 5
    """Contact is searched anew this often."""
    iterations: int = 30
    """L-BFGS iterations per round."""
    offset: float = 0.0035
    """Distance kept from the body [m]."""
    reach: float = 0.03
    """Vertices closer than this to the body can come in contact during a round [m]."""
    stiffness: float = 8e3
    """Stiffness of all contacts and holds [N/m per vertex]."""
    slip: float = 2e-4
    """Way over which friction builds up [m]: what it holds creeps by less than this."""
    apart: float = 0.006
    """Distance that vertices far apart in the pattern keep [m]."""
    middle: float = 0.001
    """Distance that legs keep from the body's middle plane [m]."""


def _rows(width: int, kind: type = float):
    shape = (0, width) if width else (0,)
    return field(default_factory=lambda: np.zeros(shape, kind))


@dataclass(frozen=True)
class Contacts:
    """What touches what, found once and kept for some iterations; distances are those of ``PolishSettings``."""

    vertex: NDArray = _rows(0, int)
    """(K,) vertices that stay above a plane."""
    point: NDArray = _rows(3)
    """(K, 3) a point of each plane [m]."""
    normal: NDArray = _rows(3)
    """(K, 3) unit normals: the side where the vertex belongs."""
    stuck: NDArray = _rows(4, int)
    """(A, 4) a vertex that friction holds, and the corners of the cloth's face that it is held to."""
    share: NDArray = _rows(3)
    """(A, 3) barycentric weights of the point of that face; zeros: it is held to what never moves."""
    anchor: NDArray = _rows(3)
    """(A, 3) where it would be held, from that point on [m]."""
    across: NDArray = _rows(3)
    """(A, 3) unit normals: friction acts across them."""
    grip: NDArray = _rows(0)
    """(A,) the most that it holds each with: its coefficient times the normal force [N]."""
    pair: NDArray = _rows(2, int)
    """(P, 2) vertices kept apart."""
    apart: NDArray = _rows(0)
    """(P,) the distance that they keep [m]."""
    over: NDArray = _rows(4, int)
    """(O, 4) a vertex, and the corners of the cloth's face that it lies over."""
    weights: NDArray = _rows(3)
    """(O, 3) barycentric weights of the point of that face."""
    direction: NDArray = _rows(3)
    """(O, 3) unit vectors: the side of the face where the vertex belongs."""

    def along(self, x: NDArray) -> NDArray:
        """(A, 3) how far cloth at ``x`` (V, 3) has slid from where friction would hold it [m]."""
        held = np.einsum("ak,aki->ai", self.share, x[self.stuck[:, 1:]])
        way = x[self.stuck[:, 0]] - held - self.anchor
        return way - self.across * (way * self.across).sum(1, keepdims=True)

    @staticmethod
    def join(parts: Sequence[Contacts]) -> Contacts:
        """All contacts of all parts."""
        return Contacts(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Contacts)))


@wp.struct
class _Contacts:
    vertex: wp.array(dtype=int)
    point: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    stuck: wp.array(dtype=wp.vec4i)
    share: wp.array(dtype=wp.vec3d)
    anchor: wp.array(dtype=wp.vec3d)
    across: wp.array(dtype=wp.vec3d)
    grip: wp.array(dtype=wp.float64)
    slip: wp.float64
    pair: wp.array(dtype=wp.vec2i)
    apart: wp.array(dtype=wp.float64)
    over: wp.array(dtype=wp.vec4i)
    weights: wp.array(dtype=wp.vec3d)
    direction: wp.array(dtype=wp.vec3d)
    offset: wp.float64
    stiffness: wp.float64


@wp.kernel
def _evaluate(
    x: wp.array(dtype=wp.vec3d), g: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.float64), e: Elastic, c: _Contacts
):
    total = wp.float64(0.0)
    for i in range(x.shape[0]):
        g[i] = wp.vec3d(wp.float64(0.0), e.weights[i], wp.float64(0.0))
        total += e.weights[i] * x[i][1]
    for t in range(e.faces.shape[0]):
        total += membrane(x, g, e, t, 0)
    for k in range(e.hinges.shape[0]):
        total += hinge(x, g, e, k, 0)
    two = wp.float64(2.0)
    for k in range(c.vertex.shape[0]):
        i = c.vertex[k]
        depth = c.offset - wp.dot(x[i] - c.point[k], c.normal[k])
        if depth > wp.float64(0.0):
            total += c.stiffness * depth * depth
            g[i] = g[i] - c.normal[k] * (two * c.stiffness * depth)
    for k in range(c.stuck.shape[0]):
        o = c.stuck[k]
        w = c.share[k]
        along = x[o[0]] - x[o[1]] * w[0] - x[o[2]] * w[1] - x[o[3]] * w[2] - c.anchor[k]
        along = along - c.across[k] * wp.dot(along, c.across[k])
        way = wp.length(along)
        pull = along * (c.grip[k] / wp.max(way, c.slip))
        if way < c.slip:
            total += c.grip[k] * way * way / (two * c.slip)
        else:
            total += c.grip[k] * (way - wp.float64(0.5) * c.slip)
        g[o[0]] = g[o[0]] + pull
        g[o[1]] = g[o[1]] - pull * w[0]
        g[o[2]] = g[o[2]] - pull * w[1]
        g[o[3]] = g[o[3]] - pull * w[2]
    for k in range(c.pair.shape[0]):
        p = c.pair[k]
        away = x[p[0]] - x[p[1]]
        distance = wp.length(away)
        depth = c.apart[k] - distance
        if depth > wp.float64(0.0) and distance > wp.float64(1.0e-9):
            total += c.stiffness * depth * depth
            push = away * (two * c.stiffness * depth / distance)
            g[p[0]] = g[p[0]] - push
            g[p[1]] = g[p[1]] + push
    for k in range(c.over.shape[0]):
        o = c.over[k]
        w = c.weights[k]
        below = x[o[1]] * w[0] + x[o[2]] * w[1] + x[o[3]] * w[2]
        depth = c.offset - wp.dot(x[o[0]] - below, c.direction[k])
        if depth > wp.float64(0.0):
            total += c.stiffness * depth * depth
            push = c.direction[k] * (two * c.stiffness * depth)
            g[o[0]] = g[o[0]] - push
            g[o[1]] = g[o[1]] + push * w[0]
            g[o[2]] = g[o[2]] + push * w[1]
            g[o[3]] = g[o[3]] + push * w[2]
    out[0] = total


class ElasticEnergy:
    """Energy [J] and gradient [N] of a cloth under gravity, with the contacts set by :meth:`touch`."""

    def __init__(self, cloth: Cloth):
        self.elastic = elastic(cloth, DEVICE)
        count = len(cloth.masses)
        self.x = wp.zeros(count, dtype=wp.vec3d, device=DEVICE)
        self.gradient = wp.zeros(count, dtype=wp.vec3d, device=DEVICE)
        self.out = wp.zeros(1, dtype=wp.float64, device=DEVICE)
        self.touch(Contacts(), PolishSettings())

    def touch(self, contacts: Contacts, s: PolishSettings) -> None:
        """Set what is in contact, and at which distances."""

        def doubles(a: NDArray, dtype):
            return wp.array(np.ascontiguousarray(a, np.float64), dtype=dtype, device=DEVICE)

        c = _Contacts()
        c.vertex = wp.array(contacts.vertex.astype(np.int32), dtype=int, device=DEVICE)
        c.point, c.normal = doubles(contacts.point, wp.vec3d), doubles(contacts.normal, wp.vec3d)
        c.stuck = wp.array(contacts.stuck.astype(np.int32), dtype=wp.vec4i, device=DEVICE)
        c.share, c.anchor = doubles(contacts.share, wp.vec3d), doubles(contacts.anchor, wp.vec3d)
        c.across, c.grip = doubles(contacts.across, wp.vec3d), doubles(contacts.grip, wp.float64)
        c.slip = s.slip
        c.pair = wp.array(contacts.pair.astype(np.int32), dtype=wp.vec2i, device=DEVICE)
        c.apart = doubles(contacts.apart, wp.float64)
        c.over = wp.array(contacts.over.astype(np.int32), dtype=wp.vec4i, device=DEVICE)
        c.weights, c.direction = doubles(contacts.weights, wp.vec3d), doubles(contacts.direction, wp.vec3d)
        c.offset, c.stiffness = s.offset, s.stiffness
        self.contacts = c

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        """Energy and gradient (V, 3) at positions (V, 3)."""
        self.x.numpy()[:] = x
        inputs = [self.x, self.gradient, self.out, self.elastic, self.contacts]
        wp.launch(_evaluate, 1, inputs=inputs, device=DEVICE)
        return float(self.out.numpy()[0]), self.gradient.numpy().copy()


def polish(
    cloth: Cloth, start: NDArray, contact: BodyContact, limits: Constraints, settings: PolishSettings | None = None
) -> NDArray:
    """(V, 3) positions near ``start`` (V, 3) [m] that minimise the cloth's energy on the body."""
    s = settings or PolishSettings()
    energy, x = ElasticEnergy(cloth), np.array(start, np.float64)
    level = held_height(x, limits.held)
    for _ in range(s.rounds):
        close = contact.nearest(x, s.reach)
        planes = Contacts(vertex=close.rows, point=close.point, normal=close.outward)
        pairs = close_strangers(x, limits.rest, s.apart)
        apart = Contacts(pair=pairs, apart=np.full(len(pairs), s.apart))
        energy.touch(Contacts.join([planes, *_holds(x, limits, level, s), apart]), s)
        x = lbfgs(energy, x, s.iterations)
    return x


def _holds(x: NDArray, limits: Constraints, level: float, s: PolishSettings):
    """Waistband and legs as contact planes: two facing planes hold a height, one keeps a leg on its side."""
    held = limits.held
    for direction in (1.0, -1.0):
        normal = np.tile([0.0, direction, 0.0], (len(held), 1))
        point = np.tile([0.0, level - direction * s.offset, 0.0], (len(held), 1))
        yield Contacts(vertex=held, point=point, normal=normal)
    if limits.side is not None:
        legs = np.flatnonzero(limits.side)
        normal = np.column_stack([limits.side[legs], np.zeros((len(legs), 2))])
        yield Contacts(vertex=legs, point=normal * (s.middle - s.offset), normal=normal)


def edge_laplacian(cloth: Cloth) -> sp.csr_matrix:
    """(V, V) combinatorial Laplacian of the cloth's edges."""
    edges, count = cloth.edges.numpy(), len(cloth.masses)
    half = sp.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    both = (half + half.T).tocsr()
    return sp.diags(np.asarray(both.sum(1)).ravel()) - both


def springs(cloth: Cloth, laplacian: sp.csr_matrix, diagonal: NDArray) -> Callable[[NDArray], NDArray]:
    """Multiplies (V, 3) by the inverse of a stand-in for the Hessian: springs along edges, ``diagonal`` (V,) [N/m]."""
    fabric = cloth.fabric
    spring = fabric.thickness * (2 * fabric.lame_mu + fabric.lame_lambda)
    matrix = (spring * laplacian + sp.diags(diagonal + 0.02 * spring)).tocsc()
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve


def lbfgs(
    function: Callable[[NDArray], tuple[float, NDArray]],
    x: NDArray,
    iterations: int,
    memory: int = 10,
    precondition: Callable[[NDArray], NDArray] | None = None,
    longest: float = 0.005,
    tolerance: float = 0.0,
) -> NDArray:
    """Minimise by L-BFGS with backtracking (Nocedal & Wright, algorithms 7.4, 3.1); never ends higher than it began.

    Args:
        function: x -> value and gradient.
        x: the start, any shape.
        iterations: most steps taken.
        memory: pairs kept.
        precondition: multiplies by an inverse stand-in for the Hessian; without it, a multiple of the identity.
        longest: with ``precondition``, no entry of x moves further than this in one step.
        tolerance: stop when no entry of the gradient is larger than this.
    """
    value, gradient = function(x)
    pairs = _Pairs(memory, x.size)
    for _ in range(iterations):
        if np.abs(gradient).max(initial=0.0) <= tolerance:
            break
        direction = -pairs.times(gradient, precondition)
        slope = float(np.vdot(direction, gradient))
        if slope >= 0:
            pairs = _Pairs(memory, x.size)
            direction = -pairs.times(gradient, precondition)
            slope = float(np.vdot(direction, gradient))
        reach = max(float(np.abs(direction).max()), 1e-30)
        # The first plain step has no scale yet: a tenth of a millimetre at most.
        bound = longest if precondition is not None else (np.inf if pairs.rows else 1e-4)
        length = min(1.0, bound / reach)
        for _ in range(12):
            new = x + length * direction
            new_value, new_gradient = function(new)
            if new_value <= value + 1e-4 * length * slope:
                break
            length *= 0.4
        else:
            return x
        pairs.add((new - x).ravel(), (new_gradient - gradient).ravel())
        x, value, gradient = new, new_value, new_gradient
    return x


class _Pairs:
    """Steps s and the gradient's changes y over them: L-BFGS' two loops as products with whole matrices.

    With R the upper triangle of s_i . y_j, oldest first, the first loop solves R alpha = S g, the second
    R^T c = D alpha - Y r: the same numbers, at a fraction of the time that pair after pair takes.
    """

    def __init__(self, memory: int, size: int):
        self.s, self.y, self.products = np.zeros((memory, size)), np.zeros((memory, size)), np.zeros((memory, memory))
        self.rows: list[int] = []
        """Rows in use, oldest first."""

    def add(self, s: NDArray, y: NDArray) -> None:
        """Keep a pair, in the place of the oldest if need be; dropped where the function does not curve upward."""
        if np.dot(s, y) <= 1e-12 * np.dot(y, y):
            return
        row = len(self.rows) if len(self.rows) < len(self.s) else self.rows.pop(0)
        self.s[row], self.y[row] = s, y
        self.products[row], self.products[:, row] = self.y @ s, self.s @ y
        self.rows.append(row)

    def times(self, gradient: NDArray, precondition: Callable[[NDArray], NDArray] | None) -> NDArray:
        """The inverse Hessian's stand-in times a gradient of any shape."""
        used, rows = slice(len(self.rows)), self.rows
        if not rows:
            return gradient if precondition is None else precondition(gradient)
        upper = self.products[np.ix_(rows, rows)]
        alpha, c = np.zeros(len(self.s)), np.zeros(len(self.s))
        alpha[rows] = dtrsv(upper, (self.s[used] @ gradient.ravel())[rows])
        q = (gradient.ravel() - alpha[used] @ self.y[used]).reshape(gradient.shape)
        if precondition is not None:
            q = precondition(q)
        else:
            newest = rows[-1]
            q *= self.products[newest, newest] / np.dot(self.y[newest], self.y[newest])
        right = np.diag(upper) * alpha[rows] - (self.y[used] @ q.ravel())[rows]
        c[rows] = dtrsv(upper, right, trans=1)
        return q + (c[used] @ self.s[used]).reshape(gradient.shape)
