"""The energies of many frames at once, for learning to drape: GAPS Eq. 9-12 and 15 with their gradients.

Each frame is one thread of a compiled kernel in doubles: on a CPU several times cheaper than automatic
differentiation, and the same code runs on a GPU. :mod:`recon.cloth.energies` and :mod:`recon.cloth.inextensible` are
the slow twins that tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from recon.cloth.elastic import Elastic, doubles, elastic, hinge, ints, membrane
from recon.cloth.energies import Cloth
from recon.cloth.inextensible import EPOCHS, OneRings

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
    inextensibility: float = 2.5e-5
    """Strength of Eq. 15 per vertex, see ``inextensible`` [J]; 0 leaves it out."""
    relax: bool = True
    """Whether k_ext follows Eq. 16; False keeps it at 1."""


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
    reach: float


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
def _ring(x: wp.array(dtype=wp.vec3d), g: wp.array(dtype=wp.vec3d), r: _Rings, i: int, factor: wp.float64):
    n = r.count[i]
    share = wp.float64(1.0) / wp.float64(n)
    middle = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for k in range(n):
        middle = middle + x[r.neighbours[i, k]]
    middle = middle * share
    # In units of the ring's size, so that determinants are about 1.
    unit = wp.float64(1.0) / r.size[i]
    c = wp.mat33d()
    for k in range(n):
        d = x[r.neighbours[i, k]] - middle
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
        j = r.neighbours[i, k]
        g[j] = g[j] + slope * (x[j] - middle) * scale
    return total * r.strength


@wp.kernel
def _evaluate(
    x: wp.array2d(dtype=wp.vec3d),
    g: wp.array2d(dtype=wp.vec3d),
    terms: wp.array2d(dtype=wp.float64),
    depths: wp.array2d(dtype=wp.float64),
    e: Elastic,
    r: _Rings,
    touch: _Touch,
):
    b = wp.tid()
    own = x[b]
    slope = g[b]
    strain = wp.float64(0.0)
    bending = wp.float64(0.0)
    gravity = wp.float64(0.0)
    collision = wp.float64(0.0)
    inext = wp.float64(0.0)
    for i in range(own.shape[0]):
        slope[i] = wp.vec3d(wp.float64(0.0), e.weights[i], wp.float64(0.0))
        gravity += e.weights[i] * own[i][1]
        p = wp.vec3(float(own[i][0]), float(own[i][1]), float(own[i][2]))
        hit = wp.mesh_query_point_sign_normal(touch.mesh[b], p, touch.reach)
        depth = wp.float64(0.0)
        if hit.result:
            on = wp.mesh_eval_position(touch.mesh[b], hit.face, hit.u, hit.v)
            normal = wp.mesh_eval_face_normal(touch.mesh[b], hit.face)
            away = p - on
            distance = wp.length(away)
            if distance > 1.0e-6:
                normal = away * (hit.sign / distance)
            depth = wp.max(touch.margin - wp.float64(distance * hit.sign), wp.float64(0.0))
            if depth > wp.float64(0.0):
                collision += touch.stiffness * depth * depth * depth
                push = wp.float64(-3.0) * touch.stiffness * depth * depth
                slope[i] = slope[i] + wp.vec3d(
                    wp.float64(normal[0]) * push, wp.float64(normal[1]) * push, wp.float64(normal[2]) * push
                )
        depths[b, i] = depth
    for t in range(e.faces.shape[0]):
        strain += membrane(own, slope, e, t)
    for k in range(e.hinges.shape[0]):
        bending += hinge(own, slope, e, k)
    if r.strength > wp.float64(0.0):
        for i in range(own.shape[0]):
            if r.size[i] > wp.float64(0.0):
                factor = wp.float64(1.0)
                if r.epoch > wp.float64(0.0):
                    factor += wp.min(wp.float64(10.0) * depths[b, i], wp.float64(0.03)) * r.epoch
                inext += _ring(own, slope, r, i, factor)
    terms[b, 0] = strain
    terms[b, 1] = bending
    terms[b, 2] = gravity
    terms[b, 3] = collision
    terms[b, 4] = inext


class FramePhysics:
    """Energies of B frames of one garment, each on a body of its own."""

    def __init__(self, cloth: Cloth, rings: OneRings, body_faces: Tensor, weights: FrameWeights, frames: int):
        """``body_faces`` (F, 3), outward; ``frames``: B, the same in every call. The device is the cloth's."""
        self.device = str(cloth.masses.device)
        self.elastic = elastic(cloth, self.device)
        self.weights, self.frames, self.vertices = weights, frames, len(cloth.masses)
        self.rings = _Rings()
        self.rings.neighbours = wp.array(ints(rings.neighbours), dtype=int, device=self.device)
        self.rings.count = wp.array(ints(rings.count), dtype=int, device=self.device)
        self.rings.singular = wp.array(doubles(rings.singular), dtype=wp.vec3d, device=self.device)
        self.rings.size = wp.array(doubles(rings.size), dtype=wp.float64, device=self.device)
        self.rings.strength = weights.inextensibility
        self.body_faces = wp.array(ints(body_faces).ravel(), dtype=int, device=self.device)
        self.meshes: list[wp.Mesh] = []
        self.touch = _Touch()
        self.touch.stiffness, self.touch.margin, self.touch.reach = weights.collision, weights.margin, weights.reach

    def __call__(self, x: Tensor, bodies: Tensor, epoch: float = EPOCHS) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted energies (B,) [J], differentiable in x, and each term (B,) by name.

        Args:
            x: (B, V, 3) garment [m].
            bodies: (B, N, 3) body vertices [m], no gradient.
            epoch: for Eq. 16.
        """
        if len(x) != self.frames or x.shape[1:] != (self.vertices, 3):
            raise ValueError(f"frames: x is {tuple(x.shape)}; wanted ({self.frames}, {self.vertices}, 3)")
        self._pose(bodies)
        self.rings.epoch = float(min(epoch, EPOCHS)) if self.weights.relax else 0.0
        energy, terms = _Energy.apply(x, self)
        return energy, {name: terms[:, k] for k, name in enumerate(TERMS)}

    def _pose(self, bodies: Tensor) -> None:
        """Body meshes are built once and refitted: poses differ, faces do not."""
        points = bodies.detach().float().contiguous()
        if not self.meshes:
            self.meshes = [wp.Mesh(wp.clone(wp.from_torch(p, dtype=wp.vec3)), self.body_faces) for p in points]
            ids = np.array([m.id for m in self.meshes], np.uint64)
            self.touch.mesh = wp.array(ids, dtype=wp.uint64, device=self.device)
            return
        for mesh, p in zip(self.meshes, points, strict=True):
            wp.copy(mesh.points, wp.from_torch(p, dtype=wp.vec3))
            mesh.refit()

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Terms (B, 5) and the gradient (B, V, 3) of their sum, doubles."""
        at = x.detach().double().contiguous()
        gradient = torch.empty_like(at)
        terms = torch.empty(len(at), len(TERMS), dtype=torch.float64, device=at.device)
        depths = torch.empty(at.shape[:2], dtype=torch.float64, device=at.device)
        inputs = [
            wp.from_torch(at, dtype=wp.vec3d),
            wp.from_torch(gradient, dtype=wp.vec3d),
            wp.from_torch(terms),
            wp.from_torch(depths),
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
