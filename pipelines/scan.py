"""From one labelled scan to simulation-ready garments: read, fit the body, garments outer to inner, refine, write."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch

from pipelines.fit_garment import Layer, Models
from pipelines.fit_result import FitResult
from pipelines.fit_scan_body import ScanBodyFit, fit_scan_body
from pipelines.fit_scan_garment import ScanGarmentFit, fit_scan_garment
from pipelines.models import load_models
from pipelines.refine_scan import ScanRefinement, refine_scan
from pipelines.run import Run, Say
from pipelines.scan_results import Fitted, write_scan_results
from recon.files.state import file_digest
from recon.files.weights import read_manifest
from recon.types import BodyPose, Scan, to_device


@dataclass(frozen=True)
class ScanFit:
    """Settings of ``recon scan``."""

    scan: Path
    """The scan: PLY, OBJ, GLB, STL or OFF, mesh or points, or npz with ``points`` or ``vertices`` and ``faces``."""
    garments: tuple[str, ...] = ("top", "trousers")
    """What the person wears, e.g. jacket,top,trousers."""
    out: Path = Path("out/scan")
    """Folder for the results; a run that was interrupted goes on from there."""
    labels: str = ""
    """Labels per vertex or per face: npz (array ``labels``), npy, or the name of a PLY property; "" = in the scan."""
    values: str = ""
    """What the labels mean, e.g. 0=body,3=top,5=trousers; "" = 0 body, 1, 2 ... the garments as named above."""
    unit: str = "auto"
    """Unit of the scan: m, cm, mm, in, or auto."""
    up: str = "auto"
    """Its axis that points up: x, y, z, -x, -y, -z, or auto."""
    pose: Path | None = None
    """A known start of the body: npz or json with ``pose`` (24, 3) [rad], ``shape``, ``translation`` [m] if known."""
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
    body_fit: ScanBodyFit = field(default_factory=ScanBodyFit)
    """Settings of the body stage."""
    garment_fit: ScanGarmentFit = field(default_factory=ScanGarmentFit)
    """Settings of each garment's stage."""
    refinement: ScanRefinement = field(default_factory=ScanRefinement)
    """Settings of the refine stage."""


def fit_scan(config: ScanFit, say: Say | None = None, tick=None) -> FitResult:
    """Fit the garments of one labelled scan and write the results to ``config.out``.

    Args:
        config: see :class:`ScanFit`.
        say: hears (stage, event, seconds) of every stage's start and end.
        tick: hears (step, loss) inside stages.

    Raises:
        UserError: one line about what is wrong with scan, labels, names, weights or the output folder.
    """
    from recon.files.scans import ScanSource, read_scan
    from recon.perceive.photo import ordered

    torch.manual_seed(config.seed)
    source = ScanSource(config.scan, config.labels, config.values, config.unit, config.up)
    scan = read_scan(source, config.garments, ordered(config.garments))
    models = load_models(config.garments, config)
    start = read_start(config.pose, models, scan) if config.pose else None
    run = open_run(config, say)
    fitted = fit_labelled(to_device(scan, torch.device(config.device)), models, config, run, start, tick)
    return write_scan_results(config, scan, models, fitted, run.seconds)


def fit_labelled(
    scan: Scan, models: Models, config: ScanFit, run: Run, start: BodyPose | None = None, tick=None
) -> Fitted:
    """The fit itself: the body, then garments from outer to inner, then all of them under physics and the scan."""
    values = run.stage("body", lambda s: fit_scan_body(scan, models.body, s, start, tick), config=config.body_fit)
    layers: list[Layer] = []
    for name in scan.names[1:]:
        values, layer = run.stage(
            name,
            lambda s, name=name, values=values: fit_scan_garment(name, values, layers, scan, models, s, tick),
            config=config.garment_fit,
        )
        layers.append(layer)
    refined = run.stage(
        "refine", lambda s: refine_scan(values, layers, scan, models, s, tick), config=config.refinement
    )
    return values, refined.layers, refined.meshes


def open_run(config: ScanFit, say: Say | None) -> Run:
    """The run's folder: its identity is the scan and the garments; labels, start, body and weights are evidence."""
    files = {"labels": config.labels, "pose": config.pose, "body_file": config.body_file}
    identity = {"scan": file_digest(config.scan), "garments": sorted(config.garments)}
    evidence = {
        **{k: file_digest(v) if v and Path(v).is_file() else str(v) for k, v in files.items()},
        **{k: getattr(config, k) for k in ("values", "unit", "up", "body", "decoder", "draper", "seed", "device")},
        "named": list(config.garments),
        "weights": read_manifest(config.weights),
    }
    return Run(config.out, identity, evidence, config.device, *([say] if say else []))


def read_start(path: Path, models: Models, scan: Scan) -> BodyPose:
    """A known pose from a user's file; without a translation the body is set under the scan's middle."""
    from recon.files.poses import read_pose

    pose, shape, place = read_pose(path)
    body = models.body
    start = body.neutral()
    start = BodyPose(start.shape if shape is None else shape[None, : body.n_shape], pose[None], start.translation)
    if place is not None:
        return to_device(BodyPose(start.shape, start.pose, place[None]), body.weights.device)
    vertices = body.pose(start).mesh.vertices[0]
    middle = (scan.points.amin(0) + scan.points.amax(0) - vertices.amin(0) - vertices.amax(0)) / 2
    return to_device(BodyPose(start.shape, start.pose, middle[None]), body.weights.device)
