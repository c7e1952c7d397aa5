"""What the unsigned distance networks learn from: points on and around garments (DrapeNet §6.1.3).

A pool of places with exact distances and directions is drawn once for each garment, and so are the points that the
encoder sees, with their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from recon.garments.panels import border_edges
from recon.garments.udf import Sided, UdfDecoder
from recon.garments.udf_field import MeshField
from recon.garments.udf_grid import Box
from recon.garments.udf_net import UdfShape
from recon.garments.udf_space import spread
from recon.metrics import sample_surface
from recon.types import Mesh

ONE_WAY = 0.1
"""Largest square, relative to the other's, that the output beside a surface may change by when it is crossed."""
ONE_SIDE = 0.8
"""How much oftener than not the output across a surface must change to the same side."""
BASIS = 1500
"""Places that all garments' distances are compared at."""


@dataclass(frozen=True)
class Sampling:
    """How places are drawn around a garment; shares of the places, the rest falls anywhere in the garment's box."""

    places: int = 10000
    """Places per garment."""
    on: float = 0.2
    """Share on the surface (the paper: 0.3)."""
    near: float = 0.3
    """Share that lies ``noise`` beside it."""
    far: float = 0.25
    """Share that lies three times as far (the paper: 0.3)."""
    rim: float = 0.15
    """Share ``noise`` beside the open borders, which the others would hardly meet (the paper: none)."""
    noise: float = 0.008
    """Standard deviation of the noise [m]; the paper has 0.003 units, a unit being half the height of its cube."""
    clouds: int = 2
    """Point clouds per garment for the encoder."""


@dataclass(frozen=True)
class UdfSamples:
    """Everything that a training draws from, for G garments."""

    places: Tensor
    """(G, N, 3) float32, domain."""
    distance: Tensor
    """(G, N) float32, over δ and clipped to [0, 1]."""
    direction: Tensor
    """(G, N, 3) float16 unit gradients of the distance; zero on the surface and beyond δ."""
    clouds: Tensor
    """(G, C, P, 3) float32 surface points, domain."""
    near: Tensor
    """(G, C, P, K) int16 neighbours among the cloud's points."""
    aims: Tensor
    """(G, Z) where codes start: principal components of distances at places that all garments share."""

    def __len__(self) -> int:
        return len(self.places)


def spread_mesh(mesh: Mesh, apart: float) -> Mesh:
    """A garment [m] as the fields know it: ``spread``, its triangles quartered first, for edges stay straight (a
    crotch's would be up to 2 mm off)."""
    if not apart:
        return mesh
    vertices, faces = trimesh.remesh.subdivide(mesh.vertices.double().numpy(), mesh.faces.numpy())
    return Mesh(spread(torch.as_tensor(vertices, dtype=torch.float32), apart), torch.as_tensor(faces))


