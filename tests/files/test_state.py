"""State on disk: what goes in comes out, bit for bit, and nothing else is ever built."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.files.atomic import temporary, write_whole
from recon.files.state import canonical, decode, digest, encode
from recon.types import BodyPose, Camera, Garment


def there_and_back(value):
    description, tensors = encode(value)
    return decode(json.loads(json.dumps(description)), tensors)


def test_nested_values_survive_bit_for_bit(flat_shirt):
    pose = BodyPose(torch.randn(2, 5), torch.randn(2, 24, 3), torch.randn(2, 3, dtype=torch.float64))
    camera = Camera(torch.eye(3), torch.eye(3), torch.tensor([0.0, 0.0, 3.0]), (640, 480))
    value = {"pose": pose, "list": [camera, None, True, 0.1, 3, "ü"], "at": Path("a/b"), "pair": (torch.tensor(3), ())}
    back = there_and_back({**value, "shirt": flat_shirt(0.1), "array": np.arange(6).reshape(2, 3)[:, ::2]})
    assert torch.equal(back["pose"].translation, pose.translation)
    assert back["pose"].translation.dtype == torch.float64
    assert back["list"][0].size == (640, 480) and back["list"][1:] == [None, True, 0.1, 3, "ü"]
    assert back["at"] == Path("a/b") and back["pair"][0].shape == () and back["pair"][1] == ()
    assert isinstance(back["shirt"], Garment) and torch.equal(back["shirt"].mesh.faces, flat_shirt(0.1).mesh.faces)
    assert np.array_equal(back["array"], [[0, 2], [3, 5]])


def test_tensors_that_share_memory_come_back_apart():
    both = torch.arange(4.0)
    first, second = there_and_back([both, both[1:]])
    first += 1
    assert second.tolist() == [1.0, 2.0, 3.0]


def test_gradients_are_left_behind():
    assert not there_and_back(torch.zeros(2, requires_grad=True) + 1).requires_grad


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(), lambda inner: (
    st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner)
), max_leaves=20))  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_any_plain_value_survives(value):
    assert there_and_back(value) == value


def test_what_cannot_be_kept_is_named_with_its_place():
    with pytest.raises(TypeError, match=r"state\.a\.1: a .*Linear"):
        encode({"a": [1, torch.nn.Linear(1, 1)]})


def test_classes_of_other_packages_are_never_built():
    with pytest.raises(ValueError, match="foreign package"):
        decode({"$class": "subprocess:Popen", "fields": {"args": "true"}}, {})
    with pytest.raises(ValueError, match="no dataclass"):
        decode({"$class": "recon.files.atomic:write_whole", "fields": {}}, {})


def test_canonical_tells_settings_apart_by_value_only():
    same = {"b": torch.ones(2), "a": 1.5}
    assert canonical(same) == canonical({"a": 1.5, "b": torch.ones(2)})
    assert canonical(same) != canonical({"a": 1.5, "b": torch.ones(2) + 1e-6})
    assert canonical((1, 2)) != canonical([1, 2])
    assert digest("ab", "c") != digest("a", "bc")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "deep" / "file.txt"
    write_whole(path, "old")

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, "new")
    assert path.read_text() == "old" and not temporary(path).exists()
