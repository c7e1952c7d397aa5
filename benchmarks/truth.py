"""Outfits of known truth for ``benchmarks/photo.py``: unseen test garments on unseen bodies and poses, as masks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from pipelines.evidence import level
from pipelines.fit_body import BodyFit, to_body
from pipelines.fit_garment import Models
from pipelines.measure import overlaps
from pipelines.photo import PhotoFit, fit_evidence, load_models
from pipelines.run import Run
from recon.bodies.pose_prior import sample_poses
from recon.draping.dress import dress, neutral
from recon.garments.dataset import load_garments
from recon.garments.grading import grade
from recon.metrics import compare_meshes
from recon.types import BodyPose, Camera, Mesh, Photo

SIZE = (800, 600)
OUTFITS = (("top", "trousers"), ("top", "skirt"), ("dress",))
CLOSE_HANDS = 0.35
"""Share of a random pose that is kept: standing people, not acrobats."""
NOISE = 0.01
"""Standard deviation of the made landmarks in the photo and in space, in units of the person's height."""
TRUSTED = BodyFit(places=60.0, shape=0.2, upright=0.02, straight=0.01)
"""The made landmarks lie where they should in space but for that noise, so they weigh as such; a network's guess of a
photo leans by 10-20 degrees."""


@dataclass(frozen=True)
class Truth:
    """One made photo and the meshes that it shows."""

    photo: Photo
    meshes: dict[str, Mesh]
    """Garments as worn, outermost first."""
    body: Mesh
    pelvis: Tensor
    camera: Camera


def random_body(models: Models, generator: torch.Generator) -> BodyPose:
    """An unseen shape and pose in front of a camera at the world's origin that looks along -z."""
    shape = 0.7 * torch.randn(1, models.body.n_shape, generator=generator)
    pose = sample_poses(1, generator) * CLOSE_HANDS
    pose[0, 0] = torch.tensor([0.0, 0.5 * (torch.rand((), generator=generator).item() - 0.5), 0.0])
    arms = 0.6 + 0.4 * torch.rand((), generator=generator).item()
    pose[0, 16, 2], pose[0, 17, 2] = -arms, arms
    return BodyPose(shape, pose, torch.tensor([[0.0, -0.9, -3.2]]))


def make_truth(outfit: tuple[str, ...], number: int, models: Models) -> Truth:
    """Dress the body by simulation, render the masks, and note the body's own landmarks with their noise."""
    generator = torch.Generator().manual_seed(1000 + number)
    place = random_body(models, generator)
    camera = Camera(
        torch.tensor([[900.0, 0, SIZE[1] / 2], [0, 900.0, SIZE[0] / 2], [0, 0, 1]]),
        torch.diag(torch.tensor([1.0, -1.0, -1.0])),
        torch.zeros(3),
        SIZE,
    )
    with torch.no_grad():
        posed = models.body.pose(place)
        unposed, garments = models.body.pose(neutral(place)), []
        for name in outfit:
            tests = [g for g in load_garments(models.decoders[name].kind, "test") if g.variant in models.variants[name]]
            garment = tests[number % len(tests)]
            garments.append(grade(garment, models.draper.drape(garment, unposed).vertices[0]))
        worn = dress(garments, models.body, place, models.draper)
        meshes = {
            name: Mesh(torch.from_numpy(x).float(), g.mesh.faces)
            for name, x, g in zip(outfit, worn, garments, strict=True)
        }
        skin = Mesh(posed.mesh.vertices[0], models.body.faces)
        parts = [*meshes.values(), skin]
        renderer = models.renderer_of(
            [m.faces for m in parts], list(range(len(parts))), [len(m.vertices) for m in parts]
        )
        image = renderer([m.vertices for m in parts], camera, SIZE)
        points = models.body.landmarks(posed)[0]
        pixels = camera.project(points)
    noise = torch.randn(33, 2, generator=generator) * NOISE * (pixels[:, 1].max() - pixels[:, 1].min())
    height = points[:, 1].max() - points[:, 1].min()
    world = points - (points[23] + points[24]) / 2 + NOISE * height * torch.randn(33, 3, generator=generator)
    photo = Photo(
        rgb=torch.zeros(*SIZE, 3, dtype=torch.uint8),
        person=image.sum(0).clamp(0, 1),
        garments={name: image[i] > 0.5 for i, name in enumerate(outfit)},
        ignore=torch.zeros(SIZE, dtype=torch.bool),
        landmarks=torch.cat([pixels + noise, torch.ones(33, 1)], 1),
        landmarks_world=world,
    )
    return Truth(photo, meshes, skin, posed.joints[0, 0], camera)


@dataclass(frozen=True)
class Found:
    """A fit of a made photo, moved so that its pelvis is where the true one is: a photo leaves the depth open."""

    meshes: dict[str, Mesh]
    body: Mesh
    iou: dict[str, float]
    """Garment name -> overlap with its mask, as seen by the camera that was found."""


def fit_truth(truth: Truth, number: int, models: Models, config: PhotoFit) -> Found:
    """Fit one made photo as ``recon photo`` does after perception; stages are kept in ``config.out``."""
    run = Run(config.out, {"truth": number})
    values, layers, meshes = fit_evidence(truth.photo, models, config, run)
    at = level(truth.photo, 512).pick(tuple(layer.name for layer in layers))
    iou = overlaps(meshes, values, truth.photo, models, at)
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        shift = truth.pelvis - posed.joints[0, 0]
    moved = {name: mesh.with_vertices(mesh.vertices + shift) for name, mesh in meshes.items()}
    return Found(moved, Mesh(posed.mesh.vertices[0] + shift, models.body.faces), iou)


def run_truth(cases: int, out: Path) -> Iterator[dict]:
    """Fit every case; per kind IoU and symmetric point-to-surface distance, the pelvis moved onto the true one.

    Yields the figures so far after every case.
    """
    import shutil

    names = tuple(dict.fromkeys(n for outfit in OUTFITS for n in outfit))
    config = PhotoFit(photo=Path("made"), body_fit=TRUSTED)
    models = load_models(names, config)
    rows = []
    for number in range(cases):
        truth = make_truth(OUTFITS[number % len(OUTFITS)], number, models)
        folder = out / f"truth-{number}"
        shutil.rmtree(folder, ignore_errors=True)
        found = fit_truth(truth, number, models, replace(config, out=folder))
        for name, mesh in found.meshes.items():
            distance = compare_meshes(mesh, truth.meshes[name], torch.Generator().manual_seed(0))["surface_mm"]
            rows.append({"case": number, "garment": name, "iou": found.iou[name], "chamfer_mm": float(distance)})
            print(rows[-1], flush=True)
        yield {"rows": rows, "kinds": summary(rows)}


def summary(rows: list[dict]) -> dict[str, dict]:
    """Medians per garment name, and of all."""
    groups = {name: [r for r in rows if r["garment"] == name] for name in dict.fromkeys(r["garment"] for r in rows)}
    groups["all"] = rows
    return {
        name: {k: median(r[k] for r in mine) for k in ("iou", "chamfer_mm")} | {"cases": len(mine)}
        for name, mine in groups.items()
    }
