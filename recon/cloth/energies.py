"""Elastic energies of cloth: St Venant-Kirchhoff membrane, dihedral bending, gravity.

The forms and constants are those of SNUG (Santesteban et al. 2022), which DrapeNet Eq. 16 and GAPS build on. All
functions take positions ``x`` (..., V, 3) in metres and return energies (...,) in joules, differentiable, finite
everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon.types import Garment, Mesh

GRAVITY = 9.81
"""[m/s²], along -y."""


@dataclass(frozen=True)
class Fabric:
    """Material constants; the defaults are SNUG's cotton."""

    lame_mu: float = 2.357e4
    """Second Lamé coefficient [Pa] (E = 0.7e5 Pa, Poisson's ratio 0.485)."""
    lame_lambda: float = 4.439e4
    """First Lamé coefficient [Pa]."""
    thickness: float = 0.47e-3
    """[m]."""
    density: float = 426.0
    """[kg/m³]."""
    bending: float = 3.96e-5
    """Bending stiffness [N m]."""

    def scaled(self, stretch: float = 1.0, bending: float = 1.0) -> Fabric:
        """The fabric with its membrane and bending stiffness multiplied."""
        return Fabric(
            self.lame_mu * stretch, self.lame_lambda * stretch, self.thickness, self.density, self.bending * bending
        )


@dataclass(frozen=True)
class Cloth:
    """A garment ready for physics: rest state from its flat panels, hinges across seams included."""

    faces: Tensor
    """(F, 3) long, welded vertices."""
    inverse: Tensor
    """(F, 2, 2) inverse of the rest edge matrix [1/m]; zeros for degenerate triangles, which then carry no energy."""
    areas: Tensor
    """(F,) rest areas [m²]."""
    edges: Tensor
    """(E, 2) long, every edge once."""
    edge_lengths: Tensor
    """(E,) rest lengths, mean of both panels at a seam [m]."""
    hinges: Tensor
    """(H, 4) long: both ends of an inner edge, then the two vertices opposite."""
    hinge_weights: Tensor
    """(H,) l² / (4 (a0 + a1))."""
    masses: Tensor
    """(V,) lumped masses [kg]."""
    rest_angles: Tensor
    """(H,) dihedral angles at which hinges are at rest; 0 = flat, as cloth off the bolt is [rad]."""
    fabric: Fabric

    @classmethod
    def from_garment(cls, garment: Garment, fabric: Fabric | None = None) -> Cloth:
        """Rest state from the panel points: each triangle lies flat and unstretched in its panel.

        Without panels it is unstretched as it lies at rest. The type of ``panel_points`` is the cloth's, either way.
        """
        if not garment.has_panels:
            at = garment.mesh.vertices if garment.unstrained is None else garment.unstrained
            return cls.from_mesh(Mesh(at.to(garment.panel_points.dtype), garment.mesh.faces), fabric)
        flat = _flat(garment).detach()
        return cls.from_triangles(garment.mesh.faces, flat, garment.mesh.vertices.shape[-2], fabric)

    @classmethod
    def from_mesh(cls, mesh: Mesh, fabric: Fabric | None = None) -> Cloth:
        """Rest state from a mesh without panels (V, 3): its triangles are unstretched as they are."""
        a, b, c = mesh.vertices.detach()[mesh.faces].unbind(1)
        along, other = b - a, c - a
        length = along.norm(dim=1).clamp_min(1e-12)
        x = (along * other).sum(1) / length
        y = (other.square().sum(1) - x.square()).clamp_min(0).sqrt()
        zero = torch.zeros_like(length)
        flat = torch.stack([torch.stack(p, 1) for p in ((zero, zero), (length, zero), (x, y))], 1)
        return cls.from_triangles(mesh.faces, flat, len(mesh.vertices), fabric)

    @classmethod
    def from_triangles(cls, faces: Tensor, flat: Tensor, vertices: int, fabric: Fabric | None = None) -> Cloth:
        """Rest state from flat triangles: faces (F, 3), their corners at rest (F, 3, 2) [m]."""
        fabric = fabric or Fabric()
        rest = torch.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], -1)
        doubled = torch.linalg.det(rest).abs()
        sound = doubled > 1e-10
        eye = torch.eye(2, dtype=rest.dtype, device=rest.device)
        inverse = torch.where(sound[:, None, None], torch.linalg.inv(torch.where(sound[:, None, None], rest, eye)), 0.0)
        areas = torch.where(sound, doubled / 2, 0.0)
        edges, edge_lengths = _edges(faces, flat)
        hinges, hinge_weights = _hinges(faces, areas, edges, edge_lengths)
        masses = areas.new_zeros(vertices)
        share = areas * (fabric.density * fabric.thickness / 3)
        masses = masses.index_add(0, faces.reshape(-1), share.repeat_interleave(3))
        rest_angles = torch.zeros_like(hinge_weights)
        return cls(faces, inverse, areas, edges, edge_lengths, hinges, hinge_weights, masses, rest_angles, fabric)


