"""Projective steps: a draped guess, drawn near the lengths that cloth keeps, and out of the body, in a few fixed steps.

A network says at low cost where cloth hangs; what it leaves is local: triangles stretched by a few per cent, vertices a
few millimetres in the skin. Each step lets every triangle say which undeformed one is nearest to it (local, closed
form), finds the vertices that suit all of them and the guess (global, one sparse matrix, factored once a garment:
projective dynamics, Bouaziz et al. 2014, without inertia), and puts what is inside the body on its surface. There is no
state from frame to frame and nothing learned: a layer after the network, of a cost known beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from torch import Tensor

from recon.cloth.elastic import doubles, ints
from recon.cloth.energies import Cloth
from recon.types import PosedBody

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

DEVICE = "cpu"
HELD = 1e4
"""Weight that keeps held vertices at the guess, in units of ``anchor``'s."""
FLATTEST = 1e-6
"""Triangles thinner than this share of their rest area have no side that is known."""


@dataclass(frozen=True)
class Projecting:
    """How projective steps are taken."""

    steps: int = 6
    """How many."""
    anchor: float = 10.0
    """Pull towards the guess against the cloth's stiffness [1/m²]: waves longer than 2 pi / sqrt(anchor) stay."""
    offset: float = 0.003
    """Distance from the body that vertices are brought to [m]."""
    longest: float = 0.02
    """Most that contact moves a vertex in one step [m]."""
    akin: float = 0.6
    """Cosine of the skinning weights of cloth and body from which cloth rides on that part."""
    shallow: float = 0.03
    """Cloth deeper than this in a part that it does not ride on stays there [m]: where an arm lies in the trunk, or a
    thigh in the other, there is no room for cloth, and none is made by stretching it."""
    reach: float = 0.05
    """Vertices deeper inside the body than this are not found [m]."""
    search: int = 3
    """Steps between two searches for the nearest points of the body; between them it counts as flat."""


class Projective:
    """The steps for one garment; reusable for any number of poses and bodies of one topology."""

    def __init__(
        self,
        cloth: Cloth,
        weights: Tensor,
        held: Tensor | NDArray | None = None,
        settings: Projecting | None = None,
    ):
        """``weights``: (V, 24) the garment's skinning weights.

        ``held``: (H,) vertices that stay where the guess has them, a waistband's.
        """
        self.settings = settings or Projecting()
        self.count = len(cloth.masses)
        self.parts = wp.array(_unit(weights), dtype=float, device=DEVICE)
        laplacian, mass = _operators(cloth)
        weight = self.settings.anchor * np.maximum(mass, 1e-9)
        if held is not None and len(held):
            weight[np.asarray(held)] *= HELD
        self.weight = weight[:, None]
        matrix = (laplacian + sp.diags(weight)).tocsc()
        self.solve = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve
        self.faces = wp.array(ints(cloth.faces), dtype=wp.vec3i, device=DEVICE)
        self.inverse = wp.array(doubles(cloth.inverse), dtype=wp.mat22d, device=DEVICE)
        self.areas = wp.array(doubles(cloth.areas), dtype=wp.float64, device=DEVICE)
        self.x, self.right, self.point, self.normal = (
            wp.zeros(self.count, dtype=wp.vec3d, device=DEVICE) for _ in range(4)
        )
        self._body: _Skin | None = None

    @torch.no_grad()
    def __call__(self, guess: Tensor, body: PosedBody) -> Tensor:
        """Guesses (B, V, 3) on B bodies -> as many drapes; not differentiable, computed on the CPU."""
        if not len(guess):
            return guess.clone()
        skin = self._skin(body)
        found = [self._one(x, skin, b) for x, b in zip(guess, body.mesh.vertices, strict=True)]
        return torch.stack(found)

    def _skin(self, body: PosedBody) -> _Skin:
        faces = body.mesh.faces
        if self._body is None or self._body.faces is not faces:
            self._body = _Skin(body.mesh.vertices[0], faces, body.weights)
        return self._body

    def _look(self, skin: _Skin, mesh: wp.Mesh) -> None:
        """Find the planes beside the cloth as it is."""
        s = self.settings
        ask = [mesh.id, skin.parts, s.reach, s.akin, s.shallow]
        wp.launch(_search, self.count, [*ask, self.x, self.parts, self.point, self.normal], device=DEVICE)

    def _one(self, guess: Tensor, skin: _Skin, body: Tensor) -> Tensor:
        s, mesh = self.settings, skin.posed(body)
        limits = [wp.float64(s.offset), wp.float64(s.longest)]
        start = guess.cpu().double().numpy()
        x, right = self.x.numpy(), self.right.numpy()  # views: kernels and numpy share the memory
        x[:] = start
        for k in range(s.steps):
            right[:] = self.weight * start
            wp.launch(_agree, 1, [self.x, self.right, self.faces, self.inverse, self.areas], device=DEVICE)
            x[:] = self.solve(right)
            if k % s.search == 0:
                self._look(skin, mesh)
            contact = [self.x, self.point, self.normal, *limits]
            wp.launch(_leave, self.count, contact, device=DEVICE)
        return torch.from_numpy(x.copy()).to(guess)


