"""GAPS' last layer as two: the same where states are few, near with few units, and how a training ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.low_rank import low_rank, narrowed
from pipelines.train_gaps import TrainGaps, train_gaps
from recon.bodies import load_body
from recon.draping.gaps import GapsNet, GapsShape, load_gaps
from recon.garments.dataset import load_garments
from recon.types import UserError


def test_a_narrowed_network_is_the_same_with_all_and_near_with_few() -> None:
    rest = load_garments("skirt", "test")[1].mesh
    torch.manual_seed(0)
    net = GapsNet(GapsShape(len(rest.vertices), 20, width=24, layers=1))
    states = torch.randn(400, 24) * torch.logspace(0, -2, 24)
    with torch.no_grad():
        wanted = net.displaced(states)
        off = [float((narrowed(net, states, rest, r).displaced(states) - wanted).norm()) for r in (24, 6, 2)]
    assert off[0] < 1e-3 * float(wanted.norm()) and off[0] <= off[1] < off[2]
    again = GapsNet(net.shape)
    again.take_over(narrowed(net, states, rest, 24))
    with torch.no_grad():
        torch.testing.assert_close(again.displaced(states), wanted, atol=1e-5, rtol=1e-3)


def test_a_training_ends_narrowed_and_goes_on_from_it(tmp_path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    np.savez(clips / "stroll.npz", pose=np.zeros((12, 24, 3)), translation=np.zeros((12, 3)), fps=30)
    config = TrainGaps(
        "skirt:test:1", clips, name="mini", out=tmp_path / "first", steps=1, threads=1, windows=1, width=16, layers=1,
        modes=10, burn_in=1, rank=6,
    )  # fmt: skip
    train_gaps(config)
    assert load_gaps("mini", load_body(), tmp_path / "first").net.shape.rank == 6
    assert {f.suffix for f in (tmp_path / "first").iterdir() if f.is_file()} == {".safetensors", ".json", ".jsonl"}
    onward = replace(config, out=tmp_path / "second", start=tmp_path / "first", steps=0, minutes=0)
    assert train_gaps(onward).is_file()
    with pytest.raises(UserError, match="another garment"):
        train_gaps(replace(onward, garment="skirt:test:2", out=tmp_path / "third"))


def test_a_layer_in_two_is_the_layer_where_states_are_few() -> None:
    torch.manual_seed(0)
    layer, states = torch.nn.Linear(9, 20), torch.randn(50, 3) @ torch.randn(3, 9) + 1
    with torch.no_grad():
        few, out = low_rank(layer, states, 3, lambda moved: moved)
        torch.testing.assert_close(out(few(states)), layer(states), atol=1e-4, rtol=1e-4)
        few, out = low_rank(layer, states, 1, lambda moved: moved)
        assert float((out(few(states)) - layer(states)).norm()) > 0.1
