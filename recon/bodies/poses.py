"""Named poses of the 24-joint rig."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.bodies.rig import JOINT_NAMES


def t_pose(n: int = 1) -> Tensor:
    """(n, 24, 3) zeros: arms level, legs 8 to 10 degrees apart, every joint's axes the world's."""
    return torch.zeros(n, len(JOINT_NAMES), 3)


def a_pose(n: int = 1, degrees: float = 45.0) -> Tensor:
    """(n, 24, 3) the T pose with both arms lowered by ``degrees`` about z (90: hanging straight down)."""
    pose = t_pose(n)
    pose[:, JOINT_NAMES.index("l_shoulder"), 2] = -math.radians(degrees)
    pose[:, JOINT_NAMES.index("r_shoulder"), 2] = math.radians(degrees)
    return pose
