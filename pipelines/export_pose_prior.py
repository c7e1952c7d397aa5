"""Learn the pose prior that ``recon.bodies.pose_prior`` reads from motion clips. Run once by hand.

Clips come to the 24-joint rig as ``recon.bodies.retarget`` does it. The pelvis turns freely and is no part of the
prior; every pose is also used mirrored.

The result is a Gaussian over the 69 local axis-angle numbers of joints 1..23: mean and Cholesky factor of the shrunk
covariance (correlations are pulled towards 0, standard deviations have a floor; hands, toes and collars by hand, clips
carry no more than noise there). Every clip counts the same. Frames whose pelvis tilts by more than 60 degrees are left
out: the prior is about standing and moving people.

Run: ``python -m pipelines.export_pose_prior --motions FOLDER [--out recon/bodies/pose_prior.npz]``
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon.bodies import load_body
from recon.bodies.retarget import mirrored, retarget
from recon.bodies.rig import JOINT_NAMES
from recon.files.motions import read_clip

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
