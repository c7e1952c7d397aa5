"""Mesh files: welded, named, in metres; readable by others; bad ones named in one line."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from recon.files.meshes import read_garment, read_mesh, write_glb, write_obj
from recon.types import Garment, Mesh, UserError


@pytest.fixture
def ball() -> Mesh:
    ball = trimesh.creation.icosphere(2, 0.3)
    return Mesh(torch.tensor(ball.vertices).float(), torch.tensor(ball.faces))


def test_a_garment_keeps_its_weld_and_carries_its_pattern(tmp_path, flat_shirt):
    shirt = flat_shirt()
    write_obj(shirt, tmp_path / "top.obj")
    back = read_mesh(tmp_path / "top.obj")
    assert torch.equal(back.faces, shirt.mesh.faces)
    assert torch.allclose(back.vertices, shirt.mesh.vertices, atol=1e-6)
    lines = (tmp_path / "top.obj").read_text().splitlines()
    assert "o top" in lines
    points = torch.tensor([[float(x) for x in line.split()[1:]] for line in lines if line.startswith("vt ")])
    assert torch.allclose(points, shirt.panel_points, atol=1e-6)
    corners = [[c.split("/") for c in line.split()[1:]] for line in lines if line.startswith("f ")]
    assert torch.equal(torch.tensor([[int(c[1]) - 1 for c in face] for face in corners]), shirt.panel_faces)


def test_a_garment_comes_back_with_its_panels(tmp_path, flat_shirt, ball):
    shirt = flat_shirt()
    write_obj(shirt, tmp_path / "top.obj")
    back = read_garment(tmp_path / "top.obj")
    assert isinstance(back, Garment) and back.kind == "top" and back.seam_names == ("open", "seam")
    torch.testing.assert_close(back.panel_points, shirt.panel_points, atol=1e-6, rtol=0)
    for name in ("panel_faces", "panel_of_face", "vertex_of_point"):
        assert torch.equal(getattr(back, name), getattr(shirt, name)), name
    inside = shirt.border_labels < 0
    assert torch.equal(back.border_labels < 0, inside)
    assert torch.equal(back.border_labels[~inside] == 0, shirt.border_labels[~inside] == 0)
    write_obj(ball, tmp_path / "ball.obj")
    assert isinstance(read_garment(tmp_path / "ball.obj"), Mesh)
    text = (tmp_path / "top.obj").read_text()
    (tmp_path / "cut.obj").write_text("\n".join(line for line in text.splitlines() if not line.startswith("vt ")))
    with pytest.raises(UserError, match="panel coordinates"):
        read_garment(tmp_path / "cut.obj")


def test_others_read_our_obj(tmp_path, ball, flat_shirt):
    write_obj(ball, tmp_path / "body.obj")
    theirs = trimesh.load(tmp_path / "body.obj", process=False)
    assert theirs.is_watertight and theirs.volume > 0
    shirt = flat_shirt()
    write_obj(shirt, tmp_path / "top.obj", "Top")
    theirs = trimesh.load(tmp_path / "top.obj", process=False)
    assert len(theirs.faces) == len(shirt.mesh.faces)
    assert np.allclose(np.ptp(theirs.visual.uv, axis=0), [0.6, 0.7], atol=1e-5)


def test_a_scene_names_and_colours_its_parts(tmp_path, ball, flat_shirt):
    write_glb({"body": (ball, (0.8, 0.7, 0.6)), "top": (flat_shirt(), (0.2, 0.4, 0.8))}, tmp_path / "scene.glb")
    data = (tmp_path / "scene.glb").read_bytes()
    assert data[:4] == b"glTF" and struct.unpack("<I", data[8:12])[0] == len(data)
    head = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    nodes = {node["name"]: head["meshes"][node["mesh"]] for node in head["nodes"] if "mesh" in node}
    assert set(nodes) == {"body", "top"}
    materials = {name: head["materials"][mesh["primitives"][0]["material"]] for name, mesh in nodes.items()}
    assert materials["top"]["doubleSided"] and not materials["body"].get("doubleSided", False)
    linear = np.array(materials["top"]["pbrMetallicRoughness"]["baseColorFactor"])
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.allclose(srgb, [0.2, 0.4, 0.8, 1.0], atol=0.02)
    scene = trimesh.load_scene(tmp_path / "scene.glb")
    assert len(scene.geometry["top"].vertices) == len(flat_shirt().mesh.vertices)
    assert np.isfinite(scene.geometry["top"].vertex_normals).all()


def test_a_vertex_without_area_gets_a_unit_normal(tmp_path):
    flat = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]]), torch.tensor([[0, 1, 2], [0, 0, 1]]))
    write_glb({"flat": (flat, (1, 1, 1))}, tmp_path / "flat.glb")
    data = (tmp_path / "flat.glb").read_bytes()
    head = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    normal = head["accessors"][head["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
    assert normal["count"] == 4 and np.isfinite(normal["min"]).all()
    assert np.linalg.norm(normal["max"]) > 0.99


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_no_number_is_never_written(tmp_path, flat_shirt, value):
    shirt = flat_shirt(0.1)
    vertices = shirt.mesh.vertices.clone()
    vertices[3, 1] = value
    broken = replace(shirt, mesh=shirt.mesh.with_vertices(vertices))
    with pytest.raises(ValueError, match=r"top: 1 of \d+ vertices are NaN or infinite"):
        write_obj(broken, tmp_path / "top.obj")
    with pytest.raises(ValueError, match="top: 1 of"):
        write_glb({"top": (broken, (1, 1, 1))}, tmp_path / "scene.glb")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["ply", "stl", "off", "glb"])
def test_others_files_are_read(tmp_path, ball, kind):
    trimesh.Trimesh(ball.vertices.numpy(), ball.faces.numpy(), process=False).export(tmp_path / f"ball.{kind}")
    back = read_mesh(tmp_path / f"ball.{kind}")
    assert back.vertices.shape == ball.vertices.shape and len(back.faces) == len(ball.faces)
    assert back.vertices.dtype == torch.float32 and back.faces.dtype == torch.long


def test_obj_with_polygons_negative_indices_and_other_words(tmp_path):
    text = (
        "mtllib x.mtl\nv 0 0 0 1 1 1\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\ns off\nf 1//1 2//1 3//1 4//1\nf -4 -2 -1\n"
    )
    (tmp_path / "quad.obj").write_text(text)
    mesh = read_mesh(tmp_path / "quad.obj")
    assert mesh.vertices.shape == (4, 3) and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 3]]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("gone.obj", None, "no such file"),
        ("body.txt", b"hello", "a .txt file"),
        ("broken.ply", b"ply\nhello", "cannot be read as ply"),
        ("broken.obj", b"v 0 zero 0\n", "cannot be read as obj"),
        ("empty.obj", b"", "0 vertices without a triangle"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\n", "3 vertices without a triangle"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", "NaN or infinite"),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", "missing vertices"),
    ],
)
def test_bad_files_are_named_in_one_line(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as error:
        read_mesh(tmp_path / name)
    line = str(error.value)
    assert line.startswith(str(tmp_path / name)) and says in line and "wanted" in line and "\n" not in line
