"""Patterns back from SVG: what was written comes back, edited or not; what is wrong is told in one line."""

from __future__ import annotations

import re

import numpy as np
import pytest

from recon.files.pattern_reading import crossing, read_svg
from recon.files.patterns import write_svg
from recon.types import UserError


@pytest.fixture
def written(tmp_path, flat_shirt):
    """A shirt, open in front, and its pattern's file."""
    shirt = flat_shirt(0.05, open_front=True)
    write_svg(shirt, tmp_path / "a.svg")
    return shirt, tmp_path / "a.svg"


def test_panels_come_back(written):
    shirt, path = written
    cut = read_svg(path)
    assert [len(loops) for loops in cut] == [2, 1]
    for panel, loops in enumerate(cut):
        own = shirt.panel_points[shirt.panel_faces[shirt.panel_of_face == panel]].reshape(-1, 2).numpy()
        both = np.concatenate(loops)
        assert np.allclose(both.min(0), own.min(0), atol=1e-5) and np.allclose(both.max(0), own.max(0), atol=1e-5)


def test_transforms_and_curves_are_understood(written):
    _, path = written
    before = read_svg(path)[1][0]
    text = path.read_text()
    moved = text.replace('id="cut-back"', 'id="cut-back" transform="translate(0 -50)"')
    path.write_text(moved)
    assert np.allclose(read_svg(path)[1][0], before + [0, 0.05], atol=1e-5)
    d = re.search(r'id="cut-back"[^>]* d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)', text)
    x0, y0, x1, y1 = (float(v) for v in d.groups())
    bent = text.replace(d[0], d[0].rsplit("L", 1)[0] + f"C{x0} {y0 - 20} {x1} {y1 - 20} {x1} {y1}")
    path.write_text(bent)
    assert len(read_svg(path)[1][0]) > len(before) + 5


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace('id="cut-back"', 'id="gone"'), "no path called cut-back"),
        (lambda t: re.sub(r'(id="cut-back"[^>]*)Z"', r'\1"', t), "outline is open by"),
        (lambda t: re.sub(r'width="[\d.]+mm"', 'width="900px"', t), "its width is 900px"),
        (lambda t: t.replace("data-origin", "data-lost"), "lost its group's data-origin"),
        (lambda t: t.replace("</svg>", ""), "no SVG"),
        (lambda t: "<html></html>", "a <html> file"),
        (lambda t: re.sub(r'viewBox="[^"]*"', 'viewBox="0 0 30 30"', t), "true scale"),
    ],
)
def test_bad_patterns_are_told_in_one_line(written, change, says):
    _, path = written
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError, match=says) as error:
        read_svg(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_outlines_that_cross_are_found():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    assert crossing([square, square + 2]) is None
    assert crossing([square, square + 0.5]) is not None
    bow = square[[0, 2, 1, 3]]
    assert np.allclose(crossing([bow]), [0.5, 0.5])


def test_missing_files_are_told(tmp_path):
    with pytest.raises(UserError, match="can't be read"):
        read_svg(tmp_path / "no.svg")
