"""From one photo to simulation-ready garments: perceive, fit the body, fit garments outer to inner, refine, write."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from pipelines.fit_body import BodyFit, fit_body
from pipelines.fit_garment import GarmentFit, Layer, Models, fit_garment
from pipelines.models import load_models
from pipelines.refine import Refinement, refine
from pipelines.results import FitResult, write_results
from pipelines.run import Run, Say
from recon.files.state import file_digest
from recon.files.weights import read_manifest
from recon.types import Mesh, Photo, UserError, to_device


@dataclass(frozen=True)
class PhotoFit:
    """Settings of ``recon photo``."""

    photo: Path
    """The photo: one person, whole body at best."""
    garments: tuple[str, ...] = ("top", "trousers")
    """What the person wears, e.g. jacket,top,trousers; the order does not matter."""
    out: Path = Path("out/photo")
    """Folder for the results; a run that was interrupted goes on from there."""
    masks: tuple[str, ...] = ()
    """Your own masks: one label PNG (with ``labels``), or NAME=FILE with one binary PNG per garment."""
    labels: str = ""
    """Meaning of the label PNG's values, e.g. 1=top,2=trousers."""
    person: int | None = None
    """Which person, counted from the largest (1); None takes the largest and says so."""
    body: str = "anny"
    """Body model: anny (embedded) or smpl, smplh, smplx with ``body_file``."""
    body_file: Path | None = None
    """Your own SMPL, SMPL-H or SMPL-X file."""
    decoder: str = "isp"
    """What garments are made by: isp (sewing patterns) or udf (distance fields: any surface, but no patterns)."""
    draper: str = "skinning"
    """What puts them on the body while codes descend: skinning, isp (garments with panels) or drapenet."""
    weights: Path | None = None
    """Folder with decoder weights, and a draper's if it has some; None takes the shipped ones."""
    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """cpu or cuda."""
    body_fit: BodyFit = field(default_factory=BodyFit)
    """Settings of the body stage."""
    garment_fit: GarmentFit = field(default_factory=GarmentFit)
    """Settings of each garment's stage."""
    refinement: Refinement = field(default_factory=Refinement)
    """Settings of the refine stage."""


def fit_photo(config: PhotoFit, say: Say | None = None, tick=None) -> FitResult:
    """Fit the garments of one photo and write the results to ``config.out``.

    Args:
        config: see :class:`PhotoFit`.
        say: hears (stage, event, seconds) of every stage's start and end.
        tick: hears (step, loss) inside stages.

    Raises:
        UserError: one line about what is wrong with photo, masks, names, weights or the output folder.
    """
    from recon.files.masks import read_masks
    from recon.files.photos import read_photo
    from recon.perceive import perceive

    torch.manual_seed(config.seed)
    rgb = read_photo(config.photo)
    size = rgb.shape[0], rgb.shape[1]
    masks = read_masks(config.masks, config.labels, config.garments, size) if config.masks else None
    models = load_models(config.garments, config)
    run = open_run(config, masks, say)
    photo = run.stage("perceive", perceive, rgb, config.garments, config.person, masks)
    photo = worn(photo)
    fitted = fit_evidence(to_device(photo, torch.device(config.device)), models, config, run, tick)
    return write_results(config, photo, models, fitted, run.seconds)


def worn(photo: Photo) -> Photo:
    """The photo without garments that perception did not find, each with a note; UserError when none is left."""
    area = photo.rgb.shape[0] * photo.rgb.shape[1]
    found = {name: mask for name, mask in photo.garments.items() if mask.sum() >= 2e-4 * area}
    missing = [name for name in photo.garments if name not in found]
    if not found:
        raise UserError(f"photo: found no pixels of {', '.join(missing)}; wanted one garment at least (try --masks)")
    notes = [f"{name}: not found in the photo, left out" for name in missing]
    return replace(photo, garments=found, notes=(*photo.notes, *notes))


def open_run(config: PhotoFit, masks: dict[str, Tensor] | None, say: Say | None) -> Run:
    """The run's folder: its identity is the photo and the garments; masks, person, body and weights are evidence."""
    identity = {"photo": file_digest(config.photo), "garments": sorted(config.garments)}
    evidence = {
        "masks": {k: int(v.sum()) for k, v in masks.items()} if masks else {},
        "mask_files": [file_digest(m.partition("=")[2] or m) for m in config.masks],
        "labels": config.labels,
        "person": config.person,
        "body": [config.body, file_digest(config.body_file) if config.body_file else ""],
        "models": [config.decoder, config.draper],
        "weights": read_manifest(config.weights),
        "seed": config.seed,
        "device": config.device,
    }
    return Run(config.out, identity, evidence, config.device, *([say] if say else []))


def fit_evidence(
    photo: Photo, models: Models, config: PhotoFit, run: Run, tick=None
) -> tuple[dict[str, Tensor], list[Layer], dict[str, Mesh]]:
    """The fit itself: body and camera, then garments from outer to inner, then all of them under physics.

    Returns:
        Body and camera parameters; the layers at rest, graded, outermost first; name -> refined posed mesh.
    """
    values = run.stage(
        "body", lambda s: fit_body(photo, models.body, models.renderer_of, s, tick), config=config.body_fit
    )
    layers: list[Layer] = []
    settings = replace(config.garment_fit, body=config.body_fit)
    for name in photo.garments:
        values, layer = run.stage(
            name,
            lambda s, name=name, values=values: fit_garment(name, values, layers, photo, models, s, tick),
            config=settings,
        )
        layers.append(layer)
    refined = run.stage("refine", lambda s: refine(values, layers, photo, models, s, tick), config=config.refinement)
    return values, refined.layers, refined.meshes
