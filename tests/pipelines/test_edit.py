"""Editing through the pattern: named edits of outlines, and the code that follows them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.decode import Decode, decode
from pipelines.edit import Edit, edit, outline_error, wanted_outline
from pipelines.fit_code import CodeFit
from recon.files.codes import read_code
from recon.garments.isp import load_isp
from recon.garments.outlines import closed, known_parameters, opened, with_length, with_sleeves
from recon.types import UserError

KNOWN = {"neck_y": 1.4, "armpit_y": 1.2, "chest_x": 0.3, "shoulder_x": 0.2}
SHORT = CodeFit(starts=1, rounds=3, steps=12, prior=1e-3)


def shirt():
    """A flat shirt's loops, the same in front and back."""
    left = [(0.3, 0.8), (0.3, 1.2), (0.6, 1.2), (0.6, 1.4), (0.1, 1.4)]
    loop = np.array(left + [(-x, y) for x, y in left[::-1]])
    return [[loop], [loop.copy()]]


def test_length_moves_the_hem_alone():
    after = with_length(shirt(), 1.5, "top", KNOWN)[0][0]
    assert after[:, 1].min() == pytest.approx(1.4 - 1.5 * 0.6)
    assert np.array_equal(after[1:5], shirt()[0][0][1:5])
    with pytest.raises(UserError, match="length: found 0.1; wanted at least"):
        with_length(shirt(), 0.1, "top", KNOWN)


def test_sleeves_move_the_cuffs_alone():
    after = with_sleeves(shirt(), 0.5, KNOWN)[1][0]
    assert np.abs(after[:, 0]).max() == pytest.approx(0.2 + 0.5 * 0.4)
    assert np.array_equal(after[[0, 1, 4]], shirt()[1][0][[0, 1, 4]])
    with pytest.raises(UserError, match="has none"):
        with_sleeves(shirt(), 0.5, {k: v for k, v in KNOWN.items() if k != "shoulder_x"})
    with pytest.raises(UserError, match="wanted at least"):
        with_sleeves(shirt(), 0.1, KNOWN)


def area(loop):
    x, y = loop.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def test_opened_and_closed_again():
    apart = opened(shirt(), 0.05)
    assert [len(loops) for loops in apart] == [2, 1]
    assert sum(map(area, apart[0])) == pytest.approx(area(shirt()[0][0]) - 0.05 * 0.6)
    assert all(area(loop) > 0 for loop in apart[0])
    again = closed(apart)
    assert len(again[0]) == 1 and area(again[0][0]) == pytest.approx(area(shirt()[0][0]))
    with pytest.raises(UserError, match="open already"):
        opened(apart, 0.05)
    with pytest.raises(UserError, match="closed already"):
        closed(again)


def test_a_learned_code_knows_its_own_parameters():
    decoder = load_isp("skirt")
    known = known_parameters(decoder.codes, decoder.parameters, decoder.codes[5])
    assert known["hem_y"] == pytest.approx(decoder.parameters[5]["hem_y"], abs=0.06)


def test_the_command_shortens_a_skirt(tmp_path):
    said = edit(
        Edit(("skirt:3",), tmp_path / "a.obj", length=0.9, resolution=64, code=tmp_path / "a.json", search=SHORT)
    )
    decoder = load_isp("skirt")
    config = Edit(("skirt:3",), tmp_path / "a.obj", length=0.9)
    wanted = wanted_outline(config, decoder, decoder.codes[3])
    before = outline_error(decoder, decoder.codes[3], wanted)["outline_mm"]
    after = outline_error(decoder, read_code(tmp_path / "a.json", "skirt", 32), wanted)["outline_mm"]
    assert said["outline_mm"] == after < 0.5 * before
    assert said["open_borders"] == 2


def test_an_edited_drawing_is_followed(tmp_path):
    drawing = tmp_path / "a.svg"
    decode(Decode(("skirt", "3"), tmp_path / "a.obj", 64, pattern=drawing))
    text = drawing.read_text()
    taller = re.sub(r'(id="cut-(?:front|back)")', r'\1 transform="translate(0 0) scale(1 1)"', text)
    drawing.write_text(taller)
    said = edit(Edit(("skirt:3",), tmp_path / "b.obj", svg=drawing, resolution=64, search=SHORT))
    assert said["outline_mm"] < 2.5


@pytest.mark.parametrize(("amount", "longer"), [("1.2", True), ("-1.2", False)])
def test_attributes_change_a_code_without_its_pattern(tmp_path, amount, longer):
    """What tells long skirts from short ones makes a skirt longer or shorter."""
    said = edit(Edit(("skirt:3",), tmp_path / "a.obj", attributes=(f"length={amount}",), resolution=64))
    before, after = said["extent"]["before"][1], said["extent"]["after"][1]
    assert (after > before + 0.01) if longer else (after < before - 0.01)
    assert said["attributes"]["length"]["accuracy"] > 0.85 and said["open_borders"] == 2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({}, "nothing to do"),
        ({"what": ("skirt",), "length": 1.1}, "wanted KIND:CODE"),
        ({"what": ("hat:1",), "length": 1.1}, "found 'hat'"),
        ({"what": ("skirt:999",), "length": 1.1}, "a number from 0"),
        ({"length": 4.0}, "beyond the patterns"),
        ({"length": -1.0}, "wanted a factor"),
        ({"sleeve": 0.5}, "has none"),
        ({"open": True}, "has no open form"),
        ({"close": True}, "closed already"),
        ({"attributes": ("sleeves=1",)}, "all known garments of kind skirt"),
        ({"attributes": ("colour=1",)}, "found 'colour=1'; wanted some of sleeves, length, opening"),
        ({"attributes": ("length=1", "length=2")}, "found twice 'length=2'"),
        ({"attributes": ("length=long",)}, "wanted a number, as in length=-1"),
        ({"attributes": ("length=nan",)}, "wanted an amount from -5 to 5"),
        ({"attributes": ("length=1",), "open": True}, "wanted one of them"),
        ({"length": 1.1, "decoder": "udf"}, "no pattern to edit; wanted --attributes"),
        ({"attributes": ("length=1",), "decoder": "udf", "pattern": Path("a.svg")}, "have no panels"),
    ],
)
def test_mistakes_are_told_and_write_nothing(tmp_path, change, says):
    with pytest.raises(UserError, match=says):
        edit(replace(Edit(("skirt:3",), tmp_path / "a.obj", search=SHORT), **change))
    assert not list(tmp_path.iterdir())
