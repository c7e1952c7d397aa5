"""Weights on disk: written whole, read back, refused when they are not what the manifest says."""

import json

import pytest
import torch

from recon.files.weights import read_manifest, read_weights, write_weights
from recon.types import UserError

TENSORS = {"a": torch.randn(4, 5), "n": torch.arange(3)}


def test_round_trip_in_half_precision(tmp_path):
    path = write_weights("net", TENSORS, {"seed": 3}, tmp_path)
    back = read_weights("net", tmp_path)
    assert back.tensors["a"].dtype == torch.float32 and back.tensors["n"].dtype == torch.int64
    torch.testing.assert_close(back.tensors["a"], TENSORS["a"], atol=2e-3, rtol=2e-3)
    assert back.card["seed"] == 3 and back.card["bytes"] == path.stat().st_size


def test_several_networks_share_a_manifest(tmp_path):
    write_weights("one", TENSORS, {}, tmp_path)
    write_weights("two", TENSORS, {}, tmp_path)
    write_weights("one", TENSORS, {"again": True}, tmp_path)
    cards = read_manifest(tmp_path)
    assert set(cards) == {"one", "two"} and cards["one"]["again"]


def test_mistakes_are_named_in_one_line(tmp_path):
    with pytest.raises(UserError, match="lists nothing"):
        read_weights("net", tmp_path)
    path = write_weights("net", TENSORS, {}, tmp_path)
    with pytest.raises(UserError, match="no weights called other; it lists net"):
        read_weights("other", tmp_path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(UserError, match="sha256"):
        read_weights("net", tmp_path)
    path.unlink()
    with pytest.raises(UserError, match="can't be read"):
        read_weights("net", tmp_path)
    (tmp_path / "manifest.json").write_text("[1]")
    with pytest.raises(UserError, match="manifest") as error:
        read_weights("net", tmp_path)
    assert "\n" not in str(error.value)


def test_infinite_weights_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        write_weights("net", {"a": torch.tensor([1e9])}, {}, tmp_path)
    assert not list(tmp_path.glob("*.safetensors"))


def test_cards_are_json(tmp_path):
    write_weights("net", TENSORS, {"metrics": {"mm": 1.5}}, tmp_path)
    assert json.loads((tmp_path / "manifest.json").read_text())["net"]["metrics"]["mm"] == 1.5
