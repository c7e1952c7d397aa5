"""The skeleton of one frame against its batched twins."""

from __future__ import annotations

import torch

from recon.bodies import load_body
from recon.bodies.rig import joint_transforms, rotation_matrices
from recon.draping.frame import FrameRig
from recon.draping.gaps import SPEED, motion_features


def test_frame_after_frame_is_the_batched_rig() -> None:
    body = load_body()
    g = torch.Generator().manual_seed(0)
    pose, place = 0.6 * torch.randn(1, 4, 24, 3, generator=g), torch.randn(1, 4, 3, generator=g)
    pose[0, 0, 3:7] = 0  # joints that do not turn have a series of their own
    joints = body.rest_joints(torch.randn(1, body.n_shape, generator=g))
    rig = FrameRig(joints[0], body.parents, SPEED)
    wanted = motion_features(pose, place, 30.0)[0]
    for k in range(4):
        features = rig(pose[0, k], place[0, k], 30.0)
        torch.testing.assert_close(features, wanted[k], atol=1e-5, rtol=1e-4)
        transforms = joint_transforms(rotation_matrices(pose[:, k]), joints, place[:, k])[0]
        torch.testing.assert_close(rig.transforms, transforms, atol=1e-5, rtol=1e-4)


def test_another_body_goes_on_from_the_last_frame() -> None:
    body = load_body()
    g = torch.Generator().manual_seed(1)
    pose, place = 0.3 * torch.randn(2, 24, 3, generator=g), torch.randn(2, 3, generator=g)
    first, second = body.rest_joints(torch.randn(2, body.n_shape, generator=g))
    rig = FrameRig(first, body.parents, SPEED)
    rig(pose[0], place[0], 30.0)
    features = FrameRig(second, body.parents, SPEED, rig)(pose[1], place[1], 30.0)
    torch.testing.assert_close(features, motion_features(pose[None], place[None], 30.0)[0, 1], atol=1e-5, rtol=1e-4)
