"""Garments on a body: ``recon drape trousers:12 top:mean --pose walk.npz:40 --shape 1.2 -0.5 --out out/worn``.

Each garment is draped alone, by a network or by skinning; the layering network moves each over those beneath it (ISP
Algorithm 1); what still passes through the body, itself or another layer is drawn apart.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pipelines.garment_source import load_garment
from pipelines.palette import SKIN, layer_colour
from pipelines.pose_source import load_pose
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearing, clear_motion
from recon.cloth.beneath import Beneath
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stvk
from recon.cloth.intersections import self_intersections
from recon.cloth.projective import Projecting
from recon.draping import DRAPERS, Draper, load_draper
from recon.draping.apart import Apart, draw_apart
from recon.draping.isp import IspDraper
from recon.draping.layering import Layering, load_layering
from recon.draping.openings import Openings
from recon.draping.projected import ANY_POSE, ProjectedDraper
from recon.draping.skinning import SkinningDraper
from recon.files.atomic import write_whole
from recon.files.meshes import Colour, write_glb, write_obj
from recon.files.user_garments import read_garment_mesh
from recon.files.weights import folder_with, read_manifest
from recon.metrics import beneath_pct, inside_pct, largest_stretch
from recon.types import BodyPose, Garment, Mesh, Motion, PosedBody, UserError

OFF_BODY = 0.2
"""A mesh further than this from the neutral body is not worn by it [m]."""


@dataclass(frozen=True)
class Drape:
    """Settings of ``recon drape``."""

    garments: tuple[str, ...]
    """What is worn, INNERMOST FIRST: KIND:NUMBER, KIND:mean, KIND:random:SEED, KIND:FILE.json, KIND:train:N,
    KIND:test:N, or mesh files in the neutral T pose."""
    pose: str = "a"
    """t, a (arms lowered), stand, random:SEED, or a motion file (npz or bvh), of which FILE:FRAME takes a frame."""
    shape: tuple[float, ...] = ()
    """First coefficients of the body's shape, in deviations of the population; the rest are 0."""
    room: float = Clearing.gap
    """Room between parts of the body [m]: limbs that pass through it are turned, as little as gives cloth room;
    0 = the pose as it is."""
    out: Path = Path("out/drape")
    """Folder for the results."""
    draper: str = ""
    """isp, skinning or another of the drapers; "" takes isp for garments with panels and skinning for other meshes."""
    steps: int = Projecting.steps
    """Projective steps after the draper: they bring cloth near its lengths and out of the body; 0 = none."""
    decoder: str = "isp"
    """What makes the garments of codes: isp (with panels) or udf (without)."""
    resolution: int = 128
    """Cells of the grid that codes are cut on."""
    layering: bool = True
    """Move each garment over those beneath it (ISP Algorithm 1)."""
    untangle: bool = True
    """Draw apart what still passes through the body, itself or another layer."""
    weights: Path | None = None
    """Folder with weights of your own training; None takes the shipped ones."""


@dataclass(frozen=True)
class Draped:
    """What came out."""

    folder: Path
    garments: dict[str, Garment | Mesh]
    """Innermost first, as they lie on the body [m]."""
    body: Mesh
    """(V, 3) posed [m]."""
    figures: dict
    """As in ``result.json``."""


def drape(config: Drape, say: Callable[[str], None] = print) -> Draped:
    """Drape, layer, untangle, measure and write.

    Raises:
        UserError: unknown garment, pose or draper, too many shape coefficients, or a folder that holds other results.
    """
    _check(config)
    names, seconds = _names(config.garments), dict[str, float]()

    def timed(stage: str, began: float) -> None:
        seconds[stage] = round(time.perf_counter() - began, 3)
        say(f"{stage:<12} {seconds[stage]:6.2f} s")

    at = time.perf_counter()
    body = load_body()
    things, notes = _loaded(config, body)
    worn_by, more = _worn_by(config, body)
    posed, notes = body.pose(worn_by), notes + more
    timed("load", at)
    at = time.perf_counter()
    how, drapes = drape_each(things, posed, body, config)
    timed("drape", at)
    figures: dict = {"schema": 1, "what": "drape", "pose": config.pose, "shape": list(config.shape)}
    if config.layering:
        at = time.perf_counter()
        trained = "layers-isp" in read_manifest(config.weights)
        layering = load_layering(config.weights) if trained else Layering(None)
        figures["layering"] = "network" if trained else "forces alone: no weights layers-isp"
        drapes = layering(things, drapes, posed.mesh)
        timed("layer", at)
    layers = [mesh.with_vertices(mesh.vertices[0]) for mesh in drapes]
    figures["before_untangling"] = measure(names, things, layers, posed, body)
    if config.untangle:
        at = time.perf_counter()
        say("untangle ...")  # seconds for a pair, a minute for a stack
        apart = draw_apart(things, layers, body, worn_by, SkinningDraper(body), say)
        layers, posed, figures["untangle"] = apart.layers, apart.posed, _story(apart)
        how = [f"simulation, after {by}" for by in how] if apart.dressed else how
        timed("untangle", at)
    figures["garments"] = measure(names, things, layers, posed, body)
    for name, drawn in zip(names, how, strict=True):
        figures["garments"][name]["draper"] = drawn
    figures["seconds"], figures["notes"] = seconds, notes
    worn: dict[str, Garment | Mesh] = {}
    for name, thing, mesh in zip(names, things, layers, strict=True):
        worn[name] = replace(thing, mesh=mesh) if isinstance(thing, Garment) else mesh
    return _write(config, worn, Mesh(posed.mesh.vertices[0], body.faces), figures)


