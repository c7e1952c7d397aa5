"""Drapes to teach GAPS' last layer by: the network's own, after projective steps, on windows of motion."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from rich.progress import track
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from pipelines.drape_training import ARMS
from recon.bodies import Body
from recon.cloth.energies import Cloth
from recon.cloth.projective import Projecting, Projective
from recon.draping.dress import held_vertices
from recon.draping.gaps import GapsDraper, motion_features
from recon.types import BodyPose, Mesh, Motion, UserError

CHUNK = 25
"""Windows draped between two times that they are kept."""


@dataclass(frozen=True)
class Teaching:
    """How drapes are made and learned from."""

    windows: int = 400
    """Windows of motion; 0 = the last layer stays as physics left it, and reads all states."""
    fit: bool = True
    """Whether drapes are made and the last layer learns them; False: it is only narrowed to ``rank``."""
    frames: int = 60
    """Frames of a window."""
    burn_in: int = 24
    """Frames of it that are not draped: they bring the hidden state where it is in the midst of a motion."""
    every: int = 6
    """Frames from one that is draped to the next."""
    swap: float = 0.3
    """Share of windows whose arms move as in another clip."""
    spread: float = 0.7
    """Deviation of the shape coefficients, times a random factor up to one: neutral bodies are frequent, too."""
    steps: int = 8
    """Projective steps."""
    offset: float = 0.004
    """Distance from the body that vertices are brought to [m]."""
    rank: int = 96
    """Drapes that the last layer mixes."""
    ridge: float = 1e-5
    """Of the least squares, by the number of drapes."""
    pushes: int = 4
    """Rounds in which what the map leaves beneath ``margin`` is pushed out, for near the drapes on average is often in
    the body. Each round lengthens edges a little."""
    margin: float = 0.003
    """Distance from the body below which vertices are pushed [m]."""


@dataclass(frozen=True)
class Drapes:
    """N windows of T frames, R of them draped."""

    features: Tensor
    """(N, T, FEATURES)."""
    shape: Tensor
    """(N, S)."""
    pose: Tensor
    """(N, R, 24, 3) of the draped frames [rad]."""
    place: Tensor
    """(N, R, 3) [m]."""
    moved: Tensor
    """(N, R, V, 3) displacements in the unposed space [m]."""
    normal: Tensor
    """(N, R, V, 3) of the body beside each vertex, zero where there is none."""
    gap: Tensor
    """(N, R, V) distance of each vertex from that plane [m]."""

    @staticmethod
    def rows(teaching: Teaching) -> Tensor:
        """(R,) which frames of a window are draped."""
        return torch.arange(teaching.burn_in, teaching.frames, teaching.every)


def drapes(draper: GapsDraper, motions: Sequence[Motion], body: Body, teaching: Teaching, kept: Path) -> Drapes:
    """``teaching.windows`` windows draped; files named ``kept`` and a number hold what is done: a killed run goes on.

    Raises:
        UserError: what is kept is of other settings, or of another network.
    """
    rest = draper.garment if isinstance(draper.garment, Mesh) else draper.garment.mesh
    settings = Projecting(steps=teaching.steps, offset=teaching.offset)
    steps = Projective(Cloth.from_mesh(rest), draper.bound.weights, held_vertices(draper.garment), settings)
    made = {"teaching": str(teaching), "frames": sum(len(m.pose) for m in motions), "rest": len(rest.vertices)}
    told = json.dumps(made | {"net": float(draper.net.out.weight.double().norm())})
    chunks = []
    for first in track(range(0, teaching.windows, CHUNK), "drapes"):
        file = kept.with_name(f"{kept.name}-{first:05d}.safetensors")
        if not file.is_file():
            generator = torch.Generator().manual_seed(first)
            count = min(CHUNK, teaching.windows - first)
            drawn = [Window.drawn(motions, body, teaching, generator) for _ in range(count)]
            many = [_window(draper, steps, w, body, Drapes.rows(teaching)) for w in drawn]
            kept.parent.mkdir(parents=True, exist_ok=True)
            whole = {f.name: torch.stack([w[f.name] for w in many]).contiguous() for f in fields(Drapes)}
            save_file(whole, file.with_suffix(".tmp"), {"made": told})
            file.with_suffix(".tmp").replace(file)
        with safe_open(file, "pt") as data:
            if data.metadata().get("made") != told:
                raise UserError(f"{file}: drapes of other settings or another network; delete them to make new ones")
            chunks.append({f.name: data.get_tensor(f.name) for f in fields(Drapes)})
    return Drapes(**{f.name: torch.cat([c[f.name] for c in chunks]) for f in fields(Drapes)})


@dataclass(frozen=True)
class Window:
    """A stretch of motion on a random body."""

    features: Tensor
    """(T, FEATURES)."""
    shape: Tensor
    """(S,)."""
    pose: Tensor
    """(R, 24, 3) of the frames to drape [rad]."""
    place: Tensor
    """(R, 3) [m]."""

    @classmethod
    def drawn(cls, motions: Sequence[Motion], body: Body, teaching: Teaching, generator: torch.Generator) -> Window:
        """A random one."""
        (pose, place), (arms, _) = (_stretch(motions, teaching, generator) for _ in range(2))
        if torch.rand((), generator=generator) < teaching.swap:
            pose = torch.where(ARMS[:, None], arms, pose)
        factor = teaching.spread * torch.rand((), generator=generator)
        shape = factor * torch.randn(body.n_shape, generator=generator).clamp(-2, 2)
        features = motion_features(pose[None, 1:], place[None, 1:], motions[0].fps, (pose[None, 0], place[None, 0]))
        rows = Drapes.rows(teaching)
        return cls(features[0], shape, pose[1:][rows], place[1:][rows])


@torch.no_grad()
def _window(draper: GapsDraper, steps: Projective, window: Window, body: Body, rows: Tensor) -> dict[str, Tensor]:
    """One window draped, as the fields of ``Drapes``."""
    moved = draper.net(window.features[None], window.shape[None])[0][0, rows]
    posed = body.pose(BodyPose(window.shape.expand(len(rows), -1), window.pose, window.place))
    guess = draper.placed(moved, posed.transforms, posed.shape)
    x = steps(guess, posed)
    normal, gap = steps.planes(x, posed)
    moved = moved + draper.bound.unposed(x - guess, posed.transforms)
    return {**vars(window), "moved": moved.half(), "normal": normal.half(), "gap": gap.half()}


def _stretch(motions: Sequence[Motion], teaching: Teaching, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A random stretch of motion and the frame before it: pose (T + 1, 24, 3), translation (T + 1, 3)."""
    lengths = torch.tensor([len(m.pose) for m in motions])
    motion = motions[int(torch.multinomial(lengths.float(), 1, generator=generator))]
    last = int(torch.randint(teaching.burn_in, len(motion.pose) + teaching.frames // 2, (), generator=generator))
    rows = torch.arange(last - teaching.frames, last + 1).clamp(0, len(motion.pose) - 1)  # people stand still beyond
    return motion.pose[rows], motion.translation[rows]