def bounds(
    meshes: Sequence[Mesh], margin: float = 0.03
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The box around all garments (spread ones), as a frame for the networks."""
    box = Box.around(torch.cat([m.vertices for m in meshes]), margin)
    return box.low, box.high


def collect(meshes: Sequence[Mesh], shape: UdfShape, sampling: Sampling, generator: torch.Generator) -> UdfSamples:
    """Samples of garments in the fields' space [m]."""
    rows = [_one(mesh, shape, sampling, generator) for mesh in meshes]
    places, distance, direction, clouds, near = (torch.stack(column) for column in zip(*rows, strict=True))
    basis = torch.cat([draw_places(mesh, Sampling(places=40), generator) for mesh in meshes])
    basis = basis[torch.randperm(len(basis), generator=generator)[:BASIS]]
    away = torch.stack([MeshField(mesh)(basis).clamp(max=3 * shape.reach) for mesh in meshes])
    return UdfSamples(places, distance, direction, clouds, near, principal(away, shape.code, generator))


def principal(features: Tensor, size: int, generator: torch.Generator) -> Tensor:
    """(G, size) scores of features (G, F) along their main directions, the first of unit size, later ones smaller."""
    features = features - features.mean(0)
    u, s, _ = torch.linalg.svd(features, full_matrices=False)
    keep = min(size, max(len(features) - 1, 0))
    scores = u[:, :keep] * len(features) ** 0.5 * (s[:keep] / s[0].clamp_min(1e-9)).sqrt()
    rest = torch.zeros(len(features), size - keep)
    return torch.cat([scores, rest], 1) + 0.01 * torch.randn(len(features), size, generator=generator)


def _one(mesh: Mesh, shape: UdfShape, sampling: Sampling, generator: torch.Generator) -> tuple[Tensor, ...]:
    points = draw_places(mesh, sampling, generator)
    distance, gradient = MeshField(mesh).slope(points)
    known = (distance > 1e-4) & (distance < shape.reach)
    domain = (points - points.new_tensor(shape.centre)) / shape.half
    clouds = [draw_cloud(mesh, shape, generator) for _ in range(sampling.clouds)]
    return (
        domain,
        (distance / shape.reach).clamp(max=1.0),
        (gradient * known[:, None]).half(),
        torch.stack([cloud for cloud, _ in clouds]),
        torch.stack([near for _, near in clouds]).short(),
    )


def draw_places(mesh: Mesh, sampling: Sampling, generator: torch.Generator) -> Tensor:
    """(N, 3) places [m] as §6.1.3 says, in random order."""
    count = sampling.places
    parts = [round(count * share) for share in (sampling.on, sampling.near, sampling.far, sampling.rim)]
    surface = sample_surface(mesh, sum(parts[:3]), generator)[0]
    noise = torch.repeat_interleave(torch.tensor([0.0, sampling.noise, 3 * sampling.noise]), torch.tensor(parts[:3]))
    surface = surface + noise[:, None] * torch.randn(surface.shape, generator=generator)
    rim = _rim_points(mesh, parts[3], generator)
    rim = rim + sampling.noise * torch.randn(rim.shape, generator=generator)
    box = Box.around(mesh.vertices, 0.05)
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    anywhere = low + (high - low) * torch.rand(count - len(surface) - len(rim), 3, generator=generator)
    every = torch.cat([surface, rim, anywhere])
    return every[torch.randperm(len(every), generator=generator)]


def _rim_points(mesh: Mesh, count: int, generator: torch.Generator) -> Tensor:
    edges = torch.as_tensor(border_edges(mesh.faces.numpy()))
    if not len(edges) or not count:
        return sample_surface(mesh, max(count, 1), generator)[0][:count]
    a, b = mesh.vertices[edges].unbind(1)
    pick = torch.multinomial((b - a).norm(dim=1), count, replacement=True, generator=generator)
    return a[pick] + torch.rand(count, 1, generator=generator) * (b - a)[pick]


def draw_cloud(mesh: Mesh, shape: UdfShape, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points (P, 3) of the surface in the domain and their neighbours (P, K) int32: what the encoder is given."""
    points = sample_surface(mesh, shape.points, generator)[0]
    domain = (points - points.new_tensor(shape.centre)) / shape.half
    near = cKDTree(domain.numpy()).query(domain.numpy(), k=shape.neighbours)[1]
    return domain, torch.as_tensor(near.astype(np.int32))


def sides_of(decoder: UdfDecoder, meshes: Sequence[Mesh], beside: float = 0.008) -> Sided | None:
    """What the decoder's outputs say of sides, on garments of which it has the codes; None if they say nothing sure.

    Args:
        decoder: its ``all_codes`` are those of the meshes.
        meshes: what it learned from [m], spread.
        beside: so far on both sides the outputs are compared [m].
    """
    if decoder.nets.shape.head != "pair":
        return None
    generator, jumps, rims = torch.Generator().manual_seed(0), [], []
    with torch.no_grad():
        for row in range(0, len(meshes), max(1, len(meshes) // 40)):
            at, normal = sample_surface(meshes[row], 500, generator)
            layers = decoder.nets.decoder.fold(decoder.all_codes[row])
            rim = _rim_points(meshes[row], 200, generator)
            places = torch.cat([at + beside * normal, at - beside * normal, rim])
            above, below, border = decoder.nets.decoder.outputs(layers, decoder.nets.to_domain(places)).split(
                [len(at), len(at), len(rim)]
            )
            jumps.append(above - below)
            rims.append(border)
        jump = torch.cat(jumps)
        size, axes = torch.linalg.eigh(jump.T @ jump)
        turn = axes.flip(1)
        alike = (jump @ turn[:, 0]).sign().mean().abs()
        border = float((torch.cat(rims) @ turn)[:, 1].abs().median()) * decoder.nets.shape.reach
    return Sided(turn, border) if size[0] < ONE_WAY * size[1] and alike > ONE_SIDE else None
