"""Motion files: what is read comes back as it was meant; what is wrong is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.files.motions import read_clip
from recon.types import UserError

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -40 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 95 0 0 0 0 0 0 0
1 96 2 10 20 30 0 45 0
"""


def write(tmp_path: Path, **arrays) -> Path:
    path = tmp_path / "clip.npz"
    np.savez(path, **arrays)
    return path


def test_bvh_has_names_angles_and_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    path.write_text(BVH)
    clip = read_clip(path)
    assert clip.names == ["Hips", "LeftUpLeg", "LeftUpLeg_end"] and clip.parents.tolist() == [-1, 0, 1]
    assert clip.fps == pytest.approx(30, rel=1e-4)
    np.testing.assert_allclose(clip.root, [[0, 0.95, 0], [0.01, 0.96, 0.02]])
    np.testing.assert_allclose(clip.offsets[1:], [[0.1, -0.05, 0], [0, -0.4, 0]])
    wanted = Rotation.from_euler("ZXY", [10, 20, 30], degrees=True).as_matrix()
    np.testing.assert_allclose(clip.local[1, 0], wanted, atol=1e-12)
    thigh = wanted @ Rotation.from_euler("x", 45, degrees=True).as_matrix()
    np.testing.assert_allclose(clip.world[1, 1], thigh, atol=1e-12)


def test_amass_is_turned_upright(tmp_path: Path) -> None:
    """z up becomes y up: a person who stands in AMASS' axes (turned by 90 degrees about x) stands."""
    poses = np.zeros((3, 156))
    poses[:, 0] = np.pi / 2
    path = write(tmp_path, poses=poses, trans=np.array([[1.0, 2.0, 3.0]] * 3), mocap_framerate=np.array(120.0))
    clip = read_clip(path)
    assert clip.fps == 120 and clip.local.shape == (3, 24, 3, 3)
    np.testing.assert_allclose(clip.local[0, 0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(clip.root[0], [1, 3, -2], atol=1e-12)


def test_the_rigs_own_numbers(tmp_path: Path) -> None:
    pose = np.random.default_rng(0).normal(size=(4, 24, 3)) * 0.3
    clip = read_clip(write(tmp_path, pose=pose, translation=np.zeros((4, 3)), fps=25))
    np.testing.assert_allclose(Rotation.from_matrix(clip.local[2]).as_rotvec(), pose[2], atol=1e-12)
    assert clip.names == [] and clip.fps == 25


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"poses": np.zeros((3, 20)), "trans": np.zeros((3, 3))}, "66"),
        ({"pose": np.zeros((3, 22, 3)), "translation": np.zeros((3, 3))}, "24"),
        ({"x": np.zeros(3)}, "wanted names"),
        ({"pose": np.zeros((0, 24, 3)), "translation": np.zeros((0, 3))}, "no frames"),
        ({"pose": np.zeros((2, 24, 3)), "translation": np.zeros((2, 3)), "fps": 0.0}, "frames a second"),
    ],
)
def test_wrong_arrays_are_one_line(tmp_path: Path, arrays: dict, says: str) -> None:
    with pytest.raises(UserError, match=says) as error:
        read_clip(write(tmp_path, **arrays))
    assert "\n" not in str(error.value) and "clip.npz" in str(error.value)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.bvh", BVH.replace("1 96 2 10", "1 96"), "numbers"),
        ("a.bvh", BVH.replace("Frames: 2", "Frames two"), "Frames"),
        ("a.bvh", "HIERARCHY", "cannot be read"),
        ("a.txt", "walk", "wanted a motion"),
        ("a.npz", "not a zip", "cannot be read"),
    ],
)
def test_broken_files_are_one_line(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=says) as error:
        read_clip(tmp_path / name)
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="no such file"):
        read_clip(tmp_path / "missing.npz")
