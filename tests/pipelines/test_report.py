"""The report: one file that shows everything and loads nothing."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipelines.fit_garment import Layer
from pipelines.fit_result import FitResult
from pipelines.report import Pictures, draw_overlay, write_pictures, write_report
from recon.render.shade import orbit_camera
from recon.types import BodyPose, Photo

VOID = {"meta", "img", "br", "link", "path", "rect"}


class Page(HTMLParser):
    """Collects tags and what they load; fails on tags that are closed in the wrong order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "srcset", "data", "xlink:href") and value]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self._open.pop() == tag


@dataclass(frozen=True)
class Descent:
    steps: int = 3


@dataclass(frozen=True)
class Settings:
    photo: Path = Path("me & you.jpg")
    garments: tuple[str, ...] = ("top",)
    descent: Descent = field(default_factory=Descent)


FIGURES = {
    "garments": {
        "top": {
            "iou": 0.951, "iou_code_only": 0.84, "vertices": 10, "faces": 20, "penetrating_vertices": 0,
            "penetrating_faces": 3, "self_intersections": 0, "stretch_p95": 1.02, "mask_confidence": None,
        }
    },
    "body": {"iou": 0.9},
    "seconds": {"body": 3.25, "total": 33.0},
    "versions": {"torch": "2.x"},
    "notes": ["2 people <found>; the larger was taken"],
}  # fmt: skip


@pytest.fixture
def result(tmp_path, flat_shirt):
    shirt = flat_shirt(0.05)
    inner = shirt.mesh.with_vertices(shirt.mesh.vertices * torch.tensor([0.8, 1.0, 0.5]))
    camera = orbit_camera([shirt.mesh], size=(96, 64))
    rgb = torch.randint(0, 255, (96, 64, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    mask = torch.zeros(96, 64, dtype=torch.bool)
    mask[20:60, 10:50] = True
    photo = Photo(rgb, mask.float(), {"top": mask}, ~mask, torch.zeros(33, 3), torch.zeros(33, 3))
    pose = BodyPose(torch.zeros(1, 2), torch.zeros(1, 24, 3), torch.zeros(1, 3))
    garments = {"top": shirt.mesh}
    layers = (Layer("top", shirt),)
    return FitResult(tmp_path, FIGURES, pose, inner, layers, garments, photo=photo, camera=camera)


def test_one_file_that_loads_nothing(result):
    write_report(result, write_pictures(result), Settings())
    text = (result.folder / "report.html").read_text()
    page = Page(text)
    assert page.tags.count("img") == 9 and page.tags.count("svg") == 1
    assert page.loads and all(value.startswith("data:image/jpeg;base64,") for value in page.loads)
    assert not re.search(r"""(url\(|@import|<script|<link|https?://(?!www\.w3\.org/2000/svg))""", text)
    assert "2 people &lt;found&gt;" in text and "me &amp; you.jpg" in text
    assert "descent.steps" in text and "prefers-color-scheme: dark" in text
    missed = re.findall(r"<td class=missed>([^<]*)<", text)
    assert missed == ["0.840", "3"]
    assert '<a href="patterns/top.svg">' in text


def test_pictures_are_written_and_tell_the_truth(result):
    pictures = write_pictures(result)
    overlay = cv2.imread(str(result.folder / "overlay.png"))[..., ::-1]
    assert np.array_equal(overlay, pictures.overlay) and overlay.shape == (96, 64, 3)
    assert (result.folder / "turntable.png").is_file() and len(pictures.turntable) == 6
    assert np.array_equal(write_pictures(result).dressed, pictures.dressed)


def test_overlay_tints_where_a_layer_lies_and_leaves_the_rest():
    photo = np.full((60, 60, 3), 100, np.uint8)
    cover = np.zeros((1, 60, 60), np.float32)
    cover[0, 20:40, 20:40] = 1
    drawn = draw_overlay(photo, cover, [np.zeros((60, 60), bool)], [(1.0, 0.0, 0.0)])
    assert drawn[30, 30].tolist() == [178, 50, 50]
    assert (drawn[:15] == 100).all() and (photo == 100).all()


def test_a_failed_encoding_is_an_error(result):
    empty = Pictures(*([np.zeros((0, 0, 3), np.uint8)] * 3), ())
    with pytest.raises((ValueError, cv2.error)):
        write_report(result, empty, Settings())
