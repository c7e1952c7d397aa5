"""The pose prior: knows standing from impossible, pulls back softly, samples within limits."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from recon.bodies.pose_prior import joint_limits, limit_energy, mean_pose, pose_prior, sample_poses
from recon.bodies.poses import a_pose, t_pose
from recon.bodies.rig import JOINT_NAMES

SHARED = Path(os.environ.get("GARMENT_RECON_SHARED", Path(__file__).parents[3] / "shared"))


def turned(joint: str, *angles: float) -> torch.Tensor:
    pose = a_pose(1, 70)
    pose[0, JOINT_NAMES.index(joint)] = torch.tensor(angles)
    return pose


def test_ordinary_poses_are_likely_and_impossible_ones_are_not():
    ordinary = pose_prior(torch.cat([mean_pose(), a_pose(1, 70), a_pose(1, 45), t_pose(1)]))
    assert (ordinary < 1).all() and ordinary[0] < 1e-6
    for impossible in (turned("l_knee", -1.2, 0, 0), turned("r_elbow", 0, -1.2, 0), turned("head", 0, 2.2, 0)):
        assert pose_prior(impossible)[0] > 3 * ordinary[1]
    for possible in (turned("l_knee", 1.2, 0, 0), turned("r_elbow", 0, 1.2, 0), turned("l_elbow", 0, -1.2, 0)):
        assert limit_energy(possible)[0] == 0


def test_limits_are_boxes_that_hold_rest_and_mirror():
    limits = joint_limits()
    assert limits.shape == (24, 3, 2) and (limits[..., 0] < limits[..., 1]).all()
    assert (limits[..., 0] <= 0).all() and (limits[..., 1] >= 0).all()
    left, right = limits[JOINT_NAMES.index("l_shoulder")], limits[JOINT_NAMES.index("r_shoulder")]
    assert torch.equal(right[0], left[0]) and torch.equal(right[1:], -left[1:].flip(-1))
    limits[:] = 0
    assert joint_limits().abs().max() > 0, "callers get their own copy"


def test_prior_does_not_mind_left_and_right_or_the_pelvis():
    pose = sample_poses(4, torch.Generator().manual_seed(0))
    swap = [JOINT_NAMES.index({"l_": "r_", "r_": "l_"}.get(n[:2], n[:2]) + n[2:]) for n in JOINT_NAMES]
    mirrored = pose[:, swap] * torch.tensor([1.0, -1, -1])
    assert torch.allclose(pose_prior(pose), pose_prior(mirrored), rtol=1e-3)
    turned_round = pose.clone()
    turned_round[:, 0] = torch.tensor([0.0, 3.0, 0.0])
    assert torch.equal(pose_prior(pose), pose_prior(turned_round))


def test_gradient_against_finite_differences():
    pose = (2 * sample_poses(2, torch.Generator().manual_seed(1)).double()).requires_grad_()
    assert (limit_energy(pose) > 0).all()
    assert torch.autograd.gradcheck(pose_prior, (pose,))
    zero = torch.zeros(1, 24, 3, requires_grad=True)
    (grad,) = torch.autograd.grad(pose_prior(zero).sum(), zero)
    assert torch.isfinite(grad).all()


def test_descending_the_prior_ends_within_limits():
    pose = turned("l_knee", -1.0, 0.8, 0).requires_grad_()
    for _ in range(300):
        (grad,) = torch.autograd.grad(pose_prior(pose).sum(), pose)
        pose = (pose - 0.004 * grad).detach().requires_grad_()
    assert limit_energy(pose)[0] < 1e-2


def test_samples_are_seeded_varied_and_within_limits():
    one, two = (sample_poses(50, torch.Generator().manual_seed(7)) for _ in range(2))
    limits = joint_limits()
    assert torch.equal(one, two) and one.shape == (50, 24, 3)
    assert ((one >= limits[..., 0]) & (one <= limits[..., 1])).all()
    assert one.std(0)[JOINT_NAMES.index("l_shoulder")].max() > 0.2
    assert pose_prior(one).mean() < 1.2
    with pytest.raises(ValueError, match="wanted"):
        pose_prior(torch.zeros(1, 72))


@pytest.mark.skipif(not (SHARED / "motions").is_dir(), reason=f"no motion clips in {SHARED}")
def test_clips_lie_within_the_limits():
    from pipelines.export_pose_prior import gather
    from recon.bodies import load_body

    poses = torch.cat([torch.as_tensor(c) for c in gather(SHARED / "motions", load_body().joints.double().numpy())])
    poses[:, [10, 11, 22, 23]] = 0  # toes and fingers: noise in the clips
    limits = joint_limits().double()
    inside = ((poses >= limits[..., 0]) & (poses <= limits[..., 1])).double().mean(0)
    assert inside.min() > 0.97 and inside.mean() > 0.995
