"""The user's own masks: label PNGs, binary PNGs, and one clear line for everything that is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from recon.files.masks import parse_labels, read_masks
from recon.types import UserError

H, W = 60, 40
GARMENTS = ("top", "trousers")


@pytest.fixture(name="labels")
def _labels() -> np.ndarray:
    out = np.zeros((H, W), np.uint8)
    out[10:30, 10:30] = 1
    out[30:55, 12:28] = 2
    out[55:58, 12:28] = 7
    return out


def save(path: Path, values: np.ndarray, mode: str = "L") -> str:
    image = Image.fromarray(values)
    if mode == "P":
        image = image.convert("P")
        image.putdata(values.ravel().tolist())
        image.putpalette([v for k in range(256) for v in ((k * 37) % 256, (k * 91) % 256, (k * 13) % 256)])
    elif mode != "L":
        image = image.convert(mode)
    image.save(path)
    return str(path)


@pytest.mark.parametrize("mode", ["L", "P", "RGB"])
def test_label_png(tmp_path: Path, labels: np.ndarray, mode: str) -> None:
    path = save(tmp_path / "a.png", labels, mode)
    masks = read_masks([path], "1=top,2=trousers", GARMENTS, (H, W))
    assert list(masks) == list(GARMENTS)
    assert all(m.dtype == torch.bool and m.shape == (H, W) for m in masks.values())
    assert (masks["top"].numpy() == (labels == 1)).all() and (masks["trousers"].numpy() == (labels == 2)).all()


def test_several_labels_may_name_one_garment(tmp_path: Path, labels: np.ndarray) -> None:
    masks = read_masks([save(tmp_path / "a.png", labels)], ["1=top", "2=trousers,7=trousers"], GARMENTS, (H, W))
    assert int(masks["trousers"].sum()) == int((labels >= 2).sum())


@pytest.mark.parametrize("high", [1, 255])
def test_binary_pngs_named_either_way(tmp_path: Path, labels: np.ndarray, high: int) -> None:
    top = save(tmp_path / "whatever.png", ((labels == 1) * high).astype(np.uint8))
    trousers = save(tmp_path / "trousers.png", ((labels == 2) * high).astype(np.uint8))
    masks = read_masks([trousers, f"top={top}"], None, GARMENTS, (H, W))
    assert list(masks) == list(GARMENTS)
    assert (masks["top"].numpy() == (labels == 1)).all() and (masks["trousers"].numpy() == (labels == 2)).all()


def test_cut_outs_with_alpha(tmp_path: Path, labels: np.ndarray) -> None:
    rgba = np.full((H, W, 4), 30, np.uint8)
    rgba[..., 3] = (labels == 1) * 255
    Image.fromarray(rgba).save(tmp_path / "top.png")
    assert (read_masks([str(tmp_path / "top.png")], None, ["top"], (H, W))["top"].numpy() == (labels == 1)).all()


def test_parse_labels() -> None:
    assert parse_labels(" 1 = top, 2=trousers ") == {1: "top", 2: "trousers"}
    assert parse_labels(None) == {} and parse_labels("") == {} and parse_labels([]) == {}
    for wrong in ("top", "top=1", "1=", "1:top", "1=top,1=skirt"):
        with pytest.raises(UserError, match="--labels"):
            parse_labels(wrong)


def test_one_line_for_every_mistake(tmp_path: Path, labels: np.ndarray) -> None:
    good = save(tmp_path / "a.png", labels)
    top = save(tmp_path / "top.png", (labels == 1).astype(np.uint8) * 255)
    empty = save(tmp_path / "trousers.png", np.zeros((H, W), np.uint8))
    overlap = save(tmp_path / "other.png", (labels > 0).astype(np.uint8) * 255)
    text = tmp_path / "text.png"
    text.write_text("no image")
    whole = Path(good).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    both, size = "1=top,2=trousers", (H, W)
    colour = np.zeros((H, W, 3), np.uint8)
    colour[..., 1] = labels * 40
    Image.fromarray(colour).save(tmp_path / "colour.png")
    cases = [
        ([good], both, (H, W + 1), "41 x 60"),  # another size
        ([good], "1=top,3=trousers", size, "label 3"),  # a label that no pixel has
        ([good], "1=top,2=hat", size, "hat"),  # a garment that was not asked for
        ([good], "1=top", size, "no mask for trousers"),
        ([good, top], both, size, "one label PNG"),
        ([top], None, size, "no mask for trousers"),
        ([top, empty], None, size, "0 pixels"),
        ([top, f"trousers={overlap}"], None, size, "shares"),
        ([top, overlap], None, size, "which garment"),
        ([top, f"top={good}"], None, size, "second mask"),
        ([top, f"hat={overlap}"], None, size, "hat"),
        ([top, str(tmp_path / "no" / "trousers.png")], None, size, "no such file"),
        ([str(text)], both, size, "not an image"),
        ([str(tmp_path / "cut.png")], both, size, "damaged"),
        ([str(tmp_path / "colour.png")], both, size, "colour image"),
    ]
    for paths, given, wanted_size, found in cases:
        with pytest.raises(UserError) as error:
            read_masks(paths, given, GARMENTS, wanted_size)
        message = str(error.value)
        assert found in message and "\n" not in message, (paths, given, message)
