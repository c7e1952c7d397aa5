"""What each pixel sees: mesh, face, place on it and depth. For textures, overlays and pictures; not differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.render.rays import RayScene, scene_on
from recon.render.view import View, Window, view_of
from recon.types import Camera, Mesh


@dataclass(frozen=True)
class Merged:
    """Several meshes as one."""

    vertices: Tensor
    """(V, 3) world [m]."""
    faces: Tensor
    """(F, 3) long."""
    mesh_of_face: Tensor
    """(F,) long."""
    first_face: Tensor
    """(meshes,) long: the row at which each mesh's faces start."""
    first_vertex: Tensor
    """(meshes,) long: the row at which each mesh's vertices start."""


def merge(meshes: Sequence[Mesh]) -> Merged:
    """The meshes as one; each (V, 3) or a batch of one (1, V, 3)."""
    if not meshes:
        raise ValueError("render: found no meshes; wanted at least one")
    vertices = [mesh.vertices.detach().reshape(-1, 3) for mesh in meshes]
    if any(v.shape[0] != m.vertices.shape[-2] for v, m in zip(vertices, meshes, strict=True)):
        raise ValueError("render: found a batch of bodies or garments; wanted one at a time")
    device = vertices[0].device
    first_vertex = torch.tensor([0, *(len(v) for v in vertices)], device=device).cumsum(0)
    counts = torch.tensor([len(mesh.faces) for mesh in meshes], device=device)
    owner = torch.repeat_interleave(torch.arange(len(meshes), device=device), counts)
    faces = torch.cat([mesh.faces.long() for mesh in meshes]) + first_vertex[owner][:, None]
    return Merged(torch.cat(vertices), faces, owner, counts.cumsum(0) - counts, first_vertex[:-1])


def scene_of(merged: Merged, view: View) -> RayScene:
    """The device's ray scene, set to the meshes as seen in the view."""
    scene = scene_on(merged.vertices.device)
    scene.set(view.traced(view.points(merged.vertices)), merged.faces)
    return scene


@dataclass(frozen=True)
class FirstHit:
    """An image of what is seen through each pixel's centre."""

    mesh: Tensor
    """(h, w) long, index of the mesh; -1 = nothing."""
    face: Tensor
    """(h, w) long, row of that mesh's faces; -1 = nothing."""
    barycentric: Tensor
    """(h, w, 3) weights of the face's corners; zeros where nothing is seen."""
    depth: Tensor
    """(h, w) depth along the camera's axis [m]; infinite where nothing is seen."""


def first_hit(
    meshes: Sequence[Mesh], camera: Camera, size: tuple[int, int] | None = None, window: Window | None = None
) -> FirstHit:
    """What each of (h, w) pixels sees first, of the whole image or of a window of it (original pixels)."""
    view = view_of(camera, size, window)
    merged = merge(meshes)
    hits = scene_of(merged, view).hits(view.grid(1))
    seen = hits.face >= 0
    mesh = torch.where(seen, merged.mesh_of_face[hits.face.clamp_min(0)], -1)
    face = torch.where(seen, hits.face - merged.first_face[mesh.clamp_min(0)], -1)
    corners = torch.cat([1 - hits.uv.sum(1, keepdim=True), hits.uv], 1) * seen[:, None]
    h, w = view.size
    return FirstHit(mesh.reshape(h, w), face.reshape(h, w), corners.reshape(h, w, 3), hits.depth.reshape(h, w))
