"""What a fit is worth, in numbers: overlap, penetration, intersections, stretch (the figures of ``result.json``)."""

from __future__ import annotations

import torch
from torch import Tensor

from pipelines.evidence import Level
from pipelines.fit_body import to_body, to_camera
from pipelines.fit_garment import Layer, Models, photo_size, scene_images
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stretch
from recon.cloth.intersections import self_intersections
from recon.losses import hard_iou
from recon.types import Mesh, Photo, PosedBody


def overlaps(
    meshes: dict[str, Mesh], values: dict[str, Tensor], photo: Photo, models: Models, at: Level
) -> dict[str, float]:
    """Name -> intersection over union of the layer as seen with its mask, ignored pixels left out."""
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        camera = at.camera(to_camera(values, photo_size(photo)))
        scene = [(meshes[n].vertices, meshes[n].faces) for n in at.names]
        image = scene_images(posed, scene, camera, at.size, models)
        found = hard_iou(image, at.targets, at.weight)
    return {n: float(v) for n, v in zip(at.names, found)}


def body_overlap(meshes: dict[str, Mesh], values: dict[str, Tensor], photo: Photo, models: Models, at: Level) -> float:
    """Intersection over union of body and garments together with the person's mask."""
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        camera = at.camera(to_camera(values, photo_size(photo)))
        parts = [posed.mesh.vertices[0], *[m.vertices for m in meshes.values()]]
        faces = [models.body.faces, *[m.faces for m in meshes.values()]]
        renderer = models.renderer_of(faces, [0] * len(parts), [len(p) for p in parts])
        image = renderer(parts, camera, at.size)
    return float(hard_iou(image, at.person[None])[0])


def by_code(layer: Layer, posed: PosedBody, models: Models) -> Mesh:
    """Where code and draper alone put a layer: as the refine stage found it, before it graded the cloth."""
    garment = layer.garment
    if layer.coded is None:
        return Mesh(models.draper.drape(garment, posed).vertices[0], garment.mesh.faces)
    return Mesh(layer.coded, garment.mesh.faces)


def geometry(layer: Layer, mesh: Mesh, contact: BodyContact) -> dict[str, float | int]:
    """Counts and strain of one refined layer.

    Returns:
        vertices, faces: counts; penetrating_vertices, penetrating_faces: inside the body (faces by their centres);
        self_intersections: pairs of faces; stretch_p95: 95th percentile of the larger principal stretch (1 = rest: as
        on the panels, or without panels as graded from the shape at rest).
    """
    with torch.no_grad():
        inside = contact.signed_distance(mesh.vertices) < 0
        centres = contact.signed_distance(mesh.vertices[mesh.faces].mean(1)) < 0
        stretched = stretch(Cloth.from_garment(layer.garment), mesh.vertices)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "penetrating_vertices": int(inside.sum()),
        "penetrating_faces": int(centres.sum()),
        "self_intersections": len(self_intersections(mesh.vertices, mesh.faces)),
        "stretch_p95": float(stretched.quantile(0.95)),
    }
