"""Garments on a moving body: ``recon animate tshirt skirt --motion walk.npz --out out/walk``.

Each garment is draped over the whole motion, by its GAPS network, by simulation or by skinning; then, frame by frame,
what passes through the body, through itself or through another layer is drawn apart, and everything is written.
Interrupted, the same command goes on: each garment, and every ``CHUNK`` frames of untangling, is a stage of a ``Run``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipelines.garment_source import load_garment
from pipelines.palette import SKIN, layer_colour
from pipelines.run import Run
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearing, clear_motion
from recon.bodies.retarget import motion_of
from recon.cloth.contact import BodyContact
from recon.cloth.projective import Projecting
from recon.cloth.untangle import Untangling, untangle
from recon.cloth.xpbd import Carry, Settings, carry
from recon.draping.dress import limits_of
from recon.draping.gaps import load_gaps
from recon.draping.openings import Openings
from recon.draping.skinning import SkinningDraper
from recon.files.animations import Moving, write_animated_glb, write_film, write_obj_sequence, write_pc2
from recon.files.atomic import write_whole
from recon.files.motions import read_clip
from recon.files.state import file_digest
from recon.files.weights import read_manifest
from recon.metrics import drape_errors
from recon.types import BodyPose, Garment, Mesh, Motion, PosedBody, UserError

DRAPERS = ("gaps", "simulate", "skinning")
WRITERS = ("glb", "obj", "pc2", "gif", "mp4")
ROUNDS, TRIES = 30, 3
"""Most rounds and tries of untangling per frame: what has no room in one frame mostly has none in the next."""
CHUNK = 20
"""Frames that are untangled between two times that this is kept."""
LEAD_IN = 24
"""Frames in which a simulated garment goes from the T pose to the motion's first."""


@dataclass(frozen=True)
class Animate:
    """Settings of ``recon animate``."""

    garments: tuple[str, ...]
    """What is worn, OUTERMOST FIRST: names of GAPS weights (tshirt ...), or garments as KIND:NUMBER, KIND:mean,
    KIND:test:N, or mesh files in the neutral T pose."""
    motion: Path
    """Motion file: npz (clip, rig or AMASS) or bvh."""
    out: Path = Path("out/animation")
    """Folder for the results."""
    fps: float = 30.0
    """Frames per second of the result."""
    start: float = 0.0
    """Where in the motion to begin [s]."""
    seconds: float = 0.0
    """How long; 0 = to its end [s]."""
    shape: tuple[float, ...] = ()
    """First coefficients of the body's shape; the rest are 0."""
    room: float = Clearing.gap
    """Room between parts of the body [m]: limbs that pass through it are turned, as little as gives cloth room;
    0 = the motion as recorded."""
    draper: str = ""
    """gaps, simulate or skinning; "" takes gaps for names of GAPS weights and simulates the rest."""
    steps: int = Projecting.steps
    """Projective steps after a GAPS network: they bring cloth near its lengths and out of the body; 0 = none."""
    untangle: bool = True
    """Draw apart what passes through the body, itself or another layer, frame by frame."""
    formats: tuple[str, ...] = ("glb", "gif")
    """What to write: glb, obj (one file a frame), pc2, gif, mp4."""
    size: int = 360
    """Height of the film's pictures [px]."""
    turn: float = 0.5
    """Turns of the camera around the person during the film."""
    weights: Path | None = None
    """Folder with GAPS weights; None takes the shipped ones."""


@dataclass(frozen=True)
class Animated:
    """What came out."""

    folder: Path
    parts: dict[str, Moving]
    """The garments, outermost first, and the body."""
    figures: dict
    """As in ``result.json``."""


