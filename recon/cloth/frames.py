"""The energies of many frames at once, for learning to drape: GAPS Eq. 9-12 and 15 with their gradients.

Each frame is one thread of a compiled kernel in doubles: on a CPU several times cheaper than automatic
differentiation, and the same code runs on a GPU. :mod:`recon.cloth.energies` and :mod:`recon.cloth.inextensible` are
the slow twins that tests compare with.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from recon.cloth.elastic import Elastic, doubles, elastic, hinge, ints, membrane
from recon.cloth.energies import Cloth
from recon.cloth.inextensible import EPOCHS, OneRings
from recon.types import Mesh

wp.set_module_options({"enable_backward": False})

TERMS = ("strain", "bending", "gravity", "collision", "inextensibility")


@dataclass(frozen=True)
class FrameWeights:
    """How the terms are weighed."""

    collision: float = 250.0
    """k_c of Eq. 11 [J/m³ per vertex]."""
    margin: float = 0.002
    """epsilon of Eq. 11: distance from the body at which collision begins [m]."""
    reach: float = 0.05
    """Vertices deeper inside the body than this are not found [m]."""
    steep: float = 0.01
    """Depth from which on Eq. 11 grows no faster [m]: where limbs meet there is no room for cloth, and what can't be
    helped must not outweigh the rest."""
    deep_share: int = 1
    """Vertices out of the margin's reach are asked whether they are deep inside in one call of so many, in turn, and
    count as often: most are far outside, and asking is what takes longest."""
    inextensibility: float = 2.5e-5
    """Strength of Eq. 15 per vertex, see ``inextensible`` [J]; 0 leaves it out."""
    relax: bool = True
    """Whether k_ext follows Eq. 16; False keeps it at 1. Cloth at rest on the skin keeps the margin only just: what
    counts for Eq. 16 is how deep it is inside the body itself."""


@wp.struct
class _Rings:
    neighbours: wp.array2d(dtype=int)
    count: wp.array(dtype=int)
    singular: wp.array(dtype=wp.vec3d)
    size: wp.array(dtype=wp.float64)
    strength: wp.float64
    epoch: wp.float64


@wp.struct
class _Touch:
    mesh: wp.array(dtype=wp.uint64)
    stiffness: wp.float64
    margin: wp.float64
    steep: wp.float64
    reach: float
    turn: int
    turns: int


@wp.func
def _adjugate(m: wp.mat33d):
    a = wp.vec3d(m[0, 0], m[0, 1], m[0, 2])
    b = wp.vec3d(m[1, 0], m[1, 1], m[1, 2])
    c = wp.vec3d(m[2, 0], m[2, 1], m[2, 2])
    # Rows of the cofactor matrix; m is symmetric, and so is this.
    p = wp.cross(b, c)
    q = wp.cross(c, a)
    r = wp.cross(a, b)
    return wp.mat33d(p[0], p[1], p[2], q[0], q[1], q[2], r[0], r[1], r[2])


@wp.func
def _ring(x: wp.array(dtype=wp.vec3d), g: wp.array(dtype=wp.vec3d), r: _Rings, i: int, first: int, factor: wp.float64):
    n = r.count[i]
    share = wp.float64(1.0) / wp.float64(n)
    middle = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for k in range(n):
        middle = middle + x[first + r.neighbours[i, k]]
    middle = middle * share
    # In units of the ring's size, so that determinants are about 1.
    unit = wp.float64(1.0) / r.size[i]
    c = wp.mat33d()
    for k in range(n):
        d = x[first + r.neighbours[i, k]] - middle
        c = c + wp.outer(d, d) * (share * unit)
    total = wp.float64(0.0)
    slope = wp.mat33d()
    s = r.singular[i]
    for k in range(3):
        off = factor * s[k] * unit
        m = c
        m[0, 0] = c[0, 0] - off
        m[1, 1] = c[1, 1] - off
        m[2, 2] = c[2, 2] - off
        det = wp.determinant(m)
        total += wp.abs(det)
        slope = slope + _adjugate(m) * wp.sign(det)
    scale = wp.float64(2.0) * share * unit * r.strength
    for k in range(n):
        j = first + r.neighbours[i, k]
        g[j] = g[j] + slope * (x[j] - middle) * scale
    return total * r.strength


@wp.func
def _collide(p: wp.vec3d, touch: _Touch, b: int, i: int):
    """Energy, depth, and force along the way out of one vertex."""
    at = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    often = wp.float64(1.0)
    hit = wp.mesh_query_point_sign_normal(touch.mesh[b], at, float(touch.margin))
    if not hit.result and (i + touch.turn) % touch.turns == 0:
        often = wp.float64(touch.turns)
        hit = wp.mesh_query_point_sign_normal(touch.mesh[b], at, touch.reach)
    depth = wp.float64(0.0)
    energy = wp.float64(0.0)
    force = wp.vec3d(depth, depth, depth)
    if hit.result:
        on = wp.mesh_eval_position(touch.mesh[b], hit.face, hit.u, hit.v)
        normal = wp.mesh_eval_face_normal(touch.mesh[b], hit.face)
        distance = wp.length(at - on)
        if distance > 1.0e-6:
            normal = (at - on) * (hit.sign / distance)
        depth = wp.max(touch.margin - wp.float64(distance * hit.sign), wp.float64(0.0))
        cubic = wp.min(depth, touch.steep)
        push = wp.float64(3.0) * touch.stiffness * cubic * cubic * often
        energy = touch.stiffness * cubic * cubic * cubic * often + push * (depth - cubic)
        force = wp.vec3d(wp.float64(normal[0]) * push, wp.float64(normal[1]) * push, wp.float64(normal[2]) * push)
    return energy, depth, force


@wp.kernel
def _evaluate(
    x: wp.array(dtype=wp.vec3d),
    g: wp.array(dtype=wp.vec3d),
    terms: wp.array2d(dtype=wp.float64),
    depths: wp.array(dtype=wp.float64),
    e: Elastic,
    r: _Rings,
    touch: _Touch,
):
    b = wp.tid()
    count = e.weights.shape[0]
    first = b * count
    strain = wp.float64(0.0)
    bending = wp.float64(0.0)
    gravity = wp.float64(0.0)
    collision = wp.float64(0.0)
    inext = wp.float64(0.0)
    for i in range(count):
        k = first + i
        gravity += e.weights[i] * x[k][1]
        energy, depth, force = _collide(x[k], touch, b, i)
        collision += energy
        depths[k] = depth
        g[k] = wp.vec3d(wp.float64(0.0), e.weights[i], wp.float64(0.0)) - force
    for t in range(e.faces.shape[0]):
        strain += membrane(x, g, e, t, first)
    for h in range(e.hinges.shape[0]):
        bending += hinge(x, g, e, h, first)
    if r.strength > wp.float64(0.0):
        for i in range(count):
            if r.size[i] > wp.float64(0.0):
                factor = wp.float64(1.0)
                if r.epoch > wp.float64(0.0):
                    inside = wp.max(depths[first + i] - touch.margin, wp.float64(0.0))
                    factor += wp.min(wp.float64(10.0) * inside, wp.float64(0.03)) * r.epoch
                inext += _ring(x, g, r, i, first, factor)
    terms[b, 0] = strain
    terms[b, 1] = bending
    terms[b, 2] = gravity
    terms[b, 3] = collision
    terms[b, 4] = inext


class FramePhysics:
    """Energies of B frames of one garment, each on a body of its own."""

    def __init__(self, cloth: Cloth, rings: OneRings, body: Mesh, weights: FrameWeights, frames: int):
        """
        Args:
            cloth: the garment; its device is the energies'.
            rings: of the template.
            body: at rest, limbs apart, faces outward: what the search for contacts is built on.
            weights: see :class:`FrameWeights`.
            frames: B, the same in every call.
        """
        self.device = str(cloth.masses.device)
        self.weights, self.frames = weights, frames
        self._wear(cloth, rings)
        indices = wp.array(ints(body.faces).ravel(), dtype=int, device=self.device)
        rest = wp.from_torch(body.vertices.detach().float().contiguous(), dtype=wp.vec3)
        # Built on the body at rest and refitted: built on a pose, a hand at the hip would share its box for good.
        self.meshes = [wp.Mesh(wp.clone(rest), indices) for _ in range(frames)]
        self.touch = _Touch()
        ids = np.array([m.id for m in self.meshes], np.uint64)
        self.touch.mesh = wp.array(ids, dtype=wp.uint64, device=self.device)
        self.touch.stiffness, self.touch.margin, self.touch.reach = weights.collision, weights.margin, weights.reach
        self.touch.steep, self.touch.turns = weights.steep, weights.deep_share

    def dressed(self, cloth: Cloth, rings: OneRings) -> FramePhysics:
        """The same for another garment on the same bodies: posing them for one poses them for both."""
        other = copy.copy(self)
        other._wear(cloth, rings)
        return other

    def _wear(self, cloth: Cloth, rings: OneRings) -> None:
        self.elastic = elastic(cloth, self.device)
        self.vertices = len(cloth.masses)
        self.rings = _Rings()
        self.rings.neighbours = wp.array(ints(rings.neighbours), dtype=int, device=self.device)
        self.rings.count = wp.array(ints(rings.count), dtype=int, device=self.device)
        self.rings.singular = wp.array(doubles(rings.singular), dtype=wp.vec3d, device=self.device)
        self.rings.size = wp.array(doubles(rings.size), dtype=wp.float64, device=self.device)
        self.rings.strength = self.weights.inextensibility

    def __call__(
        self, x: Tensor, bodies: Tensor | None = None, epoch: float = EPOCHS
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted energies (B,) [J], differentiable in x, and each term (B,) by name.

        Args:
            x: (B, V, 3) garment [m].
            bodies: (B, N, 3) body vertices [m], no gradient; None = where they were last posed.
            epoch: for Eq. 16.
        """
        if len(x) != self.frames or x.shape[1:] != (self.vertices, 3):
            raise ValueError(f"frames: x is {tuple(x.shape)}; wanted ({self.frames}, {self.vertices}, 3)")
        if bodies is not None:
            self.pose(bodies)
        self.touch.turn = (self.touch.turn + 1) % self.touch.turns
        self.rings.epoch = float(min(epoch, EPOCHS)) if self.weights.relax else 0.0
        energy, terms = _Energy.apply(x, self)
        return energy, {name: terms[:, k] for k, name in enumerate(TERMS)}

    def pose(self, bodies: Tensor) -> None:
        """Put the bodies (B, N, 3) [m] where they are."""
        for mesh, p in zip(self.meshes, bodies.detach().float().contiguous(), strict=True):
            wp.copy(mesh.points, wp.from_torch(p, dtype=wp.vec3))
            mesh.refit()

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Terms (B, 5) and the gradient (B, V, 3) of their sum, doubles."""
        at = x.detach().double().contiguous()
        gradient = torch.empty_like(at)
        terms = torch.empty(len(at), len(TERMS), dtype=torch.float64, device=at.device)
        depths = torch.empty(at.shape[:2], dtype=torch.float64, device=at.device)
        inputs = [
            wp.from_torch(at.view(-1, 3), dtype=wp.vec3d),
            wp.from_torch(gradient.view(-1, 3), dtype=wp.vec3d),
            wp.from_torch(terms),
            wp.from_torch(depths.view(-1)),
            self.elastic,
            self.rings,
            self.touch,
        ]
        wp.launch(_evaluate, len(at), inputs=inputs, device=self.device)
        return terms, gradient


class _Energy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, physics: FramePhysics) -> tuple[Tensor, Tensor]:
        terms, gradient = physics.evaluate(x)
        ctx.save_for_backward(gradient.to(x.dtype))
        ctx.mark_non_differentiable(terms)
        return terms.sum(1).to(x.dtype), terms

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return ctx.saved_tensors[0] * grads[0][:, None, None], None
