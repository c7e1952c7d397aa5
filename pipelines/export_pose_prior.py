"""Learn the pose prior that ``recon.bodies.pose_prior`` reads from motion clips. Run once by hand.

Clips are npz files at 30 frames a second: ``names`` (J), ``parents`` (J), ``offsets`` (J, 3) [m], ``rotvec`` (F, J, 3)
local axis-angle [rad], y up, left = +x. A clip's world rotations go over to the 24-joint rig limb by limb: the rig's
limb points along its own rest direction, so ``W_rig = W_clip C`` where C is the smallest rotation that takes the rig's
rest direction to the clip's. The pelvis turns freely and is no part of the prior; every pose is also used mirrored.

The result is a Gaussian over the 69 local axis-angle numbers of joints 1..23: mean and Cholesky factor of the shrunk
covariance (correlations are pulled towards 0, standard deviations have a floor; hands, toes and collars by hand, clips
carry no more than noise there). Every clip counts the same. Frames whose pelvis tilts by more than 60 degrees are left
out: the prior is about standing and moving people.

Run: ``python -m pipelines.export_pose_prior --motions FOLDER [--out recon/bodies/pose_prior.npz]``
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon.bodies import load_body
from recon.bodies.rig import JOINT_NAMES, PARENTS

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
LEFT_OUT = ("modern_dance",)
"""Clips not learned from: upside down, and its feet are turned about in that conversion."""
BY_HAND = {"foot": 0.15, "hand": 0.15, "collar": 0.15, "wrist": 0.3}
"""Joints whose spread [rad] is set by hand, mean zero."""
FLOOR = 0.1
"""Smallest standard deviation [rad] of any number: a photo shows more kinds of people than thirteen clips."""
WIDEN = 1.25
"""Factor on the clips' standard deviations, for the same reason."""
SHRINK = 0.4
"""Share by which correlations are pulled towards zero."""


@dataclass
class Clip:
    """A motion clip: world rotations and rest offsets by joint name."""

    name: str
    names: list[str]
    offsets: np.ndarray  # (J, 3)
    world: np.ndarray  # (F, J, 3, 3)
    source: str
    """Where it was captured. CMU's feet follow the shin; elsewhere they were drawn flat in the rest pose."""


def read_clip(path: Path) -> Clip:
    """Read a clip and chain its local rotations."""
    with np.load(path, allow_pickle=False) as data:
        names, parents = [str(n) for n in data["names"]], data["parents"]
        rotvec, offsets = data["rotvec"].astype(np.float64), data["offsets"].astype(np.float64)
        source = str(data["source"])
    local = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix().reshape(*rotvec.shape[:2], 3, 3)
    world = np.empty_like(local)
    for j, p in enumerate(parents):
        world[:, j] = local[:, j] if p < 0 else world[:, p] @ local[:, j]
    return Clip(path.stem, names, offsets, world, source)


def smallest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
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


def to_local(world: np.ndarray) -> np.ndarray:
    """(F, 24, 3, 3) world rotations -> (F, 24, 3) local axis-angle."""
    parent = np.concatenate([np.broadcast_to(np.eye(3), world[:, :1].shape), world[:, list(PARENTS[1:])]], 1)
    local = np.swapaxes(parent, -1, -2) @ world
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(*world.shape[:2], 3)


def hinge_forward(world: np.ndarray, side: str) -> None:
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


