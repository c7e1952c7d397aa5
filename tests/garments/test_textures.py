"""Textures on panels: where they land, on which side, and on every garment of a kind alike."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
import trimesh

from pipelines.decode import Decode, decode
from recon.files.textures import read_texture, write_png
from recon.garments.textures import SIDE, Sheet, colours_at, template, unsewn
from recon.types import UserError

SHEET = Sheet((0.0, 0.35), 0.5)


def gradient(h: int = 64) -> torch.Tensor:
    """Red grows to the right, green downwards."""
    x = (torch.arange(2 * h) + 0.5) / (2 * h)
    y = (torch.arange(h) + 0.5) / h
    return torch.stack([x.expand(h, -1), y[:, None].expand(-1, 2 * h), torch.zeros(h, 2 * h)], 2)


def test_front_lies_left_and_back_right_seen_from_outside(flat_shirt):
    shirt = flat_shirt(0.05)
    at = SHEET.coordinates(shirt)
    back = shirt.side_of_point == 1
    assert bool((at[~back, 0] <= 0.5).all()) and bool((at[back, 0] >= 0.5).all())
    left = shirt.panel_points[:, 0].argmax()  # the wearer's left: right in front, left behind
    assert at[~back, 0].max() == pytest.approx(0.25 + 0.3 / 0.5 / 4) and not back[left]
    assert at[back][shirt.panel_points[back, 0].argmax(), 0] == at[back, 0].min()
    top = shirt.panel_points[:, 1].argmax()
    assert at[top, 1] == at[:, 1].min()


def test_colours_are_those_of_the_image(flat_shirt):
    at = SHEET.coordinates(flat_shirt(0.05))
    found = colours_at(gradient(), at)
    assert torch.allclose(found[:, :2], at.clamp(1 / 128, 127 / 128), atol=1e-2)


def test_unsewn_surface_is_the_same(flat_shirt):
    shirt = flat_shirt(0.05)
    mesh = unsewn(shirt)
    assert torch.equal(mesh.vertices[mesh.faces], shirt.mesh.vertices[shirt.mesh.faces])
    assert len(mesh.vertices) == len(shirt.panel_points)


def test_a_template_is_a_texture(tmp_path, flat_shirt):
    image = template(flat_shirt(0.05), SHEET)
    assert image.shape == (SIDE, 2 * SIDE, 3)
    write_png(tmp_path / "t.png", image)
    texture = read_texture(tmp_path / "t.png")
    assert torch.allclose(texture, torch.tensor(image[..., ::-1] / 255.0).float())


def test_the_command_puts_it_into_the_file(tmp_path):
    write_png(tmp_path / "t.png", (gradient(32).numpy()[..., ::-1] * 255).astype(np.uint8))
    config = Decode(("skirt", "0"), tmp_path / "a.glb", 48, texture=tmp_path / "t.png", template=tmp_path / "draw.png")
    decode(config)
    scene = trimesh.load(tmp_path / "a.glb")
    (mesh,) = scene.geometry.values()
    assert mesh.visual.material.baseColorTexture.size == (64, 32)
    assert float(mesh.visual.uv.min()) >= 0 and float(mesh.visual.uv.max()) <= 1
    assert cv2.imread(str(tmp_path / "draw.png")).shape == (SIDE, 2 * SIDE, 3)


@pytest.mark.parametrize(
    ("size", "out", "says"), [((64, 64), "a.glb", "64 x 64 pixels"), ((32, 64), "a.obj", "wanted .glb")]
)
def test_mistakes_are_told_and_write_nothing(tmp_path, size, out, says):
    write_png(tmp_path / "t.png", np.zeros((*size, 3), np.uint8))
    with pytest.raises(UserError, match=says):
        decode(Decode(("skirt", "0"), tmp_path / out, 48, texture=tmp_path / "t.png"))
    assert [p.name for p in tmp_path.iterdir()] == ["t.png"]


def test_what_is_no_image_is_told(tmp_path):
    (tmp_path / "t.png").write_text("no")
    with pytest.raises(UserError, match="not an image"):
        read_texture(tmp_path / "t.png")
    with pytest.raises(UserError, match="no such file"):
        read_texture(tmp_path / "u.png")
