"""Open surfaces out of unsigned distance fields, differentiably (DrapeNet §3.1, after MeshUDF, Guillard et al. 2022).

Marching cubes needs signs that an unsigned field does not have; the orientation of its gradients supplies them
(``udf_signs``). The surface is cut where it ends (``mesh_udf_border``), and its vertices follow whatever the field
depends on: a vertex moves as the distances just beside it change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from recon.garments.marching import march
from recon.garments.mesh_udf_border import Cutting, cut, outward, vertex_normals
from recon.garments.panels import border_edges
from recon.garments.udf_grid import Box, Field, find_band, slope
from recon.garments.udf_signs import signs
from recon.types import Mesh

FLATTEST = 0.1
"""Where a field is less steep than this, vertices move as if it were as steep."""
ENDED = 0.3
"""Borders beyond which the distance grows more slowly than this stay where they are: nothing says where they end."""
LONGEST = 0.01
"""Longest step of a vertex towards the surface [m]."""
CHASE = 4
"""Steps of ``beside`` that a border may go after a surface that grew."""


@dataclass(frozen=True)
class Meshing:
    """How finely a field is looked at, and how far it is trusted."""

    resolution: int = 256
    """Cells along the box's longest side."""
    steepness: float = 1.1
    """Bound on the length of the field's gradient; more than 1 for learned fields."""
    floor: float = 0.0
    """Distance that the field may still show on the surface [m]; 0 for exact fields."""
    beyond: float = 0.2
    """Vertices further beside the surface than this lie beyond its border [cells]."""


def mesh_udf(field: Field, box: Box, meshing: Meshing | None = None) -> Mesh:
    """The open surface where an unsigned distance field is zero: single layer, manifold, borders smooth.

    Args:
        field: points (N, 3) [m] -> distances (N,) [m], differentiable in the points; a ``slope`` method is used where
            it has one.
        box: where to look.
        meshing: see :class:`Meshing`.

    Returns:
        Vertices (V, 3) float32 [m] without gradient (:func:`follow` attaches it) and faces (F, 3), counter-clockwise
        seen from outside of tubes; (0, 3) both where there is no surface.
    """
    meshing = meshing or Meshing()
    band = find_band(field, box, meshing.resolution, meshing.steepness, meshing.floor)
    if not len(band.corners):
        return Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long))
    points, faces = march(band, signs(field, band, meshing.floor))
    points, faces = cut(field, points, faces, Cutting(band.cell, meshing.beyond))
    return Mesh(torch.as_tensor(points, dtype=torch.float32), torch.as_tensor(turned_out(points, faces)))


def turned_out(points: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """Faces of each piece turned so that most of its area looks away from its middle."""
    if not len(faces):
        return faces
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(points), len(points)))
    piece = connected_components(graph, directed=False)[1][faces[:, 0]]
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal, middle = np.cross(b - a, c - a), (a + b + c) / 3
    size = np.maximum(np.bincount(piece), 1)
    mean = np.stack([np.bincount(piece, middle[:, k]) / size for k in range(3)], 1)
    out = np.bincount(piece, (normal * (middle - mean[piece])).sum(1))
    return np.where((out < 0)[piece][:, None], faces[:, ::-1], faces).copy()


@dataclass(frozen=True)
class Frame:
    """In which directions a mesh's vertices can be told where the surface is."""

    normal: Tensor
    """(V, 3) unit normals."""
    border: Tensor
    """(B,) vertices on open borders."""
    outward: Tensor
    """(B, 3) unit directions along the surface out of it, at right angles to the border."""

    @staticmethod
    def of(mesh: Mesh) -> Frame:
        """The frame of a mesh (V, 3) without pinched border vertices."""
        points, faces = mesh.vertices.detach().double().cpu().numpy(), mesh.faces.cpu().numpy()
        normal = vertex_normals(points, faces)
        border, out = outward(points, border_edges(faces), normal)
        like = mesh.vertices
        return Frame(*(torch.as_tensor(a).to(like.device) for a in (normal, border, out))).to(like.dtype)

    def to(self, dtype: torch.dtype) -> Frame:
        """The same directions in another type."""
        return replace(self, normal=self.normal.to(dtype), outward=self.outward.to(dtype))


