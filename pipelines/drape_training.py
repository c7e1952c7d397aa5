"""What every training of a draping network needs: motion clips, and bodies in random poses and of random shapes."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.progress import track
from safetensors.torch import load_file, save
from torch import Tensor

from recon.bodies import Body
from recon.bodies.clearance import Clearance, Clearing, clear_motion
from recon.bodies.pose_prior import sample_poses
from recon.bodies.retarget import mirrored, motion_of
from recon.bodies.rig import JOINT_NAMES
from recon.files.atomic import write_whole
from recon.files.motions import read_clip
from recon.types import BodyPose, Motion, UserError

ARMS = torch.tensor(
    [any(part in name for part in ("collar", "shoulder", "elbow", "wrist", "hand")) for name in JOINT_NAMES]
)
"""(24,) which joints are the arms'."""
HELD_OUT = ("jump_turn",)
"""Clips that no training sees, by their files' stems."""
CLIP_TERMS = "Apache-2.0; learned from motion clips, whose terms hold: of the shipped weights' see THIRD_PARTY.md"
"""Licence of a network that learned from motion clips."""


def read_motions(
    folder: Path, holdout: Collection[str], body: Body, fps: float, kept: Path | None = None
) -> list[Motion]:
    """The clips of a folder (npz or bvh) at ``fps``, each followed by its mirror image further down the list.

    Limbs are clear of the neutral body: where they pass through it no cloth can lie. Clearing takes 30 ms a frame:
    ``kept`` is a folder where cleared clips lie and are looked for, by what they were made from.

    Raises:
        UserError: there are none that are not held out, or one can't be read.
    """
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in (".npz", ".bvh"))
    files = [p for p in files if p.stem not in holdout]
    if not files:
        raise UserError(f"{folder}: found no motion clips (npz or bvh) to learn from")
    motions = [_cleared(file, body, fps, kept) for file in track(files, "clips")]
    return motions + [_mirror(m) for m in motions]


def _cleared(file: Path, body: Body, fps: float, kept: Path | None) -> Motion:
    """One clip, cleared; from ``kept`` where it is there."""
    motion = motion_of(read_clip(file), body, fps)
    made = hashlib.sha256(f"{body.name} {Clearing()}".encode() + motion.pose.numpy().tobytes()).hexdigest()
    at = kept / "clips" / f"{file.stem}-{made[:16]}.safetensors" if kept else None
    if at and at.is_file():
        return replace(motion, pose=load_file(at)["pose"])
    motion = clear_motion(motion, body, body.neutral().shape)
    if at:
        write_whole(at, save({"pose": motion.pose.contiguous()}))
    return motion


def _mirror(motion: Motion) -> Motion:
    pose = torch.as_tensor(mirrored(motion.pose.numpy())).float()
    return replace(motion, pose=pose, translation=motion.translation * torch.tensor([-1.0, 1.0, 1.0]))


@dataclass(frozen=True)
class Sampling:
    """How bodies for quasi-static draping are drawn."""

    clips: float = 0.5
    """Share of poses from motion clips; the others are random ones within the joints' limits."""
    swap: float = 0.5
    """Share of clip poses whose arms come from another frame: a dozen clips hold few combinations."""
    spread: float = 1.0
    """Factor on the deviations of the random poses' Gaussian."""
    calm: float = 0.2
    """Share of all poses that are led back towards the T pose by a random factor."""
    shape_spread: float = 1.0
    """Standard deviation of the shape coefficients, cut at two: one is the population's."""
    pool: int = 400
    """Poses that are drawn and cleared once, to choose from: clearing takes some 30 ms each."""


class BodySampler:
    """Random bodies to drape on, repeatable from a generator."""

    def __init__(
        self,
        motions: Sequence[Motion],
        n_shape: int,
        settings: Sampling | None = None,
        clearance: Clearance | None = None,
    ):
        """
        Args:
            motions: where clip poses come from; none: all poses are random.
            n_shape: number of shape coefficients.
            settings: see :class:`Sampling`.
            clearance: turns limbs out of the body, in a pool of poses drawn once; None: poses as they are.
        """
        self.settings = settings or Sampling()
        self.n_shape = n_shape
        self.frames = torch.cat([m.pose for m in motions]) if motions else torch.zeros(0, 24, 3)
        self.pool: Tensor | None = None
        if clearance is not None:
            drawn = self._poses(self.settings.pool, torch.Generator().manual_seed(0))
            self.pool = torch.cat([clearance.cleared(some) for some in drawn.split(100)])

    def __call__(self, count: int, generator: torch.Generator) -> BodyPose:
        """``count`` bodies; pelvis turned as in the clips, standing at the origin."""
        if self.pool is None:
            pose = self._poses(count, generator)
        else:
            pose = self.pool[torch.randint(len(self.pool), (count,), generator=generator)]
        shape = torch.randn(count, self.n_shape, generator=generator).clamp(-2, 2) * self.settings.shape_spread
        return BodyPose(shape, pose, torch.zeros(count, 3))

    def _poses(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 24, 3) drawn anew."""
        s = self.settings

        def chosen(share: float) -> Tensor:
            return torch.rand(count, 1, 1, generator=generator) < share

        pose = sample_poses(count, generator, s.spread)
        if len(self.frames):
            legs, arms = self.frames[torch.randint(len(self.frames), (2, count), generator=generator)]
            clip = torch.where(chosen(s.swap) & ARMS[:, None], arms, legs)
            pose = torch.where(chosen(s.clips), clip, pose)
        factor = torch.where(chosen(s.calm), torch.rand(count, 1, 1, generator=generator), torch.ones(count, 1, 1))
        return torch.cat([pose[:, :1], pose[:, 1:] * factor], 1)