class _Skin:
    """A body's search structure, built once and then bent into each pose."""

    def __init__(self, vertices: Tensor, faces: Tensor, weights: Tensor):
        self.faces = faces
        points = np.ascontiguousarray(vertices.detach().cpu().float().numpy())
        indices = wp.array(ints(faces).ravel(), dtype=int, device=DEVICE)
        self.mesh = wp.Mesh(wp.array(points, dtype=wp.vec3, device=DEVICE), indices)
        self.parts = wp.array(_unit(weights[faces].mean(1)), dtype=float, device=DEVICE)
        """(F, 24) which part of the body each face belongs to."""

    def posed(self, vertices: Tensor) -> wp.Mesh:
        """The structure around vertices (N, 3)."""
        self.mesh.points.numpy()[:] = vertices.detach().cpu().float().numpy()
        self.mesh.refit()
        return self.mesh


def _unit(weights: Tensor) -> NDArray:
    """Skinning weights (..., 24) as directions."""
    return torch.nn.functional.normalize(weights.detach().cpu().float(), dim=-1).contiguous().numpy()


def _operators(cloth: Cloth) -> tuple[sp.csr_matrix, NDArray]:
    """Stiffness (V, V) of the Dirichlet energy on the cloth at rest, and each vertex' share of its area (V,) [m²]."""
    faces, inverse, areas = cloth.faces.cpu().numpy(), doubles(cloth.inverse), doubles(cloth.areas)
    count = len(cloth.masses)
    gradient = np.stack([-inverse.sum(1), inverse[:, 0], inverse[:, 1]], 1)  # (F, 3, 2): of each corner's hat function
    values = np.einsum("f,fik,fjk->fij", areas, gradient, gradient)
    rows = np.broadcast_to(faces[:, :, None], values.shape)
    columns = np.broadcast_to(faces[:, None, :], values.shape)
    stiffness = sp.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count))
    return stiffness, np.bincount(faces.ravel(), np.repeat(areas / 3, 3), minlength=count)


@wp.kernel
def _agree(
    x: wp.array(dtype=wp.vec3d),
    right: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    inverse: wp.array(dtype=wp.mat22d),
    areas: wp.array(dtype=wp.float64),
):
    # One thread: faces share vertices. The polar factor of a 3 x 2 gradient, from sqrt(F^T F) of a 2 x 2 matrix.
    for t in range(faces.shape[0]):
        f = faces[t]
        i = inverse[t]
        b = x[f[1]] - x[f[0]]
        c = x[f[2]] - x[f[0]]
        u = b * i[0, 0] + c * i[1, 0]
        v = b * i[0, 1] + c * i[1, 1]
        uu = wp.dot(u, u)
        uv = wp.dot(u, v)
        vv = wp.dot(v, v)
        det = wp.sqrt(wp.max(uu * vv - uv * uv, wp.float64(FLATTEST) * wp.float64(FLATTEST)))
        scale = areas[t] / (wp.sqrt(uu + vv + wp.float64(2.0) * det) * det)
        p = (u * (vv + det) - v * uv) * scale
        q = (v * (uu + det) - u * uv) * scale
        to_b = p * i[0, 0] + q * i[0, 1]
        to_c = p * i[1, 0] + q * i[1, 1]
        right[f[1]] = right[f[1]] + to_b
        right[f[2]] = right[f[2]] + to_c
        right[f[0]] = right[f[0]] - to_b - to_c


@wp.func
def _wide(v: wp.vec3):
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.kernel
def _search(
    mesh: wp.uint64,
    body_parts: wp.array2d(dtype=float),
    reach: float,
    akin: float,
    shallow: float,
    x: wp.array(dtype=wp.vec3d),
    parts: wp.array2d(dtype=float),
    point: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
):
    # The plane that each vertex should stay above: that of the nearest point of the body; no normal where none is near.
    i = wp.tid()
    p = wp.vec3(float(x[i][0]), float(x[i][1]), float(x[i][2]))
    normal[i] = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    hit = wp.mesh_query_point_sign_normal(mesh, p, reach)
    if hit.result:
        same = float(0.0)  # noqa: UP018 - Warp's way to say that it changes
        for k in range(parts.shape[1]):
            same += parts[i, k] * body_parts[hit.face, k]
        near = wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
        if hit.sign > 0.0 or same > akin or wp.length(p - near) < shallow:
            away = (p - near) * hit.sign
            if wp.length(away) > 1.0e-6:
                normal[i] = _wide(wp.normalize(away))
            else:
                normal[i] = _wide(wp.mesh_eval_face_normal(mesh, hit.face))
            point[i] = _wide(near)


@wp.kernel
def _leave(
    x: wp.array(dtype=wp.vec3d),
    point: wp.array(dtype=wp.vec3d),
    normal: wp.array(dtype=wp.vec3d),
    offset: wp.float64,
    longest: wp.float64,
):
    i = wp.tid()
    if wp.length(normal[i]) > wp.float64(0.5):
        lack = offset - wp.dot(x[i] - point[i], normal[i])
        if lack > wp.float64(0.0):
            x[i] = x[i] + normal[i] * wp.min(lack, longest)