def retarget(clip: Clip, joints: np.ndarray) -> np.ndarray:
    """(F, 24, 3) local axis-angle in the rig whose T-pose joints (24, 3) are given."""
    at = {n: i for i, n in reversed(list(enumerate(clip.names)))}
    world = np.tile(np.eye(3), (len(clip.world), 24, 1, 1))
    align: dict[str, np.ndarray] = {}  # the last limb's alignment, on each side
    for j, joint in enumerate(JOINT_NAMES):
        source, side, base = clip_joint(joint, clip.names), joint[:2], joint[2:]
        if source is None or base in ("foot", "hand"):
            world[:, j] = world[:, PARENTS[j]]
            continue
        world[:, j] = clip.world[:, at[source]]
        if base in LIMBS:
            ours = joints[JOINT_NAMES.index(side + LIMBS[base])] - joints[j]
            end = clip_joint(side + LIMBS[base], clip.names)
            if end is None:
                raise SystemExit(f"{clip.name}: found {source} without the joint that it points to")
            align[side] = smallest_rotation(ours, clip.offsets[at[end]])
        if base in LIMBS or base == "wrist" or (base == "ankle" and clip.source.startswith("CMU")):
            world[:, j] = world[:, j] @ align[side]  # hands and feet go on from the limb; but see Clip.source
    for side in ("l_", "r_"):
        hinge_forward(world, side)
    return to_local(world)


def mirrored(pose: np.ndarray) -> np.ndarray:
    """(F, 24, 3) the same poses seen in a mirror: sides exchanged, y and z turned the other way."""
    swap = [JOINT_NAMES.index({"l_": "r_", "r_": "l_"}.get(n[:2], n[:2]) + n[2:]) for n in JOINT_NAMES]
    return pose[:, swap] * np.array([1.0, -1.0, -1.0])


def gather(folder: Path, joints: np.ndarray) -> list[np.ndarray]:
    """One (F, 24, 3) array for each clip to learn from, mirrored copies included."""
    clips = []
    for path in sorted(folder.glob("*.npz")):
        clip = read_clip(path)
        if clip.name not in LEFT_OUT:
            pose = retarget(clip, joints)
            upright = Rotation.from_rotvec(pose[:, 0]).as_matrix()[:, 1, 1] > 0.5
            clips.append(np.concatenate([pose[upright], mirrored(pose[upright])]))
    if not clips:
        raise SystemExit(f"{folder}: found no motion clips (npz)")
    return clips


def learn(clips: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean (69,) and covariance (69, 69) over joints 1..23, every clip weighing the same."""
    weight = np.concatenate([np.full(len(c), 1 / len(c) / len(clips)) for c in clips])
    x = np.concatenate(clips)[:, 1:].reshape(len(weight), 69)
    mean = weight @ x
    covariance = (x - mean).T @ (weight[:, None] * (x - mean))
    spread = np.maximum(np.sqrt(np.diag(covariance)) * WIDEN, FLOOR)
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) + 1e-12)
    for j, joint in enumerate(JOINT_NAMES[1:]):
        if joint[2:] in BY_HAND:
            at = slice(3 * j, 3 * j + 3)
            mean[at], spread[at], correlation[at], correlation[:, at] = 0.0, BY_HAND[joint[2:]], 0.0, 0.0
    correlation *= 1 - SHRINK
    np.fill_diagonal(correlation, 1.0)
    return mean, correlation * np.outer(spread, spread)


def rest_joints() -> np.ndarray:
    """(24, 3) T-pose joints of the embedded body [m]."""
    body = load_body()
    return body.rest_joints(body.neutral().shape)[0].double().numpy()


def export(motions: Path, out: Path) -> dict:
    """Write the npz and return its card."""
    clips = gather(motions, rest_joints())
    mean, covariance = learn(clips)
    root = np.linalg.cholesky(covariance)
    energy = [float((np.linalg.solve(root, (c[:, 1:].reshape(len(c), 69) - mean).T) ** 2).mean()) for c in clips]
    card = {
        "name": "pose_prior",
        "clips": len(clips),
        "frames": sum(map(len, clips)) // 2,
        "energy_per_clip": np.round(energy, 2).tolist(),
        "source": "mocap.cs.cmu.edu (funded by NSF EIA-0196217) and AnimatedDrawings (MIT), statistics only",
    }
    np.savez_compressed(
        out, mean=mean.astype(np.float32), cholesky=root.astype(np.float32), card=np.array(json.dumps(card))
    )
    return card


def main() -> None:
    """Command line of the one-off export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motions", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("recon/bodies/pose_prior.npz"))
    args = parser.parse_args()
    print(json.dumps(export(args.motions, args.out), indent=1), args.out.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
