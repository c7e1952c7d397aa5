"""Runs: stages are kept, redone when what they depend on changed, and survive being killed anywhere."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
import torch

from pipelines.run import Run
from recon.types import UserError

ME = {"photo": "abc", "garments": ["top"]}


class Counted:
    """Two stages that count how often they ran."""

    def __init__(self, folder, evidence=None):
        self.ran: list[str] = []
        self.heard: list[tuple[str, str]] = []
        self.run = Run(folder, ME, evidence, say=lambda stage, event, _: self.heard.append((stage, event)))

    def first(self, config):
        self.ran.append("first")
        return {"x": torch.arange(3.0) / config["by"], "note": "n"}

    def second(self, state):
        self.ran.append("second")
        return state["x"] * 2

    def go(self, by=2.0):
        state = self.run.stage("first", self.first, config={"by": by})
        return self.run.stage("second", self.second, state)


def test_a_second_run_keeps_every_stage_and_gives_the_same(tmp_path):
    one, two = Counted(tmp_path / "out"), Counted(tmp_path / "out")
    a, b = one.go(), two.go()
    assert torch.equal(a, b) and a.tolist() == [0.0, 1.0, 2.0]
    assert one.ran == ["first", "second"] and two.ran == [] and two.run.kept == ["first", "second"]
    assert two.run.seconds == one.run.seconds
    assert one.heard == [("first", "start"), ("first", "done"), ("second", "start"), ("second", "done")]
    assert two.heard == [("first", "kept"), ("second", "kept")]


def test_a_changed_setting_redoes_its_stage_and_what_follows(tmp_path):
    Counted(tmp_path).go()
    changed = Counted(tmp_path)
    assert changed.go(by=1.0).tolist() == [0.0, 2.0, 4.0]
    assert changed.ran == ["first", "second"]


def test_changed_evidence_redoes_everything_without_an_error(tmp_path):
    Counted(tmp_path, {"masks": 1}).go()
    changed = Counted(tmp_path, {"masks": 2})
    changed.go()
    assert changed.ran == ["first", "second"]


def test_a_later_change_keeps_what_came_before(tmp_path):
    def run():
        ran = []
        run = Run(tmp_path, ME)
        for name in ("a", "b", "c"):
            run.stage(name, lambda c, name=name: ran.append(name), config={"v": settings[name]})
        return ran

    settings = {"a": 1, "b": 1, "c": 1}
    assert run() == ["a", "b", "c"]
    settings["b"] = 2
    assert run() == ["b", "c"]


@pytest.mark.parametrize("harm", ["cut", "gone", "no card", "broken card"])
def test_damaged_state_is_computed_again(tmp_path, harm):
    expected = Counted(tmp_path).go()
    tensors, card = tmp_path / "stages" / "second.safetensors", tmp_path / "stages" / "second.json"
    if harm == "cut":
        tensors.write_bytes(tensors.read_bytes()[:-3])
    elif harm == "gone":
        tensors.unlink()
    elif harm == "no card":
        card.unlink()
    else:
        card.write_text('{"key": ')
    again = Counted(tmp_path)
    assert torch.equal(again.go(), expected) and again.ran == ["second"]


def test_another_runs_folder_is_refused_and_left_alone(tmp_path):
    Counted(tmp_path).go()
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(
        UserError, match=rf"{tmp_path}: holds the result of another run \(its garments differ\)"
    ) as error:
        Run(tmp_path, {**ME, "garments": ["top", "trousers"]})
    assert "\n" not in str(error.value)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_a_folder_of_other_files_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(UserError, match="holds files that no run wrote"):
        Run(tmp_path, ME)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_the_folders_place_is_refused(tmp_path):
    (tmp_path / "out").write_text("precious")
    with pytest.raises(UserError, match="is a file"):
        Run(tmp_path / "out", ME)


def test_killed_while_claiming_the_folder_it_still_goes_on(tmp_path):
    (tmp_path / ".run.json.tmp").write_text('{"sch')
    Run(tmp_path, ME)
    assert json.loads((tmp_path / "run.json").read_text())["identity"] == ME


def test_tensors_come_back_on_the_runs_device(tmp_path):
    run = Run(tmp_path, ME, device="meta")
    assert run.stage("x", lambda: torch.ones(2)).device.type == "meta"


KILLED = """
import os, signal, sys, torch
from pipelines.run import Run
left, replace = int(sys.argv[2]), os.replace

def counted(a, b):  # one of the many moments at which a run can die: between two renames
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    replace(a, b)

os.replace = counted
run = Run(sys.argv[1], {"photo": "p"})
g = run.stage("a", lambda: torch.rand(4, generator=torch.Generator().manual_seed(1)))
h = run.stage("b", lambda: {"g": g * 2, "n": 3})
print((h["g"] + h["n"]).tolist())
"""


def test_killed_at_any_rename_a_second_run_ends_with_the_same(tmp_path):
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}

    def go(folder, renames):
        done = subprocess.run(
            [sys.executable, "-c", KILLED, folder, str(renames)], capture_output=True, text=True, env=env
        )
        return done.returncode, done.stdout

    code, expected = go(tmp_path / "whole", 99)
    assert code == 0 and expected
    for renames in range(0, 5, 2):
        folder = tmp_path / str(renames)
        assert go(folder, renames)[0] == -signal.SIGKILL
        assert go(folder, 99) == (0, expected)
