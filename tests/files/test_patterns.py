"""Pattern files: true to scale, every stretch of border named, both sides of a seam equal."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.files.patterns import cut_pieces, write_svg

SVG = "{http://www.w3.org/2000/svg}"


def outlines(path) -> dict[str, list[np.ndarray]]:
    """Piece name -> its closed outlines in the file's units."""
    found = {}
    for group in ET.parse(path).getroot().iter(f"{SVG}g"):
        cut = next(p for p in group.iter(f"{SVG}path") if p.get("class") == "cut")
        loops = [re.findall(r"(-?[\d.]+) (-?[\d.]+)", part) for part in cut.get("d").split("Z") if part.strip()]
        found[group.get("data-name")] = [np.array(loop, float) for loop in loops]
    return found


def area(loop: np.ndarray) -> float:
    """Shoelace."""
    x, y = loop.T
    return abs(0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))


def length(loop: np.ndarray) -> float:
    return float(np.linalg.norm(loop - np.roll(loop, -1, 0), axis=1).sum())


def test_panels_come_back_at_true_scale(tmp_path, flat_shirt):
    write_svg(flat_shirt(), tmp_path / "top.svg")
    pieces = outlines(tmp_path / "top.svg")
    assert set(pieces) == {"front", "back"}
    for loops in pieces.values():
        assert len(loops) == 1
        assert area(loops[0]) == pytest.approx(0.40e6, rel=1e-4)
        assert length(loops[0]) == pytest.approx(2800.0, rel=1e-4)
        assert np.allclose(np.ptp(loops[0], axis=0), [600, 700], atol=0.01)


def test_one_unit_is_one_millimetre_and_nothing_leaves_the_page(tmp_path, flat_shirt):
    write_svg(flat_shirt(), tmp_path / "top.svg")
    root = ET.parse(tmp_path / "top.svg").getroot()
    _, _, w, h = map(float, root.get("viewBox").split())
    assert root.get("width") == f"{w:.2f}mm" and root.get("height") == f"{h:.2f}mm"
    front, back = (outlines(tmp_path / "top.svg")[name][0] for name in ("front", "back"))
    assert front[:, 0].max() < back[:, 0].min()
    both = np.concatenate([front, back])
    assert both.min() > 0 and both[:, 0].max() < w and both[:, 1].max() < h


def test_borders_are_cut_into_seams_and_open_edges(flat_shirt):
    front = cut_pieces(flat_shirt(), 0)[0]
    found = sorted((run.label, round(run.length)) for run in front.runs)
    assert found == [(0, 200), (0, 200), (0, 400), (0, 600), (1, 500), (1, 500), (2, 200), (2, 200)]
    assert sum(run.length for run in front.runs) == pytest.approx(length(front.loops[0]))


def test_both_sides_of_a_seam_have_one_number_and_one_length(tmp_path, flat_shirt):
    write_svg(flat_shirt(open_front=True), tmp_path / "jacket.svg")
    texts = [t.text for t in ET.parse(tmp_path / "jacket.svg").getroot().iter(f"{SVG}text")]
    seams = sorted(text for text in texts if re.match(r"\d (side|shoulder) ", text or ""))
    assert len(seams) == 8 and seams[::2] == seams[1::2]
    assert {text.split(" · ")[1] for text in seams} == {"500 mm", "200 mm"}


def test_an_open_front_gives_two_pieces(tmp_path, flat_shirt):
    shirt = flat_shirt(open_front=True)
    write_svg(shirt, tmp_path / "jacket.svg")
    pieces = outlines(tmp_path / "jacket.svg")
    assert set(pieces) == {"front 1 of 2", "front 2 of 2", "back"}
    corners = shirt.panel_points[shirt.panel_faces].double()
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    whole = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs().sum() / 2 * 1e6
    assert sum(area(loop) for loops in pieces.values() for loop in loops) == pytest.approx(float(whole), rel=1e-4)


def test_the_back_is_drawn_as_seen_from_outside(flat_shirt):
    shirt = flat_shirt()
    lean = shirt.panel_points + torch.stack([shirt.panel_points[:, 1] * 0.2, torch.zeros(len(shirt.panel_points))], 1)
    front, back = (cut_pieces(replace(shirt, panel_points=lean), panel)[0].loops[0] for panel in (0, 1))
    top = [loop[loop[:, 1] < loop[:, 1].min() + 1, 0].mean() - loop[:, 0].mean() for loop in (front, back)]
    assert top[0] > 0 > top[1]


def test_names_are_escaped(tmp_path, flat_shirt):
    write_svg(flat_shirt(0.1), tmp_path / "x.svg", name="<top> & co")
    assert ET.parse(tmp_path / "x.svg").getroot().find(f"{SVG}title").text == "<top> & co"


def test_what_is_no_number_is_never_written(tmp_path, flat_shirt):
    shirt = flat_shirt(0.1)
    with pytest.raises(ValueError, match="panel coordinates are NaN"):
        write_svg(replace(shirt, panel_points=shirt.panel_points * float("nan")), tmp_path / "top.svg")
    assert not list(tmp_path.iterdir())
