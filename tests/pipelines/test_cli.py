"""The command line: one-line mistakes, exit codes, settings, and a quick start."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

import recon
from pipelines import cli, doctor
from recon.types import UserError


@dataclass(frozen=True)
class Inner:
    """Settings of a stage."""

    steps: int = 3
    """How many."""


@dataclass(frozen=True)
class Settings:
    """Settings like those of ``recon photo``."""

    photo: Path
    """The photo."""
    garments: tuple[str, ...] = ("top",)
    """Names."""
    inner: Inner = field(default_factory=Inner)
    """A stage's."""


@pytest.fixture
def fake(monkeypatch):
    """A module with ``Settings`` and a ``run`` behind ``recon fake it``; returns its namespace."""
    module = SimpleNamespace(__name__="fake", Settings=Settings, run=lambda config: config.photo)
    monkeypatch.setitem(sys.modules, "fake", module)
    monkeypatch.setitem(cli.COMMANDS, "fake it", cli.Command("fakes", "fake", "Settings", "run", words="photo"))
    return module


def test_help_and_version_import_nothing_heavy():
    code = (
        "import sys; from pipelines import cli; cli.main(['--help']); cli.main(['--version']); cli.main(['nothing']);"
        "print([m for m in ('torch', 'numpy', 'tyro', 'cv2', 'mitsuba', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.rstrip().endswith("[]")
    assert all(f"recon {name} " in done.stdout for name in cli.COMMANDS)
    assert f"recon {recon.__version__}" in done.stdout
    assert done.stderr == f"recon: nothing: no such command; wanted one of {', '.join(cli.COMMANDS)} (recon --help)\n"


def test_no_words_show_the_help_as_a_mistake(capsys):
    assert cli.main([]) == 2
    assert "recon photo" in capsys.readouterr().out


def test_settings_reach_the_function(fake, capsys):
    seen = []
    fake.run = seen.append
    words = ["fake", "it", "a.jpg", "--garments", "jacket,top", "trousers,top", "--inner.steps", "7"]
    assert cli.main(words) == 0
    assert seen == [Settings(Path("a.jpg"), ("jacket", "top", "trousers"), Inner(7))]


def test_what_comes_back_is_printed_or_is_the_exit_code(fake, capsys):
    assert cli.main(["fake", "it", "a.jpg"]) == 0
    assert capsys.readouterr().out == "a.jpg\n"
    fake.run = lambda config: 1
    assert cli.main(["fake", "it", "a.jpg"]) == 1


def test_a_users_mistake_is_one_line_and_exit_code_2(fake, capsys):
    def run(config):
        raise UserError(f"{config.photo}: not an\nimage; wanted one")

    fake.run = run
    assert cli.main(["fake", "it", "a.jpg"]) == 2
    said = capsys.readouterr()
    assert said.err == "recon: a.jpg: not an image; wanted one\n" and said.out == ""


def test_interrupted_it_says_how_to_go_on(fake, capsys):
    def run(config):
        raise KeyboardInterrupt

    fake.run = run
    assert cli.main(["fake", "it", "a.jpg"]) == 130
    assert "resume with the same command" in capsys.readouterr().err


def test_a_bug_keeps_its_traceback(fake):
    def run(config):
        raise RuntimeError("ours")

    fake.run = run
    with pytest.raises(RuntimeError):
        cli.main(["fake", "it", "a.jpg"])


@pytest.mark.parametrize("words", [["fake", "it"], ["fake", "it", "a.jpg", "--nonsense", "1"]])
def test_wrong_settings_exit_with_2(fake, words, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2


@pytest.mark.parametrize("name", [name for name, command in cli.COMMANDS.items() if command.config])
def test_every_commands_settings_can_be_read(name, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([*name.split(), "--help"])
    assert stop.value.code == 0
    assert f"recon {name}" in capsys.readouterr().out


def test_photo_mistakes_before_anything_is_written(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["photo", str(tmp_path / "none.jpg"), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "none.jpg" in said and said.count("\n") == 1 and not out.exists()


def test_the_doctor_finds_this_installation_in_order(capsys):
    code = doctor.main()
    out = capsys.readouterr().out
    assert code == 0, out
    for what in ("torch", "LLVM", "weights", "body anny", "pose_detection.tflite", "cpu", "gpu"):
        assert what in out


def test_the_doctor_says_what_to_do(monkeypatch, capsys):
    def broken():
        yield doctor.Finding("here", "fine")
        raise OSError("disk on fire\nsecond line")

    monkeypatch.setattr(doctor, "_body", broken)
    monkeypatch.setattr(doctor, "_renderer", lambda: iter([doctor.Finding("renderer", "[bad]", "do this")]))
    monkeypatch.setattr(doctor, "_weights", lambda: iter([]))
    assert doctor.main() == 1
    out = capsys.readouterr().out
    assert "renderer: [bad]\n  -> do this" in out and "OSError: disk on fire\n  -> install again" in out
    assert out.rstrip().endswith("2 wrong")


def test_the_doctor_survives_an_llvm_that_kills(monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so")
    (finding,) = doctor._renderer()
    assert finding.advice and "/nowhere/libLLVM.so" in finding.found + finding.advice


def test_the_doctor_tells_corrupt_weights(monkeypatch, tmp_path):
    from recon.files import weights

    monkeypatch.setattr(weights, "PACKAGED", tmp_path)
    findings = list(doctor._weights())
    assert findings and all(finding.advice for finding in findings)