def _check(config: Drape) -> None:
    if not config.garments:
        raise UserError("garments: found none; wanted at least one, innermost first")
    if config.draper and config.draper not in DRAPERS:
        raise UserError(f"--draper: found {config.draper!r}; wanted one of {', '.join(DRAPERS)}")
    if config.steps < 0:
        raise UserError(f"--steps: found {config.steps}; wanted 0 or more")
    if config.room < 0:
        raise UserError(f"--room: found {config.room}; wanted metres, 0 or more")
    if not 16 <= config.resolution <= 1024:
        raise UserError(f"--resolution: found {config.resolution}; wanted 16 to 1024")
    if config.out.exists() and not _is_ours(config.out):
        raise UserError(f"{config.out}: holds what is no drape's; wanted an empty folder (--out)")


def _loaded(config: Drape, body: Body) -> tuple[list[Garment | Mesh], list[str]]:
    """The garments, and what was done to users' meshes: those are repaired as ``recon encode`` does, and must be at
    rest on the neutral body already."""
    things: list[Garment | Mesh] = []
    notes: list[str] = []
    neutral = body.pose(body.neutral()).mesh.vertices[0].detach()
    contact = BodyContact(neutral, body.faces)
    for name in config.garments:
        thing = load_garment(name, config.resolution, config.decoder, config.weights)
        if isinstance(thing, Mesh):
            repaired, told = read_garment_mesh(name)
            thing = repaired if told else thing  # as it is: its vertices keep their order
            notes += [f"{name}: {line}" for line in told]
            away = float(contact.signed_distance(thing.vertices).abs().median())
            if away > OFF_BODY:
                raise UserError(
                    f"{name}: lies {away:.2g} m from the neutral body (median); wanted a garment at rest on it, y up "
                    "(recon encode writes it so, as placed.obj)"
                )
        things.append(thing)
    return things, notes


def _is_ours(folder: Path) -> bool:
    """Whether a folder is empty or holds an earlier drape."""
    if not folder.is_dir():
        return False
    try:
        return not any(folder.iterdir()) or json.loads((folder / "result.json").read_text()).get("what") == "drape"
    except (OSError, ValueError, AttributeError):
        return False


def _names(garments: Sequence[str]) -> list[str]:
    """File names, each once."""
    names: list[str] = []
    for garment in garments:
        name = Path(garment).stem if Path(garment).suffix else garment.replace(":", "-")
        name = name.rpartition(":")[2]
        count = sum(other == name or other.startswith(f"{name}_") for other in ("body", *names))
        names.append(f"{name}_{count + 1}" if count else name)
    return names


def _worn_by(config: Drape, body: Body) -> tuple[BodyPose, list[str]]:
    """One body of the wanted shape and pose, and what was done to it."""
    notes: tuple[str, ...] = ()
    if len(config.shape) > body.n_shape:
        raise UserError(f"--shape: found {len(config.shape)} coefficients; wanted at most {body.n_shape}")
    shape = torch.zeros(1, body.n_shape)
    shape[0, : len(config.shape)] = torch.tensor(config.shape)
    if not shape.isfinite().all():
        raise UserError("--shape: found NaN or infinity; wanted numbers")
    pose, place = load_pose(config.pose, body)
    if config.room:
        motion = clear_motion(Motion(pose, torch.zeros(1, 3), 30.0), body, shape, Clearing(gap=config.room))
        pose, notes = motion.pose, motion.notes
    if place is None:  # on the floor
        place = torch.zeros(1, 3)
        place[0, 1] = -body.pose(BodyPose(shape, pose, place)).mesh.vertices[0, :, 1].min()
    return BodyPose(shape, pose, place), list(notes)


