"""Motion clips on the 24-joint rig.

A clip's world rotations go over limb by limb: the rig's limb points along its own rest direction, so
``W_rig = W_clip C``, where C is the smallest rotation that takes the rig's rest direction to the clip's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from recon.bodies.rig import JOINT_NAMES, PARENTS, chain, rotation_matrices
from recon.files.motions import Clip
from recon.types import Motion, UserError

CLIP_NAMES = {
    "pelvis": "Hips",
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
    "neck": "Neck",
    "head": "Head",
}
"""Joint of the rig -> joint of a clip (trunk); limbs are listed in ``SIDED``."""
SIDED = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
         "elbow": "ForeArm", "wrist": "Hand"}  # fmt: skip
LONG_SPINE = {"spine1": "Spine1", "spine2": "Spine2", "spine3": "Spine3"}
"""Clips with a Spine2 and no LowerBack name the chain differently."""
LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Joint -> the joint that its limb points to."""
NEEDED = ("Hips", *(side + base for side in ("Left", "Right") for base in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm")))
"""Joints without which a clip says too little."""
FASTEST = 60.0
"""No joint turns faster than this [rad/s], an acrobat's about 25: a frame that needs it is bad."""
FEET = [JOINT_NAMES.index(n) for n in ("l_ankle", "r_ankle", "l_foot", "r_foot")]


def smallest_rotation(a: NDArray, b: NDArray) -> NDArray:
    """(3, 3) smallest rotation taking direction a to direction b (not opposite)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    c = np.cross(a, b)
    cross = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def clip_joint(joint: str, names: list[str]) -> str | None:
    """The clip's joint that drives a joint of the rig, or None where the clip has none."""
    if joint[:2] in ("l_", "r_"):
        found = {"l_": "Left", "r_": "Right"}[joint[:2]] + SIDED.get(joint[2:], "?")
    else:
        table = CLIP_NAMES | (LONG_SPINE if "LowerBack" not in names else {})
        found = table[joint]
    return found if found in names else None


def to_local(world: NDArray) -> NDArray:
    """(F, 24, 3, 3) world rotations -> (F, 24, 3) local axis-angle."""
    parent = np.concatenate([np.broadcast_to(np.eye(3), world[:, :1].shape), world[:, list(PARENTS[1:])]], 1)
    local = np.swapaxes(parent, -1, -2) @ world
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(*world.shape[:2], 3)


def hinge_forward(world: NDArray, side: str) -> None:
    """Turn arm, forearm and hand about the arm's axis, by one angle a clip, so that the elbow bends about y (in place).

    Skeletons differ in where the elbow's hinge points in their T pose; in ours the forearm bends straight forward.
    """
    arm, elbow, wrist = (JOINT_NAMES.index(side + n) for n in ("shoulder", "elbow", "wrist"))
    bend = Rotation.from_matrix(np.swapaxes(world[:, arm], 1, 2) @ world[:, elbow]).as_rotvec()
    y, z = bend[:, 1:].T @ np.linalg.norm(bend[:, 1:], axis=1)
    if np.hypot(y, z) < 1e-3:
        return
    angle = np.arctan(z / y)  # the nearer way round: an elbow that overstretches a little keeps doing so
    turn = Rotation.from_rotvec([angle, 0, 0]).as_matrix()
    for j in (arm, elbow, wrist, JOINT_NAMES.index(side + "hand")):
        world[:, j] = world[:, j] @ turn


def retarget(clip: Clip, joints: NDArray) -> NDArray:
    """(F, 24, 3) local axis-angle in the rig whose T-pose joints (24, 3) are given [m]; frames must be finite.

    Raises:
        UserError: the clip lacks a joint that is needed.
    """
    if not clip.names:
        return Rotation.from_matrix(clip.local.reshape(-1, 3, 3)).as_rotvec().reshape(*clip.local.shape[:2], 3)
    missing = [name for name in NEEDED if name not in clip.names]
    if missing:
        raise UserError(f"{clip.name}: found no joint {', '.join(missing)}; wanted joints named as in CMU's BVH files")
    at = {n: i for i, n in reversed(list(enumerate(clip.names)))}
    source_world = clip.world
    world = np.tile(np.eye(3), (len(source_world), 24, 1, 1))
    align: dict[str, NDArray] = {}  # the last limb's alignment, on each side
    for j, joint in enumerate(JOINT_NAMES):
        source, side, base = clip_joint(joint, clip.names), joint[:2], joint[2:]
        if source is None or base in ("foot", "hand"):
            world[:, j] = world[:, PARENTS[j]]
            continue
        world[:, j] = source_world[:, at[source]]
        if base in LIMBS:
            ours = joints[JOINT_NAMES.index(side + LIMBS[base])] - joints[j]
            end = clip_joint(side + LIMBS[base], clip.names)
            if end is None:
                raise UserError(f"{clip.name}: found {source} without the joint that it points to")
            align[side] = smallest_rotation(ours, clip.offsets[at[end]])
        if base in LIMBS or base == "wrist" or (base == "ankle" and clip.source.startswith("CMU")):
            # Hands and feet go on from the limb; but feet that were drawn flat in the rest pose (not CMU's) do not.
            world[:, j] = world[:, j] @ align[side]
    for side in ("l_", "r_"):
        hinge_forward(world, side)
    return to_local(world)


def mirrored(pose: NDArray) -> NDArray:
    """(F, 24, 3) the same poses seen in a mirror: sides exchanged, y and z turned the other way."""
    swap = [JOINT_NAMES.index({"l_": "r_", "r_": "l_"}.get(n[:2], n[:2]) + n[2:]) for n in JOINT_NAMES]
    return pose[:, swap] * np.array([1.0, -1.0, -1.0])


def motion_of(clip: Clip, body, fps: float | None = None) -> Motion:
    """A clip as the body plays it: bad frames bridged and noted, feet on the floor, at ``fps`` frames a second.

    Bad are frames with numbers that are none, and frames that a joint would reach only by turning faster than
    ``FASTEST``; they are interpolated between their good neighbours.

    Raises:
        UserError: a joint is missing, or fewer than half of the frames are good.
    """
    clip, notes = _mended(clip)
    joints = body.rest_joints(body.neutral().shape)[0].detach().cpu().double().numpy()
    pose = retarget(clip, joints)
    translation = _placed(clip, pose, body, joints)
    motion = Motion(torch.as_tensor(pose).float(), torch.as_tensor(translation).float(), clip.fps, notes)
    return motion if fps is None or abs(fps - clip.fps) < 1e-6 else resampled(motion, fps)


def _mended(clip: Clip) -> tuple[Clip, tuple[str, ...]]:
    """The clip with bad frames interpolated, and a line about them."""
    frames = len(clip.local)
    sound = np.isfinite(clip.local).all((1, 2, 3)) & np.isfinite(clip.root).all(1)
    last: int | None = None
    for k in np.flatnonzero(sound).tolist():
        if last is not None and _turn(clip.local[last], clip.local[k]) * clip.fps / (k - last) > FASTEST:
            sound[k] = False
            continue
        last = k
    bad = np.flatnonzero(~sound)
    if len(bad) * 2 > frames:
        raise UserError(f"{clip.name}: {len(bad)} of {frames} frames are bad; wanted a motion")
    if not len(bad):
        return clip, ()
    good = np.flatnonzero(sound)
    local, root = clip.local.copy(), clip.root.copy()
    at = np.clip(np.arange(frames), good[0], good[-1])
    for j in range(local.shape[1]):
        turns = Rotation.from_matrix(clip.local[good, j])
        local[:, j] = Slerp(good, turns)(at).as_matrix() if len(good) > 1 else turns.as_matrix()[[0] * frames]
    for k in range(3):
        root[:, k] = np.interp(at, good, clip.root[good, k])
    shown = ", ".join(map(str, bad[:8])) + (" ..." if len(bad) > 8 else "")
    return replace(clip, local=local, root=root), (f"{clip.name}: {len(bad)} bad frames interpolated ({shown})",)


def _turn(a: NDArray, b: NDArray) -> float:
    """Largest angle [rad] between two frames' local rotations (J, 3, 3)."""
    trace = np.einsum("jkl,jkl->j", a, b)
    return float(np.arccos(np.clip((trace - 1) / 2, -1, 1)).max())


def _placed(clip: Clip, pose: NDArray, body, joints: NDArray) -> NDArray:
    """(F, 3) translations: the clip's path scaled to the body's legs, the lowest feet as high as at rest."""
    root = clip.root.copy()
    if clip.names:
        at = clip.names.index
        theirs = sum(np.linalg.norm(clip.offsets[at(f"Left{n}")]) for n in ("Leg", "Foot"))
        hip, knee, ankle = (joints[JOINT_NAMES.index(n)] for n in ("l_hip", "l_knee", "l_ankle"))
        root *= (np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee)) / max(theirs, 1e-6)
        root -= joints[0]
    turned = rotation_matrices(torch.as_tensor(pose))
    posed = chain(turned, torch.as_tensor(joints)[None].expand(len(pose), -1, -1))[1].numpy()
    feet = posed[:, FEET, 1].min(1) + root[:, 1]
    root[:, 1] += joints[FEET, 1].min() - np.quantile(feet, 0.02)
    return root - root[0] * [1.0, 0.0, 1.0]


def resampled(motion: Motion, fps: float) -> Motion:
    """The same motion at another frame rate: rotations along great circles, places along lines."""
    pose, place = motion.pose.double().numpy(), motion.translation.double().numpy()
    old = np.arange(len(pose)) / motion.fps
    new = np.arange(int(np.floor(old[-1] * fps + 1e-9)) + 1) / fps
    out = np.empty((len(new), *pose.shape[1:]))
    for j in range(pose.shape[1]):
        turns = Rotation.from_rotvec(pose[:, j])
        out[:, j] = Slerp(old, turns)(new).as_rotvec() if len(old) > 1 else turns.as_rotvec()
    where = np.stack([np.interp(new, old, place[:, k]) for k in range(3)], 1)
    return replace(
        motion, pose=torch.as_tensor(out).float(), translation=torch.as_tensor(where).float(), fps=float(fps)
    )