def animate(config: Animate, say: Callable[[str], None] = print) -> Animated:
    """Drape, untangle, measure and write.

    Raises:
        UserError: unknown garment, draper or format; a motion that can't be read; a folder that holds other results.
    """
    _check(config)
    began = time.perf_counter()
    body = load_body()
    motion = cut(motion_of(read_clip(config.motion), body, config.fps), config)
    shape = _shape(config, body)
    if config.room:
        motion = clear_motion(motion, body, shape, Clearing(gap=config.room))
    for note in motion.notes:
        say(f"note: {note}")
    run = _open_run(config, say)
    pose = led_in(motion.body(shape))
    with torch.no_grad():
        posed = body.pose(pose)
    worn: list[Moving] = []
    for k, name in reversed(list(enumerate(config.garments))):
        job = lambda _, name=name: drape(name, config, body, pose, posed, worn)  # noqa: E731
        thing, frames = run.stage(f"drape-{_file_name(name)}", job, config=[config.draper, config.steps])
        worn.insert(0, Moving(thing, frames, layer_colour(k)))
    shown = posed.mesh.with_vertices(posed.mesh.vertices[LEAD_IN:])
    posed = replace(posed, mesh=shown, joints=posed.joints[LEAD_IN:])
    worn = [replace(part, frames=part.frames[LEAD_IN:]) for part in worn]
    figures: dict = {"garments": {}, "notes": list(motion.notes), "frames": len(motion.pose), "fps": config.fps}
    if config.untangle:
        worn, figures["untangle"] = untangled_in_stages(run, worn, posed, body)
    names = [_file_name(name) for name in config.garments]
    for name, part in zip(names, worn, strict=True):
        figures["garments"][name] = measure(part, posed, body)
    parts = dict(zip(names, worn, strict=True)) | {
        "body": Moving(Mesh(posed.mesh.vertices[0], body.faces), posed.mesh.vertices, SKIN)
    }
    write(parts, config)
    figures["seconds"] = round(time.perf_counter() - began, 1)
    write_whole(config.out / "result.json", json.dumps(figures, indent=1) + "\n")
    return Animated(config.out, parts, figures)


def _shape(config: Animate, body: Body) -> Tensor:
    """(1, S) of the body."""
    if len(config.shape) > body.n_shape:
        raise UserError(f"--shape: found {len(config.shape)} coefficients; wanted at most {body.n_shape}")
    shape = body.neutral().shape.clone()
    shape[0, : len(config.shape)] = torch.tensor(config.shape)
    return shape


def _open_run(config: Animate, say: Callable[[str], None]) -> Run:
    """The animation's folder: its identity is the motion and the garments."""

    def tell(stage: str, event: str, seconds: float) -> None:
        if event != "start":
            say(f"{stage:<24} {seconds:6.1f} s{' (kept)' if event == 'kept' else ''}")

    identity = {"motion": file_digest(config.motion), "garments": list(config.garments)}
    evidence = {
        "files": [file_digest(g) for g in config.garments if Path(g).is_file()],
        "weights": read_manifest(config.weights),
        "shape": list(config.shape),
        "part": [config.fps, config.start, config.seconds, config.room],
    }
    return Run(config.out, identity, evidence, say=tell)


def _check(config: Animate) -> None:
    if config.draper and config.draper not in DRAPERS:
        raise UserError(f"--draper: found {config.draper!r}; wanted one of {', '.join(DRAPERS)}")
    unknown = [f for f in config.formats if f not in WRITERS]
    if unknown:
        raise UserError(f"--formats: found {', '.join(unknown)}; wanted some of {', '.join(WRITERS)}")
    names = [_file_name(g) for g in config.garments]
    if len(set(names)) != len(names) or "body" in names:
        raise UserError(f"garments: found {', '.join(names)}; wanted different names, none of them body")
    if config.steps < 0:
        raise UserError(f"--steps: found {config.steps}; wanted 0 or more")
    if config.room < 0:
        raise UserError(f"--room: found {config.room}; wanted metres, 0 or more")
    if config.fps <= 0:
        raise UserError(f"--fps: found {config.fps}; wanted a positive number")
    if not config.motion.is_file():
        raise UserError(f"{config.motion}: no such file; wanted a motion (npz or bvh)")


