"""The common 24-joint rig: SMPL's joint order and tree, region names, axis-angle and the kinematic chain.

World-aligned axes: in the T pose (all zeros) every joint's local frame equals the world's, as in SMPL.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

JOINT_NAMES = (
    "pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle", "spine3", "l_foot",
    "r_foot", "neck", "l_collar", "r_collar", "head", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist",
    "r_wrist", "l_hand", "r_hand")  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
REGION_NAMES = ("head", "neck", "torso", "upper_arms", "forearms", "hands", "legs", "feet")


def rotation_matrices(axis_angle: Tensor) -> Tensor:
    """(..., 3) axis-angle [rad] -> (..., 3, 3) rotations (Rodrigues), with finite gradients of every order at zero."""
    square = (axis_angle * axis_angle).sum(-1)
    small = square < 1e-6  # below, the Taylor series is exact in float32 and, to 1e-13, in float64
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6 + square * square / 120, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - square / 24 + square * square / 720, (1 - torch.cos(angle)) / safe)
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return eye + a[..., None, None] * cross + b[..., None, None] * (cross @ cross)


def axis_angles(rotations: Tensor) -> Tensor:
    """(..., 3, 3) rotations -> (..., 3) axis-angle [rad], angles in [0, pi]; not meant for gradients near pi."""
    r = rotations
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    w = torch.stack([1 + trace] + [1 + 2 * r[..., i, i] - trace for i in range(3)], -1).clamp_min(0).sqrt() / 2
    # Four ways to write the quaternion; the one that divides by the largest component is the stable one.
    x = torch.stack([
        torch.stack([w[..., 0] ** 2 * 4, r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0],
                     r[..., 1, 0] - r[..., 0, 1]], -1),
        torch.stack([r[..., 2, 1] - r[..., 1, 2], w[..., 1] ** 2 * 4, r[..., 0, 1] + r[..., 1, 0],
                     r[..., 0, 2] + r[..., 2, 0]], -1),
        torch.stack([r[..., 0, 2] - r[..., 2, 0], r[..., 0, 1] + r[..., 1, 0], w[..., 2] ** 2 * 4,
                     r[..., 1, 2] + r[..., 2, 1]], -1),
        torch.stack([r[..., 1, 0] - r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1],
                     w[..., 3] ** 2 * 4], -1)], -2)  # fmt: skip
    best = w.argmax(-1)
    q = torch.gather(x, -2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    q = torch.nn.functional.normalize(q, dim=-1)
    q = torch.where(q[..., :1] < 0, -q, q)
    norm = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(norm, q[..., :1])
    return torch.where(norm < 1e-9, 2 * q[..., 1:], q[..., 1:] / norm.clamp_min(1e-12) * angle)


@lru_cache(maxsize=8)
def _generations(parents: tuple[int, ...]) -> tuple[tuple[tuple[int, ...], ...], tuple[int, ...]]:
    """Joints by their distance from the root, and each joint's place in the list of all generations."""
    depth = [0] * len(parents)
    for j, p in enumerate(parents):
        depth[j] = 0 if p < 0 else depth[p] + 1
    rows = tuple(tuple(j for j in range(len(parents)) if depth[j] == d) for d in range(max(depth) + 1))
    order = [j for row in rows for j in row]
    return rows, tuple(order.index(j) for j in range(len(parents)))


def chain(rotations: Tensor, joints: Tensor, parents: tuple[int, ...] = PARENTS) -> tuple[Tensor, Tensor]:
    """Forward kinematics with world-aligned axes, a generation of joints at a time.

    Local rotations (B, J, 3, 3), rest joints (B, J, 3) -> world rotations (B, J, 3, 3), posed joints (B, J, 3); the
    first joint stays where the rest body has it.
    """
    rows, place = _generations(tuple(parents))
    step = torch.cat([joints[:, :1], joints[:, 1:] - joints[:, list(parents[1:])]], 1)
    local = torch.cat([rotations, step[..., None]], -1)  # (B, J, 3, 4)
    world = [local[:, list(rows[0])]]
    for above, row in pairwise(rows):
        up = world[-1][:, [above.index(parents[j]) for j in row]]
        turned = up[..., :3] @ local[:, list(row)]
        world.append(torch.cat([turned[..., :3], turned[..., 3:] + up[..., 3:]], -1))
    whole = torch.cat(world, 1)[:, list(place)]
    return whole[..., :3], whole[..., 3]


def joint_transforms(rotations: Tensor, joints: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 24, 4, 4) rest space -> world and (B, 24, 3) posed joints, translation (B, 3) included.

    Of local rotations (B, 24, 3, 3) and rest joints (B, 24, 3).
    """
    world, posed = chain(rotations, joints)
    posed = posed + translation[:, None]
    offset = posed - (world @ joints[..., None])[..., 0]
    top = torch.cat([world, offset[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2), posed
