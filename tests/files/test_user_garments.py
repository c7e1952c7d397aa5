"""Meshes that users bring: each flaw is repaired and told, or refused in one line."""

import numpy as np
import pytest
import torch
import trimesh

from recon.files.meshes import write_obj
from recon.files.user_garments import read_garment_mesh
from recon.types import Mesh, UserError
from tests.garments.synthetic import tube


def written(path, vertices, faces):
    write_obj(
        Mesh(torch.as_tensor(np.asarray(vertices), dtype=torch.float32), torch.as_tensor(np.asarray(faces))), path
    )
    return path


@pytest.fixture
def garment():
    mesh = tube(cells=12).mesh
    return mesh.vertices.double().numpy(), mesh.faces.numpy()


@pytest.mark.parametrize(("factor", "unit"), [(1, "m"), (100, "cm"), (1000, "mm")])
def test_units_are_guessed_by_size_and_told(tmp_path, garment, factor, unit):
    mesh, notes = read_garment_mesh(written(tmp_path / "a.obj", garment[0] * factor, garment[1]))
    assert abs(float(mesh.vertices[:, 1].max() - mesh.vertices[:, 1].min()) - 0.5) < 1e-3
    assert any(unit in note for note in notes) == (unit != "m")


def test_a_given_unit_must_make_a_garment(tmp_path, garment):
    path = written(tmp_path / "a.obj", garment[0] * 1000, garment[1])
    assert not read_garment_mesh(path, "mm")[1]
    with pytest.raises(UserError, match="as m; wanted"):
        read_garment_mesh(path, "m")
    with pytest.raises(UserError, match="units long"):
        read_garment_mesh(written(tmp_path / "b.obj", garment[0] * 20, garment[1]))


def test_split_vertices_are_welded_and_double_triangles_dropped(tmp_path, garment):
    vertices, faces = garment
    soup, own = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    mesh, notes = read_garment_mesh(written(tmp_path / "a.obj", soup, np.concatenate([own, own[:5]])))
    assert len(mesh.vertices) == len(vertices) and len(mesh.faces) == len(faces)
    assert any("welded" in n for n in notes) and any("5 triangles" in n for n in notes)


def test_buttons_are_dropped_and_larger_pieces_kept(tmp_path, garment):
    vertices, faces = garment
    button = trimesh.creation.icosphere(1, 0.008)
    strip = vertices * [0.5, 0.5, 0.5] + [1.0, 0, 0]
    both = np.concatenate([vertices, button.vertices, strip])
    all_faces = np.concatenate([faces, button.faces + len(vertices), faces + len(vertices) + len(button.vertices)])
    mesh, notes = read_garment_mesh(written(tmp_path / "a.obj", both, all_faces))
    assert len(mesh.faces) == 2 * len(faces)
    assert any("1 small loose" in n for n in notes) and any("2 separate" in n for n in notes)


def test_a_body_is_taken_out_and_alone_refused(tmp_path, garment):
    body = trimesh.creation.capsule(1.4, 0.15)
    vertices = np.concatenate([garment[0], body.vertices])
    faces = np.concatenate([garment[1], body.faces + len(garment[0])])
    mesh, notes = read_garment_mesh(written(tmp_path / "a.obj", vertices, faces))
    assert len(mesh.faces) == len(garment[1]) and any("body" in n for n in notes)
    with pytest.raises(UserError, match="a body"):
        read_garment_mesh(written(tmp_path / "b.obj", body.vertices, body.faces))


def test_watertight_garments_are_refused(tmp_path):
    ball = trimesh.creation.icosphere(3, 0.3)
    with pytest.raises(UserError, match="watertight"):
        read_garment_mesh(written(tmp_path / "a.obj", ball.vertices, ball.faces))


def test_a_separate_lining_is_dropped(tmp_path, garment):
    vertices, faces = garment
    inner = vertices * [0.985, 1, 0.985]
    path = written(
        tmp_path / "a.obj", np.concatenate([vertices, inner]), np.concatenate([faces, faces + len(vertices)])
    )
    mesh, notes = read_garment_mesh(path)
    assert len(mesh.faces) == len(faces) and any("layer" in n for n in notes)


def test_a_joined_shell_is_refused(tmp_path, garment):
    vertices, faces = garment
    half = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    rim = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    key, count = np.unique(np.sort(rim, 1), axis=0, return_counts=True)
    single = {tuple(k) for k in key[count == 1].tolist()}
    edges = np.array([e for e in rim.tolist() if tuple(sorted(e)) in single])
    a, b = edges.T
    n = len(vertices)
    walls = np.concatenate([np.stack([b, a, a + n], 1), np.stack([b, a + n, b + n], 1)])[:-4]  # one slit left open
    path = written(
        tmp_path / "a.obj", np.concatenate([vertices, vertices * [0.985, 1, 0.985]]), np.concatenate([half, walls])
    )
    with pytest.raises(UserError, match="two layers"):
        read_garment_mesh(path)


def test_edges_with_three_faces_are_told(tmp_path, garment):
    vertices, faces = garment
    fin = np.array([[faces[0, 0], faces[0, 2], len(vertices)]])  # faces 0 and 1 share that edge
    mesh, notes = read_garment_mesh(
        written(
            tmp_path / "a.obj",
            np.concatenate([vertices, vertices[faces[0]].mean(0)[None] * 1.05]),
            np.concatenate([faces, fin]),
        )
    )
    assert len(mesh.faces) == len(faces) + 1 and any("three or more" in n for n in notes)


def test_nan_and_emptiness_are_refused(tmp_path):
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    for name, what in (("nan.obj", "NaN"), ("empty.obj", "without a triangle"), ("gone.obj", "no such file")):
        with pytest.raises(UserError, match=what) as error:
            read_garment_mesh(tmp_path / name)
        assert "\n" not in str(error.value)
