"""The results of a fit: figures, meshes, patterns, pictures, ``result.json`` and the report, in the run's folder."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from torch import Tensor

from pipelines.evidence import level
from pipelines.fit_body import to_body, to_camera
from pipelines.fit_garment import Layer, Models, photo_size
from pipelines.fit_result import FitResult
from pipelines.measure import body_overlap, by_code, geometry, overlaps
from pipelines.report import colour_of, write_pictures, write_report
from recon.cloth.contact import BodyContact
from recon.files.atomic import write_whole
from recon.files.meshes import Colour, write_glb, write_obj
from recon.files.patterns import write_svg
from recon.types import BodyPose, Garment, Mesh, Photo

SCHEMA = 1


def header(config) -> dict:
    """What every ``result.json`` begins with; ``config``: the settings of a photo's or a scan's fit."""
    kept = ("decoder", "draper", "seed", "device")
    return {"schema": SCHEMA, **{name: getattr(config, name) for name in kept}, "versions": versions()}


def described(name: str, place: BodyPose) -> dict:
    """The body model's name and numbers for ``result.json``."""
    return {
        "name": name,
        "shape": place.shape[0].tolist(),
        "pose": place.pose[0].tolist(),
        "translation": place.translation[0].tolist(),
    }


def write_meshes(out: Path, body: Mesh, layers: Sequence[Layer], moved: dict[str, Mesh]) -> None:
    """``body.obj``, each garment as OBJ, its pattern, where it has one, as SVG, and ``scene.glb`` with all of them."""
    write_obj(body, out / "body.obj", "body")
    parts: dict[str, tuple[Mesh | Garment, Colour]] = {"body": (body, colour_of("body"))}
    for layer in layers:
        garment = replace(layer.garment, mesh=moved[layer.name])
        write_obj(garment, out / f"{layer.name}.obj", layer.name)
        if layer.garment.has_panels:
            write_svg(layer.garment, out / "patterns" / f"{layer.name}.svg", layer.name)
        parts[layer.name] = (garment, colour_of(layer.name))
    write_glb(parts, out / "scene.glb")


def panel_notes(layers: Sequence[Layer]) -> list[str]:
    """What a user should know of garments without panels, one line."""
    bare = [layer.name for layer in layers if not layer.garment.has_panels]
    if not bare:
        return []
    why = "without panels, so no sewing pattern and no texture coordinates; stretch is against the shape at rest"
    return [f"{', '.join(bare)}: {why}"]


def shifted(layers: Sequence[Layer], shift: Tensor) -> list[Layer]:
    """The layers with what lies in the world moved by ``shift`` (3,) [m]."""
    return [layer if layer.coded is None else replace(layer, coded=layer.coded + shift) for layer in layers]


def grounded(body: Mesh, meshes: dict[str, Mesh]) -> tuple[Mesh, dict[str, Mesh], Tensor]:
    """Move the world so that the body's lowest point is at y = 0 below x = z = 0.

    Returns:
        Body, garments, and the (3,) shift that was added to every vertex [m].
    """
    v = body.vertices
    middle = (v.min(0).values + v.max(0).values) / 2
    shift = -torch.stack([middle[0], v[:, 1].min(), middle[2]])
    moved = {k: m.with_vertices(m.vertices + shift) for k, m in meshes.items()}
    return body.with_vertices(v + shift), moved, shift


def versions() -> dict[str, str]:
    """Versions of what the result depends on."""
    found = {"python": platform.python_version()}
    for name in ("garment-recon", "torch", "mitsuba", "drjit", "warp-lang", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def measure_all(
    values: dict[str, Tensor], layers: list[Layer], meshes: dict[str, Mesh], photo: Photo, models: Models
) -> dict:
    """Figures per garment and of the whole: keys ``garments`` and ``body`` of ``result.json``."""
    at = level(photo, 512).pick(tuple(layer.name for layer in layers))
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        coded = {layer.name: by_code(layer, posed, models) for layer in layers}
    contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
    refined, unrefined = (overlaps(each, values, photo, models, at) for each in (meshes, coded))
    garments = {}
    for layer in layers:
        n = layer.name
        garments[n] = {
            "kind": layer.garment.kind,
            "iou": refined[n],
            "iou_code_only": unrefined[n],
            **geometry(layer, meshes[n], contact),
            "mask_confidence": photo.confidence.get(n),
        }
    return {"garments": garments, "body": {"iou": body_overlap(meshes, values, photo, models, at)}}


def write_results(
    config, photo: Photo, models: Models, fitted: tuple[dict[str, Tensor], list[Layer], dict[str, Mesh]], seconds: dict
) -> FitResult:
    """Measure, write all files, and last ``result.json``: its presence says that the others are there."""
    begin = time.perf_counter()
    values, layers, meshes = fitted
    out = Path(config.out)
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
    camera = to_camera(values, photo_size(photo))
    body, moved, shift = grounded(Mesh(posed.mesh.vertices[0], models.body.faces), meshes)
    camera = replace(camera, t=camera.t - camera.R @ shift)
    place = replace(to_body(values), translation=values["translation"] + shift)
    figures = {
        **header(config),
        **measure_all(values, layers, meshes, photo, models),
        "camera": {"K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist(), "size": list(camera.size)},
        "body_model": described(config.body, place),
        "confidence": photo.confidence,
        "notes": [*photo.notes, *panel_notes(layers)],
    }
    write_meshes(out, body, layers, moved)
    result = FitResult(out, figures, place, body, tuple(shifted(layers, shift)), moved, photo=photo, camera=camera)
    pictures = write_pictures(result)
    took = time.perf_counter() - begin
    figures["seconds"] = {**seconds, "export": took, "total": sum(seconds.values()) + took}
    write_report(result, pictures, config)
    write_whole(out / "result.json", json.dumps(figures, indent=1) + "\n")
    return result
