"""SMPL, SMPL-H and SMPL-X files: read safely, posed as their formulas say, refused in one line when wrong."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from made_smpl import made_model, slow_twin, write_npz, write_pickle

from recon.bodies import load_body
from recon.bodies.smpl import FAMILIES
from recon.files.pickles import read_pickle
from recon.types import BodyPose, UserError

KINDS = list(FAMILIES)


@pytest.fixture(scope="module")
def models():
    return {name: made_model(name) for name in KINDS}


@pytest.fixture(scope="module")
def files(models, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {name: write_npz(folder / f"{name}.npz", model) for name, model in models.items()}


def some_pose(batch: int, seed: int, n_shape: int) -> BodyPose:
    g = torch.Generator().manual_seed(seed)
    pose = 0.5 * torch.randn(batch, 24, 3, generator=g)
    return BodyPose(torch.randn(batch, n_shape, generator=g), pose, torch.randn(batch, 3, generator=g))


@pytest.mark.parametrize("name", KINDS)
def test_agrees_with_the_slow_twin(name, models, files):
    body = load_body(name, files[name])
    given = some_pose(2, 3, body.n_shape)
    if name != "smpl":
        given.pose[:, 22:] = 0  # fingers at rest
    posed = body.pose(given)
    for b in range(2):
        used = given.pose[b] if name == "smpl" else given.pose[b, :22]
        vertices, joints = slow_twin(models[name], given.shape[b].double().numpy(), used.double().numpy())
        move = given.translation[b].numpy() + [0, body.card["lift"], 0]
        np.testing.assert_allclose(posed.mesh.vertices[b].numpy(), vertices + move, atol=2e-5)
        np.testing.assert_allclose(posed.joints[b, :22].numpy(), joints[:22] + move, atol=1e-5)


@pytest.mark.parametrize("name", KINDS)
def test_shapes_and_seam(name, files):
    body = load_body(name, files[name])
    v = FAMILIES[name].vertices
    assert body.n_shape == 10 and body.weights.shape == (v, 24) and body.shape_dirs.shape == (v, 3, 10)
    assert torch.allclose(body.weights.sum(1), torch.ones(v), atol=1e-5)
    posed = body.pose(body.neutral(3))
    assert posed.mesh.vertices.shape == (3, v, 3) and posed.transforms.shape == (3, 24, 4, 4)
    assert body.landmarks(posed).shape == (3, 33, 3)
    assert posed.mesh.vertices[..., 1].min().abs() < 1e-5
    assert body.regions.max() < len(body.region_names)


def test_hand_joint_carries_the_fingers(files):
    body = load_body("smplx", files["smplx"])
    given = body.neutral()
    given.pose[:, 22, 2] = 0.5
    moved = (body.pose(given).mesh.vertices - body.rest(given.shape).vertices)[0].norm(dim=1) > 1e-5
    assert moved.any() and bool((body.weights[moved, 22] > 0).all())


def test_pickle_with_sparse_and_chumpy_reads_the_same(models, files, tmp_path):
    path = write_pickle(tmp_path / "basicModel_neutral.pkl", models["smpl"])
    one, two = load_body("smpl", path), load_body("smpl", files["smpl"])
    for key in ("template", "shape_dirs", "joints", "joint_dirs", "weights", "pose_dirs"):
        assert torch.equal(getattr(one, key), getattr(two, key)), key


class Runs:
    def __reduce__(self):
        import os

        return os.system, ("touch owned",)


@pytest.mark.parametrize(
    "payload",
    [
        pickle.dumps({"v_template": Runs()}),
        b"cos\nsystem\n(S'true'\ntR.",
        b"\x80\x02cbuiltins\neval\nX\x01\x00\x00\x001\x85R.",
        b"\x80\x02cnumpy.core.multiarray\nfromfile\nX\x01\x00\x00\x001\x85R.",
        b"not a pickle",
        b"",
        pickle.dumps({"a": np.zeros(100)})[:-40],
    ],
)
def test_refuses_pickles_that_are_more_than_arrays(payload, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "model.pkl"
    path.write_bytes(payload)
    with pytest.raises(UserError) as caught:
        read_pickle(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "owned").exists()


def test_wrong_files_are_told_in_one_line(models, files, tmp_path):
    broken = dict(models["smpl"])
    broken["weights"] = broken["weights"] * np.nan
    cut = {k: v for k, v in models["smpl"].items() if k != "posedirs"}
    turned = dict(models["smpl"], kintree_table=models["smpl"]["kintree_table"][:, ::-1])
    text = tmp_path / "notes.npz"
    text.write_text("hello")
    half = tmp_path / "half.npz"
    half.write_bytes(files["smpl"].read_bytes()[:5000])
    cases = {
        "SMPL-X with 10475 vertices": ("smpl", files["smplx"]),
        "SMPL with 6890 vertices and 24 joints": ("smplh", files["smpl"]),
        "NaN": ("smpl", write_npz(tmp_path / "nan.npz", broken)),
        "posedirs": ("smpl", write_npz(tmp_path / "cut.npz", cut)),
        "order of joints": ("smpl", write_npz(tmp_path / "turned.npz", turned)),
        "no readable npz": ("smpl", text),
        "readable": ("smplx", half),
        "no readable file": ("smpl", tmp_path / "absent.pkl"),
        "no file": ("smpl", None),
    }
    for found, (name, path) in cases.items():
        with pytest.raises(UserError) as caught:
            load_body(name, path)
        message = str(caught.value)
        assert found in message and "wanted" in message and "\n" not in message, message
    with pytest.raises(UserError, match="anny, smpl"):
        load_body("star")
