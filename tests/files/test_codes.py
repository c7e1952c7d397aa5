"""Code files: what is written comes back; what is wrong is told in one line."""

from __future__ import annotations

import json

import pytest
import torch

from recon.files.codes import read_code, write_code
from recon.types import UserError


def test_a_code_comes_back(tmp_path):
    code = torch.randn(32)
    write_code(tmp_path / "a.json", "top", code)
    torch.testing.assert_close(read_code(tmp_path / "a.json", "top", 32), code, atol=1e-6, rtol=0)


def test_a_plain_list_is_a_code(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps([0, 0.5, -1]))
    assert read_code(tmp_path / "a.json", "top", 3).tolist() == [0, 0.5, -1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "can't be read"),
        ("no", "no JSON"),
        ("{}", "no list of numbers"),
        ('["a", 1, 2]', "no list of numbers"),
        ("[1, 2]", "2 numbers"),
        ("[1, 2, NaN]", "NaN or infinite"),
        ('{"kind": "skirt", "latent": [1, 2, 3]}', "of kind skirt"),
    ],
)
def test_bad_files_are_told_in_one_line(tmp_path, text, says):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=says) as error:
        read_code(path, "top", 3)
    assert str(error.value).startswith(str(path)) and "wanted a code of kind top: 3 numbers" in str(error.value)


def test_what_is_no_code_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="finite"):
        write_code(tmp_path / "a.json", "top", torch.tensor([float("nan")]))
    assert not (tmp_path / "a.json").exists()
