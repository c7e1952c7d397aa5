"""How likely a pose is: anatomical limits, and a Gaussian learned from people who stand and move.

The Gaussian comes from ``pipelines/export_pose_prior.py``. Energies are in units of one ordinary pose: about 1 for a
pose as the clips have them; limits add ``(excess / LIMIT_SOFTNESS)²`` for each number that leaves its box.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.bodies.rig import JOINT_NAMES

LIMIT_SOFTNESS = 0.1
"""Excess over a limit [rad] that costs as much as an ordinary pose does altogether."""

_D = math.pi / 180
_FREE = ((-180, 180), (-180, 180), (-180, 180))
DEGREES = {
    "pelvis": _FREE,
    "spine1": ((-35, 60), (-35, 35), (-35, 35)),
    "spine2": ((-25, 45), (-35, 35), (-30, 30)),
    "spine3": ((-25, 35), (-35, 35), (-30, 30)),
    "neck": ((-45, 45), (-50, 50), (-35, 35)),
    "head": ((-45, 55), (-50, 50), (-35, 35)),
    "l_hip": ((-130, 40), (-50, 60), (-45, 75)),
    "l_knee": ((-10, 150), (-15, 15), (-10, 10)),
    "l_ankle": ((-50, 50), (-42, 40), (-35, 35)),
    "l_foot": ((-45, 25), (-10, 10), (-10, 10)),
    "l_collar": ((-25, 25), (-30, 30), (-30, 40)),
    "l_shoulder": ((-90, 90), (-135, 75), (-110, 95)),
    "l_elbow": ((-30, 30), (-150, 10), (-25, 25)),
    "l_wrist": ((-75, 75), (-40, 40), (-75, 75)),
    "l_hand": ((-15, 15), (-15, 15), (-30, 15)),
}
"""Boxes (low, high) of local axis-angle x, y, z [degrees], wide enough for athletes; right side: y and z mirrored.

In the T pose on the wearer's left: -z lowers the arm, -y brings it forward, -y bends the elbow, -x lifts the thigh
forward, +z spreads it, +x bends the knee back and points the foot down.
"""


@cache
def _limits() -> np.ndarray:
    rows = []
    for name in JOINT_NAMES:
        box = np.array(DEGREES[name.replace("r_", "l_", 1) if name.startswith("r_") else name], np.float64)
        rows.append(np.stack([box[0], -box[1, ::-1], -box[2, ::-1]]) if name.startswith("r_") else box)
    return np.stack(rows) * _D


@cache
def _gaussian() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (69,), Cholesky factor (69, 69) of the covariance and its inverse."""
    with np.load(Path(__file__).with_name("pose_prior.npz"), allow_pickle=False) as data:
        mean, root = data["mean"].astype(np.float64), data["cholesky"].astype(np.float64)
    return mean, root, np.linalg.inv(root)


def joint_limits() -> Tensor:
    """(24, 3, 2) lowest and highest local axis-angle of each joint [rad]; the pelvis is free."""
    return torch.as_tensor(_limits(), dtype=torch.float32)


def limit_energy(pose: Tensor) -> Tensor:
    """(B, 24, 3) -> (B,) sum of (excess over the limits / LIMIT_SOFTNESS)²; zero inside."""
    limits = torch.as_tensor(_limits(), dtype=pose.dtype, device=pose.device)[1:]
    body = pose[:, 1:]
    excess = (limits[..., 0] - body).clamp_min(0) + (body - limits[..., 1]).clamp_min(0)
    return (excess / LIMIT_SOFTNESS).square().sum((1, 2))


def mahalanobis(pose: Tensor) -> Tensor:
    """(B, 24, 3) -> (B,) mean squared Mahalanobis distance a number, of joints 1..23 to the learned Gaussian."""
    mean, _, whiten = (torch.as_tensor(v, dtype=pose.dtype, device=pose.device) for v in _gaussian())
    return ((pose[:, 1:].flatten(1) - mean) @ whiten.T).square().mean(1)


def pose_prior(pose: Tensor) -> Tensor:
    """(B, 24, 3) local axis-angle [rad] -> (B,) energy, about 1 for an ordinary pose; blind to the pelvis' turning."""
    if pose.dim() != 3 or tuple(pose.shape[1:]) != (24, 3):
        raise ValueError(f"pose: shape {tuple(pose.shape)}, wanted (B, 24, 3)")
    return mahalanobis(pose) + limit_energy(pose)


def mean_pose(n: int = 1) -> Tensor:
    """(n, 24, 3) the clips' average pose: standing, arms low, elbows and knees a little bent."""
    pose = torch.zeros(n, 24, 3)
    pose[:, 1:] = torch.as_tensor(_gaussian()[0], dtype=torch.float32).unflatten(0, (23, 3))
    return pose


def sample_poses(n: int, generator: torch.Generator, spread: float = 1.0) -> Tensor:
    """(n, 24, 3) random poses within the limits, the pelvis unturned; ``spread`` scales the Gaussian's deviations.

    Draws are cut at two deviations in the whitened space and then held inside the limits.
    """
    mean, root, _ = (torch.as_tensor(v, dtype=torch.float32) for v in _gaussian())
    z = torch.randn(n, len(mean), generator=generator, device=generator.device).clamp(-2, 2).cpu() * spread
    pose = torch.zeros(n, 24, 3)
    pose[:, 1:] = (mean + z @ root.T).unflatten(1, (23, 3))
    limits = joint_limits()
    return torch.maximum(torch.minimum(pose, limits[..., 1]), limits[..., 0])
