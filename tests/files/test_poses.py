"""A user's pose file."""

import json

import numpy as np
import pytest
import torch

from recon.files.poses import read_pose
from recon.types import UserError


def test_npz_and_the_result_of_a_fit(tmp_path):
    pose = np.random.default_rng(0).normal(size=(24, 3)).astype(np.float32)
    np.savez(tmp_path / "pose.npz", pose=pose.ravel(), translation=[0, 1, 2])
    found, shape, place = read_pose(tmp_path / "pose.npz")
    assert torch.equal(found, torch.from_numpy(pose)) and shape is None
    assert place is not None and place.tolist() == [0, 1, 2]
    (tmp_path / "result.json").write_text(json.dumps({"body_model": {"pose": pose.tolist(), "shape": [1.0, 2.0]}}))
    found, shape, place = read_pose(tmp_path / "result.json")
    assert torch.allclose(found, torch.from_numpy(pose)) and place is None
    assert shape is not None and shape.tolist() == [1, 2]


def test_mistakes(tmp_path):
    np.savez(tmp_path / "few.npz", pose=np.zeros(7))
    np.savez(tmp_path / "nan.npz", pose=np.full((24, 3), np.nan))
    np.savez(tmp_path / "other.npz", poses=np.zeros((24, 3)))
    (tmp_path / "broken.json").write_text("{")
    for name in ("none.npz", "few.npz", "nan.npz", "other.npz", "broken.json"):
        with pytest.raises(UserError, match=name):
            read_pose(tmp_path / name)
