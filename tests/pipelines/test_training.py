"""The training loop: a budget, a checkpoint, and what it does with numbers that are none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pipelines.training import Budget, Training, curve
from recon.types import UserError


def line(out: Path, settings: str = "a", seed: int = 0) -> Training:
    """Learns y = 2 x."""
    torch.manual_seed(seed)
    module = torch.nn.Linear(1, 1, bias=False)
    return Training("line", module, torch.optim.Adam(module.parameters(), 0.1), settings, out)


def loss_of(training: Training):
    def loss(share: float):
        x = torch.linspace(-1, 1, 9)[:, None]
        off = (training.module(x) - 2 * x).square().mean()
        return off, {"off": off.item(), "share": share}

    return loss


def test_it_learns_logs_and_cleans_up(tmp_path: Path) -> None:
    training = line(tmp_path)
    training.run(Budget(1.0, 300), loss_of(training))
    assert training.step == 300 and training.module.weight.item() == pytest.approx(2, abs=0.02)
    rows = [json.loads(row) for row in (tmp_path / "line.log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [100, 200, 300] and rows[-1]["off"] < rows[0]["off"]
    assert not training.checkpoint.exists()
    told = curve(training.log, 2)
    assert [row["off"] for row in told] == [float(f"{rows[k]['off']:.3g}") for k in (1, 2)]
    assert set(told[0]) == {"minutes", "off", "share"}


def test_the_clock_is_a_budget_too(tmp_path: Path) -> None:
    training = line(tmp_path)
    training.run(Budget(0.002), loss_of(training))
    assert training.step > 5 and training.seconds >= 0.12


def test_interrupted_it_goes_on_to_the_same_end(tmp_path: Path) -> None:
    whole, half = line(tmp_path / "a"), line(tmp_path / "b")
    whole.run(Budget(1.0, 60), loss_of(whole))

    class Killed(Exception):
        pass

    def until(share: float):
        if half.step == 25:
            half.save()
            raise Killed
        return loss_of(half)(share)

    with pytest.raises(Killed):
        half.run(Budget(1.0, 60), until)
    again = line(tmp_path / "b", seed=9)
    again.resume()
    assert again.step == 25
    again.run(Budget(1.0, 60), loss_of(again))
    assert torch.equal(again.module.weight, whole.module.weight)


def test_a_loss_that_is_no_number_changes_nothing(tmp_path: Path) -> None:
    training = line(tmp_path)
    before = training.module.weight.item()
    training.run(Budget(1.0, 3), lambda share: (training.module.weight.sum() * float("nan"), {}))
    assert training.module.weight.item() == before and training.step == 3


def test_checkpoints_of_something_else_are_refused(tmp_path: Path) -> None:
    line(tmp_path).save()
    with pytest.raises(UserError, match="other settings"):
        line(tmp_path, "b").resume()
    (tmp_path / "line.checkpoint").write_bytes(b"no")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        line(tmp_path).resume()