def _file_name(garment: str) -> str:
    return Path(garment).stem if Path(garment).suffix else garment.replace(":", "-")


def cut(motion: Motion, config: Animate) -> Motion:
    """The part of the motion that is wanted."""
    first = round(config.start * motion.fps)
    last = first + round(config.seconds * motion.fps) if config.seconds else len(motion.pose)
    if first >= len(motion.pose):
        raise UserError(f"--start: found {config.start} s; the motion lasts {len(motion.pose) / motion.fps:.1f} s")
    return replace(motion, pose=motion.pose[first:last], translation=motion.translation[first:last])


def drape(
    name: str, config: Animate, body: Body, pose: BodyPose, posed: PosedBody, under: Sequence[Moving]
) -> tuple[Mesh | Garment, Tensor]:
    """One garment over the motion: what it is, and its (F, V, 3) vertices; ``under``: the layers beneath."""
    trained = f"gaps-{name}" in read_manifest(config.weights)
    how = config.draper or ("gaps" if trained else "simulate")
    if how == "gaps":
        draper = load_gaps(name, body, config.weights, Projecting(steps=config.steps))
        return draper.garment, draper.animate(posed, pose, config.fps)
    thing = load_gaps(name, body, config.weights).garment if trained else load_garment(name)
    rest = thing.mesh if isinstance(thing, Garment) else thing
    if how == "skinning":
        with torch.no_grad():
            return thing, SkinningDraper(body).drape_vertices(rest, posed)
    return thing, simulate(thing, body, posed, under)


def led_in(pose: BodyPose) -> BodyPose:
    """The motion with ``LEAD_IN`` frames before it, from the T pose to its first: garments are put on in T."""
    share = torch.linspace(0, 1, LEAD_IN + 1)[:-1]
    lead = pose.pose[:1] * share[:, None, None]
    lead[:, 0] = pose.pose[0, 0]
    place = torch.cat([pose.translation[:1].expand(LEAD_IN, -1), pose.translation])
    whole = torch.cat([lead, pose.pose])
    return BodyPose(pose.shape[:1].expand(len(whole), -1), whole, place)


@torch.no_grad()
def simulate(garment: Garment | Mesh, body: Body, posed: PosedBody, under: Sequence[Moving]) -> Tensor:
    """(F, V, 3) the garment carried along from the T pose by XPBD, over the layers beneath."""
    rest = garment.mesh if isinstance(garment, Garment) else garment
    skinned = SkinningDraper(body).drape_vertices(rest, posed).double().numpy()
    frames, faces = posed.mesh.vertices.numpy(), body.faces.numpy()
    for layer in under:
        faces = np.concatenate([faces, layer.faces.numpy() + frames.shape[1]])
        frames = np.concatenate([frames, layer.frames.float().numpy()], 1)
    settings = Settings(bend_compliance=1e-5, self_distance=0.6, offset=0.003, friction=0.2)
    path = carry(skinned, limits_of(garment), frames, faces, settings, Carry(steps=30, last_steps=0))
    return torch.as_tensor(np.stack(list(path))).float()


def untangled_in_stages(run: Run, worn: Sequence[Moving], posed: PosedBody, body: Body) -> tuple[list[Moving], dict]:
    """The layers drawn apart in every frame, kept every ``CHUNK`` frames, and how that went."""
    count, done = len(posed.mesh.vertices), []
    for first in range(0, count, CHUNK):
        part = slice(first, min(first + CHUNK, count))
        job = lambda _, part=part: untangled(worn, posed, body, part)  # noqa: E731
        done.append(run.stage(f"untangle-{first:05d}", job, config=[ROUNDS, TRIES, CHUNK]))
    frames = [torch.cat([chunk[0][k] for chunk in done]) for k in range(len(worn))]
    how = {key: sum((chunk[1][key] for chunk in done), start=type(done[0][1][key])()) for key in done[0][1]}
    how["notes"] = how["notes"][:20]
    return [replace(part, frames=own) for part, own in zip(worn, frames, strict=True)], how


