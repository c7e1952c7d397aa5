"""Poses as commands name them: a word, a random one, or a frame of a motion file."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from recon.bodies import Body
from recon.bodies.pose_prior import mean_pose, sample_poses
from recon.bodies.poses import a_pose, t_pose
from recon.bodies.retarget import motion_of
from recon.files.motions import read_clip
from recon.types import UserError

NAMED = {"t": t_pose, "a": a_pose, "stand": mean_pose}
"""Word -> function of the number of poses."""
FORMS = "t, a, stand, random:SEED, or a motion file (npz or bvh), FILE:FRAME for one of its frames"


def load_pose(name: str, body: Body) -> tuple[Tensor, Tensor | None]:
    """The pose (1, 24, 3) [rad] that ``name`` names, and the place (1, 3) [m] of the body in it, where it says so.

    Raises:
        UserError: none of ``FORMS``, no such file or frame.
    """
    word, _, rest = name.rpartition(":")
    if name in NAMED:
        return NAMED[name](1), None
    if word == "random" and rest.isdigit():
        return sample_poses(1, torch.Generator().manual_seed(int(rest))), None
    path, frame = (Path(word), int(rest)) if word and rest.isdigit() else (Path(name), 0)
    if path.suffix.lower() not in (".npz", ".bvh"):
        raise UserError(f"--pose: found {name!r}; wanted {FORMS}")
    clip = read_clip(path)
    motion = motion_of(clip, body, clip.fps)
    if frame >= len(motion.pose):
        raise UserError(f"--pose: {path} has {len(motion.pose)} frames; found frame {frame}, wanted 0 to its last")
    return motion.pose[frame : frame + 1], motion.translation[frame : frame + 1]
