"""Clips on the rig: limbs point where the clip's do, bad frames are bridged, time and place are kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recon.bodies import load_body
from recon.bodies.retarget import mirrored, motion_of, resampled, retarget
from recon.bodies.rig import JOINT_NAMES, chain, rotation_matrices
from recon.files.motions import Clip
from recon.types import Motion, UserError

PARENT = {
    "Hips": None, "LowerBack": "Hips", "Spine": "LowerBack", "Spine1": "Spine", "Neck": "Spine1", "Head": "Neck",
    **{s + n: p if p in ("Hips", "Spine1") else s + p for s in ("Left", "Right") for n, p in {
        "UpLeg": "Hips", "Leg": "UpLeg", "Foot": "Leg", "Shoulder": "Spine1", "Arm": "Shoulder", "ForeArm": "Arm",
        "Hand": "ForeArm"}.items()},
}  # fmt: skip
OFFSET = {"UpLeg": (0.1, -0.05, 0), "Leg": (0.08, -0.4, 0), "Foot": (0.07, -0.4, 0), "Shoulder": (0.05, 0.1, 0),
          "Arm": (0.12, 0, 0), "ForeArm": (0.28, 0, 0), "Hand": (0.25, 0, 0)}  # fmt: skip


def clip(local: np.ndarray, root: np.ndarray | None = None, fps: float = 30.0) -> Clip:
    """A CMU-like skeleton with the local rotations (F, J, 3, 3)."""
    names = list(PARENT)
    offsets = np.zeros((len(names), 3))
    for i, name in enumerate(names):
        base = name.removeprefix("Left").removeprefix("Right")
        offsets[i] = np.array(OFFSET.get(base, (0, 0.1, 0))) * ([-1, 1, 1] if name.startswith("Right") else 1)
    parents = np.array([-1 if p is None else names.index(p) for p in PARENT.values()])
    place = np.tile([0.0, 0.9, 0.0], (len(local), 1)) if root is None else root
    return Clip("made", names, offsets, local, parents, place, fps)


def random_local(frames: int, seed: int = 0, size: float = 0.3) -> np.ndarray:
    turns = np.random.default_rng(seed).normal(size=(frames * len(PARENT), 3)) * size
    return Rotation.from_rotvec(turns).as_matrix().reshape(frames, len(PARENT), 3, 3)


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def joints(body) -> np.ndarray:
    return body.rest_joints(body.neutral().shape)[0].double().numpy()


def test_limbs_point_where_the_clips_do(joints: np.ndarray) -> None:
    made = clip(random_local(5))
    pose = retarget(made, joints)
    posed = chain(rotation_matrices(torch.as_tensor(pose)), torch.as_tensor(joints)[None].expand(5, -1, -1))[1].numpy()
    at = made.names.index
    for side, prefix in (("l_", "Left"), ("r_", "Right")):
        for ours, end, theirs, child in (
            ("hip", "knee", "UpLeg", "Leg"),
            ("knee", "ankle", "Leg", "Foot"),
            ("shoulder", "elbow", "Arm", "ForeArm"),
            ("elbow", "wrist", "ForeArm", "Hand"),
        ):
            limb = posed[:, JOINT_NAMES.index(side + end)] - posed[:, JOINT_NAMES.index(side + ours)]
            wanted = made.world[:, at(prefix + theirs)] @ made.offsets[at(prefix + child)]
            cosine = (limb * wanted).sum(1) / np.linalg.norm(limb, axis=1) / np.linalg.norm(wanted, axis=1)
            assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.01, (side, ours)


def test_bad_frames_are_bridged_and_told(body) -> None:
    local = np.repeat(random_local(1, size=0.1), 9, 0)
    local[3, 5] = np.nan
    local[6, 7] = Rotation.from_rotvec([0, 3.0, 0]).as_matrix()  # and back: faster than anyone turns
    motion = motion_of(clip(local), body)
    assert "2 bad frames" in motion.notes[0] and "(3, 6)" in motion.notes[0]
    assert bool(torch.isfinite(motion.pose).all())
    torch.testing.assert_close(motion.pose, motion.pose[:1].expand(9, -1, -1), atol=1e-5, rtol=0)
    local[:6] = np.nan
    with pytest.raises(UserError, match="7 of 9 frames"):
        motion_of(clip(local), body)


def test_missing_joints_are_named(body) -> None:
    made = clip(random_local(2))
    made.names[made.names.index("LeftArm")] = "Wing"
    with pytest.raises(UserError, match="LeftArm"):
        motion_of(made, body)


def test_feet_stand_on_the_floor_and_the_path_begins_at_home(body) -> None:
    still = np.tile(np.eye(3), (4, len(PARENT), 1, 1))
    path = np.array([[2.0, 1.3, 1.0]] * 4) + np.arange(4)[:, None] * [0.1, 0, 0]
    motion = motion_of(clip(still, path), body)
    with torch.no_grad():
        lowest = body.pose(motion.body(body.neutral().shape)).mesh.vertices[..., 1].amin(1)
    assert lowest.abs().max() < 0.02
    assert motion.translation[0, [0, 2]].abs().max() < 1e-6 and motion.translation[3, 0] > 0.25


def test_other_frame_rates_meet_the_old_ones(body) -> None:
    motion = motion_of(clip(random_local(7, size=0.2)), body)
    double = resampled(motion, 60)
    assert len(double.pose) == 13 and double.fps == 60
    torch.testing.assert_close(double.pose[::2], motion.pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(double.translation[::2], motion.translation, atol=1e-6, rtol=0)
    one = Motion(motion.pose[:1], motion.translation[:1], 30)
    assert len(resampled(one, 60).pose) == 1


def test_mirrored_twice_is_the_same(joints: np.ndarray) -> None:
    pose = retarget(clip(random_local(3)), joints)
    np.testing.assert_allclose(mirrored(mirrored(pose)), pose)


def test_the_made_walk_walks(body) -> None:
    from recon.bodies.pose_prior import limit_energy
    from recon.bodies.poses import stroll

    motion = stroll(1.2)
    with torch.no_grad():
        joints = body.pose(motion.body(body.neutral().shape)).joints
    assert motion.pose.shape == (36, 24, 3) and float(limit_energy(motion.pose).max()) == 0
    left, right = (joints[:, JOINT_NAMES.index(n)] for n in ("l_ankle", "r_ankle"))
    hands = [joints[:, JOINT_NAMES.index(n)] for n in ("l_wrist", "r_wrist")]
    legs, arms = (left - right)[:, 2], (hands[0] - hands[1])[:, 2]
    assert legs.abs().max() > 0.3 and float((legs * arms).mean()) < 0  # each arm goes with the other leg