@torch.no_grad()
def drape_each(
    things: Sequence[Garment | Mesh], posed: PosedBody, body: Body, config: Drape
) -> tuple[list[str], list[Mesh]]:
    """Each garment alone, (B, V, 3), and the name of the draper that did it."""
    drapers: dict[str, Draper] = {}
    how: list[str] = []
    drapes: list[Mesh] = []
    folder = folder_with("drape", config.weights)
    skinning, projecting = SkinningDraper(body), replace(ANY_POSE, steps=config.steps)
    isp = load_draper("isp", body, folder) if config.draper in ("", "isp") else None
    for name, thing in zip(config.garments, things, strict=True):
        chosen = config.draper
        known = isinstance(isp, IspDraper) and isp.knows(thing)
        if chosen == "isp" and not known:
            raise UserError(f"{name}: has no panels that draper isp knows; wanted --draper skinning, or {_PANELLED}")
        chosen = chosen or ("isp" if known else "skinning")
        if chosen not in drapers:
            plain = isp if chosen == "isp" and isp is not None else load_draper(chosen, body, folder)
            drapers[chosen] = ProjectedDraper(plain, skinning, projecting) if config.steps else plain
        garment = Garment.of(thing)
        drapes.append(drapers[chosen].drape(garment, posed, under=drapes))
        how.append(chosen)
    return how, drapes


_PANELLED = "a garment as KIND:CODE"


def measure(
    names: Sequence[str], things: Sequence[Garment | Mesh], layers: Sequence[Mesh], posed: PosedBody, body: Body
) -> dict[str, dict]:
    """Figures of each garment, innermost first; ``limbs_out``: limbs that left an opening of theirs."""
    contact = BodyContact(posed.mesh.vertices[0], body.faces)
    beneath = [Beneath.of(m.vertices, m.faces) for m in layers]
    figures: dict[str, dict] = {}
    for k, (name, thing, mesh) in enumerate(zip(names, things, layers, strict=True)):
        rest = thing.mesh if isinstance(thing, Garment) else thing
        out = Openings.worn_by(body, rest).left(mesh.vertices[None], posed.joints)
        found = {
            "vertices": len(mesh.vertices),
            "inside_body_pct": round(inside_pct(mesh, contact), 4),
            "vertices_inside_body": int(contact.penetrating(mesh.vertices).sum()),
            "self_intersections": len(self_intersections(mesh.vertices, mesh.faces)),
            "limbs_out": [limb for limb, share in out.items() if share],
            "beneath_pct": {names[j]: round(beneath_pct(mesh, beneath[j]), 4) for j in range(k)},
        }
        if isinstance(thing, Garment):
            worn = replace(thing, mesh=mesh)
            stretch = largest_stretch(worn)
            found |= {
                "kind": thing.kind,
                "stretch_p95": round(float(stretch.quantile(0.95)), 4),
                "strain_joule": round(float(stvk(Cloth.from_garment(thing), mesh.vertices)), 4),
            }
        figures[name] = found
    return figures


def _story(apart: Apart) -> dict:
    done = apart.done
    return {
        "crossing_pairs_before": apart.before,
        "dressed_by_simulation": apart.dressed,
        "crossing_pairs_after": len(done.left),
        "inside_body_after": done.inside,
        "rounds": done.rounds,
        "clean": done.clean,
        "notes": list(done.notes),
    }


def _write(config: Drape, worn: dict[str, Garment | Mesh], body: Mesh, figures: dict) -> Draped:
    """Meshes first, ``result.json`` last."""
    config.out.mkdir(parents=True, exist_ok=True)
    for name, part in worn.items():
        write_obj(part, config.out / f"{name}.obj", name)
    write_obj(body, config.out / "body.obj", "body")
    parts: dict[str, tuple[Mesh | Garment, Colour]] = {"body": (body, SKIN)}
    parts |= {name: (part, layer_colour(k)) for k, (name, part) in enumerate(worn.items())}
    write_glb(parts, config.out / "scene.glb")
    write_whole(config.out / "result.json", json.dumps(figures, indent=1) + "\n")
    return Draped(config.out, worn, body, figures)
