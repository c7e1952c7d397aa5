"""Named poses of the 24-joint rig."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.bodies.rig import JOINT_NAMES
from recon.types import Motion


def t_pose(n: int = 1) -> Tensor:
    """(n, 24, 3) zeros: arms level, legs 8 to 10 degrees apart, every joint's axes the world's."""
    return torch.zeros(n, len(JOINT_NAMES), 3)


def a_pose(n: int = 1, degrees: float = 45.0) -> Tensor:
    """(n, 24, 3) the T pose with both arms lowered by ``degrees`` about z (90: hanging straight down)."""
    pose = t_pose(n)
    pose[:, JOINT_NAMES.index("l_shoulder"), 2] = -math.radians(degrees)
    pose[:, JOINT_NAMES.index("r_shoulder"), 2] = math.radians(degrees)
    return pose


def stroll(seconds: float = 3.0, fps: float = 30.0) -> Motion:
    """A made walk forwards: legs and arms swing, arms low. For examples and tests that need a motion of their own."""
    t = torch.arange(round(seconds * fps)) / fps
    beat = 2 * math.pi * 0.9 * t
    pose = a_pose(len(t), 68.0)
    for side, sign in (("l_", 1.0), ("r_", -1.0)):
        swing = sign * torch.sin(beat)
        pose[:, JOINT_NAMES.index(side + "hip"), 0] = -0.38 * swing
        pose[:, JOINT_NAMES.index(side + "knee"), 0] = 0.25 + 0.35 * torch.sin(
            beat + (0 if sign > 0 else math.pi) - 1.9
        )
        pose[:, JOINT_NAMES.index(side + "shoulder"), 1] = 0.3 * torch.sin(beat)  # each arm against its leg
        pose[:, JOINT_NAMES.index(side + "elbow"), 1] = -sign * (0.35 + 0.15 * swing)
    pose[:, JOINT_NAMES.index("spine2"), 1] = 0.08 * torch.sin(beat)
    place = torch.zeros(len(t), 3)
    place[:, 2] = 1.1 * t
    place[:, 1] = 0.012 * torch.cos(2 * beat) - 0.012
    return Motion(pose, place, fps)