def rest_edges(garment: Garment) -> tuple[Tensor, Tensor]:
    """Edges (E, 2), each once, and their lengths (E,) in the panels or, without, at rest [m]; differentiable."""
    faces = garment.mesh.faces
    at = garment.mesh.vertices if garment.unstrained is None else garment.unstrained
    return _edges(faces, _flat(garment) if garment.has_panels else at[faces])


def _flat(garment: Garment) -> Tensor:
    """(F, 3, 2) each triangle in its panel, as seen from outside [m]."""
    flat = garment.panel_points[garment.panel_faces]
    return torch.where((garment.side_of_face == 1)[:, None, None], flat * flat.new_tensor([-1.0, 1.0]), flat)


def _edges(faces: Tensor, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Unique edges and their rest lengths (mean over the triangles that share them); ``flat``: (F, 3, 2 or 3)."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    corners = torch.cat([flat[:, [0, 1]], flat[:, [1, 2]], flat[:, [2, 0]]])
    lengths = (corners[:, 0] - corners[:, 1]).norm(dim=-1)
    edges, where = ends.unique(dim=0, return_inverse=True)
    total = lengths.new_zeros(len(edges)).index_add(0, where, lengths)
    count = lengths.new_zeros(len(edges)).index_add(0, where, torch.ones_like(lengths))
    return edges, total / count


def _hinges(faces: Tensor, areas: Tensor, edges: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Inner edges with the vertices opposite, and SNUG's weights."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    opposite = torch.cat([faces[:, 2], faces[:, 0], faces[:, 1]])
    face = torch.arange(len(faces), device=faces.device).repeat(3)
    _, where = ends.unique(dim=0, return_inverse=True)
    order = torch.argsort(where, stable=True)
    same = where[order][1:] == where[order][:-1]
    first, second = order[:-1][same], order[1:][same]
    edge = where[first]
    hinges = torch.cat([edges[edge], opposite[first, None], opposite[second, None]], 1)
    total = areas[face[first]] + areas[face[second]]
    return hinges, torch.where(total > 1e-12, lengths[edge] ** 2 / (4 * total.clamp_min(1e-12)), 0.0)


def strain(cloth: Cloth, x: Tensor) -> Tensor:
    """(..., F, 2, 2) Green strain of each triangle."""
    gradient = deformation(cloth, x)
    eye = torch.eye(2, dtype=x.dtype, device=x.device)
    return 0.5 * (gradient.transpose(-1, -2) @ gradient - eye)


def deformation(cloth: Cloth, x: Tensor) -> Tensor:
    """(..., F, 3, 2) deformation gradient of each triangle."""
    corners = x[..., cloth.faces, :]
    edges = torch.stack([corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]], -1)
    return edges @ cloth.inverse


def stvk(cloth: Cloth, x: Tensor) -> Tensor:
    """Membrane energy (...,) [J]: thickness · Σ area · (μ ‖E‖² + λ/2 tr(E)²)."""
    a, b = x[..., cloth.faces[:, 0], :], None
    b = x[..., cloth.faces[:, 1], :] - a
    c = x[..., cloth.faces[:, 2], :] - a
    i = cloth.inverse
    # The columns of the deformation gradient, written out: several times faster than small matrix products.
    u = b * i[:, 0, 0, None] + c * i[:, 1, 0, None]
    v = b * i[:, 0, 1, None] + c * i[:, 1, 1, None]
    uu = 0.5 * ((u * u).sum(-1) - 1)
    vv = 0.5 * ((v * v).sum(-1) - 1)
    uv = 0.5 * (u * v).sum(-1)
    f = cloth.fabric
    density = f.lame_mu * (uu * uu + vv * vv + 2 * uv * uv) + 0.5 * f.lame_lambda * (uu + vv) ** 2
    return f.thickness * (cloth.areas * density).sum(-1)


def bend_angles(cloth: Cloth, x: Tensor) -> Tensor:
    """(..., H) signed dihedral angles, 0 where flat [rad]; degenerate hinges give 0 with a zero gradient."""
    a, b, c, d = (x[..., cloth.hinges[:, k], :] for k in range(4))
    edge = b - a
    left = torch.linalg.cross(edge, c - a)
    right = torch.linalg.cross(d - a, edge)
    length = (edge * edge).sum(-1)
    cosine = (left * right).sum(-1)
    sine = (torch.linalg.cross(left, right) * edge).sum(-1)
    size = (left * left).sum(-1) * (right * right).sum(-1)
    sound = (size > 1e-26) & (length > 1e-12)
    sine = torch.where(sound, sine, 0.0) / torch.where(sound, length, 1.0).sqrt()
    return torch.atan2(sine, torch.where(sound, cosine, 1.0))


def bending(cloth: Cloth, x: Tensor) -> Tensor:
    """Bending energy (...,) [J]: stiffness · Σ l² / (4 (a0 + a1)) · (θ - θ_rest)²."""
    return cloth.fabric.bending * (cloth.hinge_weights * (bend_angles(cloth, x) - cloth.rest_angles) ** 2).sum(-1)


def towards_template(cloth: Cloth, template: Tensor, balance: Tensor) -> Cloth:
    """The cloth with GAPS' bending (Eq. 12): flat where ``balance`` (H,) is 0, as in the template (V, 3) where it is 1.

    balance (θ - θ_r)² + (1 - balance) θ² is (θ - balance θ_r)² but for a constant: a rest angle says it all.
    """
    return replace(cloth, rest_angles=balance * bend_angles(cloth, template).detach())


def inertia(cloth: Cloth, x: Tensor, before: Tensor, earlier: Tensor, step: float) -> Tensor:
    """GAPS Eq. 13 (...,) [J]: what leaving the path of ``earlier`` and ``before`` costs at ``x``; all (..., V, 3) [m].

    ``step``: time between them [s]. No gradient flows to the earlier frames.
    """
    before, earlier = before.detach(), earlier.detach()
    off = x - before - (before - earlier)
    return (cloth.masses[:, None] * off.square()).sum((-1, -2)) / (2 * step**2)


def collision(depth: Tensor, stiffness: float, steep: float = float("inf")) -> Tensor:
    """GAPS Eq. 11 (...,) [J]: ``depth`` (..., V) lack of distance from the body, max(eps - d, 0) [m].

    Beyond the depth ``steep`` it goes on as a straight line.
    """
    cubic = depth.clamp(max=steep)
    return stiffness * (cubic.pow(3) + 3 * cubic.square() * (depth - cubic)).sum(-1)


def gravity(cloth: Cloth, x: Tensor) -> Tensor:
    """Potential energy (...,) [J] over y = 0."""
    return GRAVITY * (cloth.masses * x[..., 1]).sum(-1)


def stretch(cloth: Cloth, x: Tensor) -> Tensor:
    """(..., F) largest singular value of each triangle's deformation gradient (1 = unstretched)."""
    g = deformation(cloth, x)
    g = g.transpose(-1, -2) @ g
    mean = (g[..., 0, 0] + g[..., 1, 1]) / 2
    spread = (((g[..., 0, 0] - g[..., 1, 1]) / 2) ** 2 + g[..., 0, 1] ** 2).clamp_min(0).sqrt()
    return (mean + spread).clamp_min(0).sqrt()
