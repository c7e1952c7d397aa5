"""Meshes with a value and a colour per vertex."""

import numpy as np
import pytest
import torch
import trimesh

from recon.files.coloured import NO_VALUE, write_coloured
from recon.types import Mesh

TRIANGLE = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
RED = torch.tensor([[1.0, 0, 0]]).expand(3, 3)


def test_ply_holds_values_and_colours(tmp_path):
    values = torch.tensor([0.5, torch.inf, 2.0])
    write_coloured({"a": (TRIANGLE, values, RED), "b": (TRIANGLE, values + 1, RED)}, tmp_path / "x.ply", "distance_mm")
    found = trimesh.load(tmp_path / "x.ply", process=False)
    assert len(found.vertices) == 6 and (found.visual.vertex_colors[:, :3] == [255, 0, 0]).all()
    data = found.metadata["_ply_raw"]["vertex"]["data"]["distance_mm"].reshape(-1)
    assert np.allclose(data, [0.5, NO_VALUE, 2.0, 1.5, NO_VALUE, 3.0])


def test_glb_names_its_parts(tmp_path):
    write_coloured({"top": (TRIANGLE, torch.ones(3), RED)}, tmp_path / "x.glb", "distance_mm")
    scene = trimesh.load_scene(tmp_path / "x.glb")
    assert list(scene.geometry) == ["top"]
    assert (scene.geometry["top"].visual.vertex_colors[:, :3] == [255, 0, 0]).all()


def test_no_nan_is_written(tmp_path):
    with pytest.raises(ValueError, match="NaN"):
        bad = TRIANGLE.with_vertices(torch.full((3, 3), torch.nan))
        write_coloured({"top": (bad, torch.ones(3), RED)}, tmp_path / "x.ply", "mm")
    assert not (tmp_path / "x.ply").exists()
