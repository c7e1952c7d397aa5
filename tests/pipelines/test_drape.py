"""``recon drape``: what it writes, what it says, and how mistakes end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from pipelines.cli import main
from pipelines.drape import Drape, drape
from pipelines.pose_source import load_pose
from recon.bodies import load_body
from recon.files.meshes import read_mesh, write_obj
from recon.types import Mesh, UserError


@pytest.fixture(scope="module")
def body():
    return load_body()


def config(out: Path, **changes) -> Drape:
    plain = Drape(("skirt:3",), out=out, resolution=32, draper="skinning", layering=False, untangle=False)
    return replace(plain, **changes)


def test_it_writes_body_garments_scene_and_figures(tmp_path: Path) -> None:
    out = tmp_path / "worn"
    done = drape(config(out, garments=("skirt:3", "top:5"), shape=(0.5, -0.5)), say=lambda line: None)
    assert {p.name for p in out.iterdir()} == {"body.obj", "skirt-3.obj", "top-5.obj", "scene.glb", "result.json"}
    figures = json.loads((out / "result.json").read_text())
    assert list(figures["garments"]) == ["skirt-3", "top-5"] and figures["garments"]["top-5"]["draper"] == "skinning"
    assert set(figures["garments"]["top-5"]["beneath_pct"]) == {"skirt-3"}
    assert float(done.body.vertices[:, 1].min()) == pytest.approx(0.0, abs=1e-5)
    torch.testing.assert_close(read_mesh(out / "body.obj").vertices, done.body.vertices, atol=1e-5, rtol=0)
    drape(config(out), say=lambda line: None)  # its own folder may be written again


def test_any_mesh_is_draped_and_untangled(tmp_path: Path, body) -> None:
    x, faces = body.rest(body.neutral().shape).vertices[0], body.faces
    corners = x[faces]
    belt = ((corners[..., 1] > 0.85) & (corners[..., 1] < 1.1) & (corners[..., 0].abs() < 0.2)).all(1)
    used, faces = faces[belt].unique(return_inverse=True)
    out = torch.nn.functional.normalize(x[used] * torch.tensor([1.0, 0.0, 1.0]), dim=1)
    write_obj(Mesh(1e3 * (x[used] + 0.02 * out), faces), tmp_path / "belt.obj")  # in millimetres
    settings = config(tmp_path / "o", garments=(str(tmp_path / "belt.obj"),), untangle=True, draper="")
    done = drape(settings, say=lambda line: None)
    found = done.figures["garments"]["belt"]
    assert found["draper"] == "skinning" and found["vertices_inside_body"] == 0
    assert done.figures["untangle"]["clean"] and any("read as mm" in note for note in done.figures["notes"])


def test_poses_by_name_file_and_frame(tmp_path: Path, body) -> None:
    poses = np.zeros((3, 24, 3))
    poses[2, 16, 2] = -0.7
    np.savez(tmp_path / "m.npz", pose=poses, translation=np.zeros((3, 3)), fps=30)
    assert not load_pose("t", body)[0].any() and load_pose("a", body)[1] is None
    last, place = load_pose(f"{tmp_path / 'm.npz'}:2", body)
    assert float(last[0, 16, 2]) == pytest.approx(-0.7, abs=1e-4) and place is not None and place.shape == (1, 3)
    assert not load_pose(str(tmp_path / "m.npz"), body)[0].any()
    assert torch.equal(load_pose("random:4", body)[0], load_pose("random:4", body)[0])


@pytest.mark.parametrize("pose", ["yoga", "random:", "nothing.npz", "nothing.npz:3"])
def test_wrong_poses_are_told(pose: str, body) -> None:
    with pytest.raises(UserError, match="pose|no such file"):
        load_pose(pose, body)


def test_the_same_garment_may_be_worn_twice(tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "o"), "--resolution", "24", "--draper", "skinning", "--no-untangle", "--no-layering"]
    assert main(["drape", "skirt:3,skirt:3", *out]) == 0
    figures = json.loads((tmp_path / "o" / "result.json").read_text())["garments"]
    assert list(figures) == ["skirt-3", "skirt-3_2"] and "skirt-3" in figures["skirt-3_2"]["beneath_pct"]


def test_mistakes_end_with_one_line(tmp_path: Path, capsys) -> None:
    (tmp_path / "note.txt").write_text("mine")
    cases = [
        (["skirt:3", "--out", str(tmp_path)], "holds what is no drape's"),
        (["skirt:9999"], "found '9999'"),
        (["skirt:3", "--draper", "magic"], "--draper: found 'magic'"),
        (["skirt:3", "--resolution", "4"], "--resolution"),
        (["skirt:3", "--pose", "yoga"], "--pose"),
        (["skirt:3", "--shape", *["0.1"] * 99], "99 coefficients"),
        (["skirt:3", "--shape", "nan"], "NaN"),
        ([str(tmp_path / "gone.obj")], "no such file"),
        ([str(tmp_path / "nan.obj")], "NaN"),
        ([str(tmp_path / "empty.obj")], "without a triangle"),
        ([str(tmp_path / "ball.obj")], "watertight"),
        ([str(tmp_path / "away.obj")], "from the neutral body"),
    ]
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    ball = trimesh.creation.icosphere(1, 0.3)
    ball.export(tmp_path / "ball.obj")
    trimesh.Trimesh(ball.vertices + [0, -1.5, 0], ball.faces[10:]).export(tmp_path / "away.obj")
    for args, says in cases:
        where = [] if "--out" in args else ["--out", str(tmp_path / "new")]
        assert main(["drape", *args, *where, "--no-layering"]) == 2
        told = capsys.readouterr().err
        assert says in told and len([line for line in told.splitlines() if line.startswith("recon:")]) == 1
    assert (tmp_path / "note.txt").read_text() == "mine" and not (tmp_path / "new").exists()