def follow(
    field: Field, mesh: Mesh, beside: float, frame: Frame | None = None, held: Tensor | float | None = None
) -> Mesh:
    """The mesh with vertices that carry the gradient of everything the field depends on (MeshUDF §3.3).

    On the surface an unsigned distance has no gradient, but ``beside`` it, it has. With n the normal, o the direction
    out of a border, α = ``beside`` and derivatives by the code z::

        ∂v/∂z = n (∂u(v - α n)/∂z - ∂u(v + α n)/∂z) / 2        and on borders, in addition,   - o ∂u(v + α o)/∂z

    each divided by how steep the field is there (1 for an exact one); on borders both changes are met together. The
    mesh says where to ask; n is the field's own direction, which knows nothing of the triangles' shapes.

    Args:
        field: the field, differentiable in what it depends on.
        mesh: vertices (V, 3) [m] on or near the surface.
        beside: α [m]: about a cell; learned fields are good from a few millimetres on.
        frame: of the mesh, where known.
        held: also take vertices to where the field is this again beside them: ``beside``, or what :func:`shown` says
            that the field was from which the mesh was made; for the mesh of a code nearby.
    """
    frame = frame or Frame.of(mesh)
    at, rim = mesh.vertices.detach(), frame.border
    asked = _asked(mesh, beside, frame)
    known, gradient = slope(field, asked)
    found = field(asked)
    sizes = [len(at), len(at), len(rim)]
    above, below, out = gradient.split(sizes)
    normal, steep = _unit((above - below) / 2)
    ends = held[2 * len(at) :] if isinstance(held, Tensor) else known[2 * len(at) :]
    grown = found - (found.detach() if held is None else held)
    up, down, beyond = grown.split(sizes)
    across = _limited((down - up) / (2 * steep))
    # The normal's way changes the distance beyond the border too: both conditions are met together.
    lean, skew = (out * normal[rim]).sum(1), (normal[rim] * frame.outward).sum(1)
    steep_out = (out * frame.outward).sum(1) - lean * skew
    end = _limited((-beyond - lean * across[rim]) / steep_out.clamp_min(ENDED))
    end = torch.where((ends > 0.5 * beside) & (steep_out > ENDED), end, 0.0)
    across = across.index_add(0, rim, -end * skew)
    return mesh.with_vertices((at + across[:, None] * normal).index_add(0, rim, end[:, None] * frame.outward))


def _limited(step: Tensor) -> Tensor:
    """(N,) steps of at most ``LONGEST``."""
    return step.clamp(-LONGEST, LONGEST)


def shown(field: Field, mesh: Mesh, beside: float, frame: Frame) -> Tensor:
    """(2 V + B,) what a field says beside a mesh [m], no gradient: learned ones neither vanish on the surface nor grow
    evenly beyond borders. Held at this by :func:`follow`, a mesh of an unchanged field stays where it is."""
    with torch.no_grad():
        return field(_asked(mesh, beside, frame))


def _asked(mesh: Mesh, beside: float, frame: Frame) -> Tensor:
    """(2 V + B, 3) points above, below and, of borders, beyond a mesh's vertices."""
    at = mesh.vertices.detach()
    rim = at[frame.border] + beside * frame.outward
    return torch.cat([at + beside * frame.normal, at - beside * frame.normal, rim])


@torch.no_grad()
def chase(field: Field, before: Field, mesh: Mesh, beside: float, frame: Frame) -> Mesh:
    """The mesh taken to about where its surface went, as far as :func:`follow` sees the rest of the way.

    Vertices whose distance grew by more than three quarters of ``beside`` go to what is closest now; borders beyond
    which the surface now goes on, and did not before, go after it. Comparing with ``before`` leaves alone what a
    learned field shows anyhow: distances on the surface, and borders that are none.

    Args:
        field: what it now is.
        before: what the mesh was made from.
        mesh: vertices (V, 3) [m].
        beside: α [m], as in :func:`follow`.
        frame: of the mesh.
    """
    at, rim = mesh.vertices.detach(), frame.border
    was_out = before(at[rim] + beside * frame.outward) > 0.5 * beside
    distance, gradient = slope(field, at)
    way, steep = _unit(gradient)
    left = distance - before(at) > 0.75 * beside
    at = at - torch.where(left, distance / steep, 0.0)[:, None] * way
    for _ in range(CHASE):
        beyond = field(at[rim] + beside * frame.outward)
        lack = torch.where(was_out & (beyond < 0.5 * beside), beside - beyond, 0.0)
        at = at.index_add(0, rim, lack[:, None] * frame.outward)
    return mesh.with_vertices(at)


def _unit(v: Tensor) -> tuple[Tensor, Tensor]:
    """Directions (N, 3) and lengths (N,), kept from being small: no vertex jumps where the field is flat."""
    length = v.norm(dim=1)
    return v / length.clamp_min(1e-6)[:, None], length.clamp_min(FLATTEST)
