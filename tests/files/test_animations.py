"""Animations on disk: what is written can be read back, by us and by others."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from recon.files.animations import Moving, read_pc2, write_animated_glb, write_film, write_obj_sequence, write_pc2
from recon.files.meshes import read_mesh
from recon.types import Mesh, UserError

SQUARE = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def moving(frames: int = 4) -> Moving:
    lift = torch.arange(frames)[:, None, None] * torch.tensor([0.0, 0.1, 0.02])
    return Moving(SQUARE, SQUARE.vertices + lift, (0.2, 0.4, 0.6))


def tables(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, total = struct.unpack("<4sII", data[:12])
    assert magic == b"glTF" and version == 2 and total == len(data)
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_glb_plays_every_frame(tmp_path: Path) -> None:
    path, part = tmp_path / "a.glb", moving()
    write_animated_glb({"skirt": part, "body": part}, path, 25.0)
    tree, binary = tables(path)

    def array(index: int) -> np.ndarray:
        entry = tree["accessors"][index]
        view = tree["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3}[entry["type"]]
        flat = np.frombuffer(binary, "<f4", entry["count"] * width, view["byteOffset"])
        return flat.reshape(entry["count"], width)

    assert [n["name"] for n in tree["nodes"]] == ["skirt", "body"]
    animation = tree["animations"][0]
    assert len(animation["channels"]) == 2
    sampler = animation["samplers"][0]
    np.testing.assert_allclose(array(sampler["input"])[:, 0], np.arange(4) / 25)
    weights = array(sampler["output"]).reshape(4, 3)
    primitive = tree["meshes"][0]["primitives"][0]
    base = array(primitive["attributes"]["POSITION"])
    targets = [array(t["POSITION"]) for t in primitive["targets"]]
    for k in range(4):
        shown = base + sum(w * t for w, t in zip(weights[k], targets, strict=True))
        np.testing.assert_allclose(shown, part.frames[k].numpy(), atol=1e-6)
    assert all(v["byteOffset"] % 4 == 0 for v in tree["bufferViews"])
    assert trimesh.load(path).geometry["skirt"].vertices.shape == (4, 3)  # another reader sees the first frame


def test_one_frame_is_a_still(tmp_path: Path) -> None:
    write_animated_glb({"a": moving(1)}, tmp_path / "a.glb", 30)
    tree, _ = tables(tmp_path / "a.glb")
    assert "animations" not in tree and "targets" not in tree["meshes"][0]["primitives"][0]


def test_point_caches_and_objs_agree(tmp_path: Path) -> None:
    part = moving()
    write_pc2(part, tmp_path / "a.pc2", 30)
    torch.testing.assert_close(read_pc2(tmp_path / "a.pc2"), part.frames)
    write_obj_sequence({"a": part}, tmp_path)
    for k in range(4):
        mesh = read_mesh(tmp_path / "a" / f"a_{k:04d}.obj")
        torch.testing.assert_close(mesh.vertices, part.frames[k])
        assert torch.equal(mesh.faces, SQUARE.faces)
    (tmp_path / "a.pc2").write_bytes((tmp_path / "a.pc2").read_bytes()[:-4])
    with pytest.raises(UserError, match="4 frames of 4 points"):
        read_pc2(tmp_path / "a.pc2")
    (tmp_path / "b.pc2").write_bytes(b"x")
    with pytest.raises(UserError, match="POINTCACHE2"):
        read_pc2(tmp_path / "b.pc2")


def test_films_have_all_pictures(tmp_path: Path) -> None:
    import cv2
    from PIL import Image

    pictures = [torch.full((48, 64, 3), 40 * k, dtype=torch.uint8) for k in range(5)]
    write_film(pictures, tmp_path / "a.gif", 10)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 5 and gif.size == (64, 48)
    write_film(pictures, tmp_path / "a.mp4", 10)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gif", "a.mp4"]


def test_nothing_senseless_is_written(tmp_path: Path) -> None:
    part = moving()
    part.frames[2, 1, 0] = float("nan")
    with pytest.raises(ValueError, match="NaN"):
        write_animated_glb({"a": part}, tmp_path / "a.glb", 30)
    with pytest.raises(ValueError, match="frames"):
        write_animated_glb({"a": moving(3), "b": moving(4)}, tmp_path / "a.glb", 30)
    assert not list(tmp_path.iterdir())