def untangled(
    worn: Sequence[Moving], posed: PosedBody, body: Body, part: slice = slice(None)
) -> tuple[list[Tensor], dict]:
    """(F, V, 3) frames of each layer, drawn apart, of that part of the motion, and how that went."""
    frames: list[list[Tensor]] = [[] for _ in worn]
    clean, crossings, notes = 0, 0, list[str]()
    for k in range(len(posed.mesh.vertices))[part]:
        layers = [Mesh(own.frames[k], own.faces) for own in worn]
        done = untangle(layers, Mesh(posed.mesh.vertices[k], body.faces), Untangling(rounds=ROUNDS, tries=TRIES))
        clean += done.clean
        crossings += done.crossings
        notes += [f"frame {k}: {note}" for note in done.notes]
        for own, x in zip(frames, done.vertices, strict=True):
            own.append(torch.as_tensor(x).float())
    how = {"clean_frames": clean, "crossing_pairs_before": crossings, "notes": notes}
    return [torch.stack(own) for own in frames], how


def measure(part: Moving, posed: PosedBody, body: Body) -> dict[str, float]:
    """GAPS' figures of one garment over the motion, and the limbs that left its openings [% of the frames]."""
    inside = [BodyContact(b, body.faces).penetrating(x) for b, x in zip(posed.mesh.vertices, part.frames, strict=True)]
    rest = part.thing.mesh if isinstance(part.thing, Garment) else part.thing
    figures = {k: round(v, 4) for k, v in drape_errors(rest, part.frames, torch.stack(inside)).items()}
    left = Openings.worn_by(body, rest).left(part.frames, posed.joints)
    return figures | {"limbs_out_pct": round(100 * max(left.values(), default=0.0), 1)}


def write(parts: dict[str, Moving], config: Animate) -> None:
    """All files that were asked for."""
    if "glb" in config.formats:
        write_animated_glb(parts, config.out / "scene.glb", config.fps)
    if "obj" in config.formats:
        write_obj_sequence(parts, config.out)
    if "pc2" in config.formats:
        for name, part in parts.items():
            write_pc2(part, config.out / f"{name}.pc2", config.fps)
            if "obj" not in config.formats:
                write_obj_sequence({name: replace(part, frames=part.frames[:1])}, config.out)
    films = [f for f in config.formats if f in ("gif", "mp4")]
    if films:
        fps = min(config.fps, 15.0)
        pictures = film(parts, config, fps)
        for ending in films:
            write_film(pictures, config.out / f"film.{ending}", fps)


def film(parts: dict[str, Moving], config: Animate, fps: float) -> list[Tensor]:
    """Pictures of the motion, the camera on its way around the person, who stays in the middle."""
    from recon.render.shade import Look, orbit_camera, picture

    count = len(parts["body"].frames)
    shown = [round(k * config.fps / fps) for k in range(int((count - 1) * fps / config.fps) + 1)]
    colours = [part.colour for part in parts.values()]
    look = Look(samples=4, sky_rays=3, lamp_rays=1)
    middle = parts["body"].frames.mean(1)
    pictures = []
    frame = [Mesh(p.frames[0] - middle[0] * torch.tensor([1.0, 0, 1.0]), p.faces) for p in parts.values()]
    wide = [Mesh(m.vertices * torch.tensor([1.3, 1.1, 1.3]), m.faces) for m in frame]
    for number, k in enumerate(shown):
        around = 2 * np.pi * config.turn * number / max(len(shown), 1)
        camera = orbit_camera(wide, around, 0.1, (config.size, round(config.size * 0.75)))
        meshes = [Mesh(p.frames[k] - middle[k] * torch.tensor([1.0, 0, 1.0]), p.faces) for p in parts.values()]
        pictures.append(picture(meshes, colours, camera, look=look))
    return pictures
