"""A run and its stages: state on disk, so that a killed run goes on and a changed setting redoes what it touches."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch

import recon
from recon.files.atomic import temporary, write_whole
from recon.files.state import canonical, decode, digest, encode
from recon.types import UserError

Value = TypeVar("Value")

Say = Callable[[str, str, float], None]
"""Hears (stage, event, seconds) of every stage's start and end."""

_SCHEMA = 1


def _silent(stage: str, event: str, seconds: float) -> None:
    """Say nothing."""


class Run:
    """One run's output folder.

    A stage's state is ``stages/<name>.safetensors``, then ``stages/<name>.json`` (written last: its presence means
    that the tensors are whole). Its key is a digest chained over the evidence, the version, and every stage's name
    and config so far: what was computed from other things is computed again, and so is all that follows it.
    """

    def __init__(
        self,
        folder: str | Path,
        identity: Mapping[str, Any],
        evidence: Mapping[str, Any] | None = None,
        device: str | torch.device = "cpu",
        say: Callable[[str, str, float], None] = _silent,
    ) -> None:
        """Open ``folder`` for the run that ``identity`` names (made where it is missing).

        ``identity`` (JSON-able) says whose result the folder holds (the photo's digest, the garments' names): one
        with another identity, or with files that no run wrote, is a UserError and nothing in it changes. ``evidence``
        is everything else that the result depends on besides the stages' configs (digests of masks, weights, body
        file): it may change, and then the stages are redone. Loaded tensors go to ``device``. ``say(stage, event,
        seconds)`` hears of progress; events are "start", "kept" and "done".
        """
        self.folder = Path(folder)
        self.device = device
        self.seconds: dict[str, float] = {}
        """Stage name -> seconds that computing it took, now or in the run that it was kept from."""
        self.kept: list[str] = []
        """Names of the stages that were taken over from an earlier run."""
        self._say = say
        self._claim(json.loads(json.dumps(dict(identity))))
        self._key = digest(
            "run", str(_SCHEMA), recon.__version__, canonical(dict(identity)), canonical(dict(evidence or {}))
        )

    def _claim(self, identity: dict[str, Any]) -> None:
        """Make the folder this run's, or say why it can't be."""
        mark = self.folder / "run.json"
        if self.folder.exists() and not self.folder.is_dir():
            raise UserError(f"{self.folder}: is a file; wanted a folder for the results (another --out)")
        if mark.is_file():
            theirs = _read_json(mark).get("identity")
            if theirs != identity:
                other = [k for k in identity if not isinstance(theirs, dict) or theirs.get(k) != identity[k]]
                other = other or [k for k in theirs or {} if k not in identity]
                raise UserError(
                    f"{self.folder}: holds the result of another run (its {', '.join(other)} differ); wanted an "
                    "empty or new folder, or the one of this run (another --out)"
                )
        elif self.folder.is_dir() and any(child.name != temporary(mark).name for child in self.folder.iterdir()):
            raise UserError(
                f"{self.folder}: holds files that no run wrote; wanted an empty or new folder (another --out)"
            )
        else:
            try:
                text = json.dumps({"schema": _SCHEMA, "identity": identity, "version": recon.__version__}, indent=1)
                write_whole(mark, text + "\n")
            except OSError as error:
                raise UserError(
                    f"{self.folder}: cannot be written ({error.strerror}); wanted a writable folder"
                ) from None

    def stage(self, name: str, fn: Callable[..., Value], *args: Any, config: Any = None) -> Value:
        """``fn(*args)``, or ``fn(*args, config)`` where a config is given, computed once and kept on disk.

        What ``fn`` depends on must be earlier stages' results, the run's identity and evidence, or ``config`` (a
        dataclass or anything else that ``encode`` takes): only those make its key. The same value comes back whether
        it was computed or kept: tensors are detached and lie on the run's device.
        """
        self._key = digest(self._key, name, canonical(config))
        kept = self._load(name)
        if kept is not None:
            seconds, description, tensors = kept
            self.kept.append(name)
            self._say(name, "kept", seconds)
        else:
            self._say(name, "start", 0.0)
            begin = time.perf_counter()
            description, tensors = encode(fn(*args) if config is None else fn(*args, config))
            seconds = time.perf_counter() - begin
            self._save(name, seconds, description, tensors)
            self._say(name, "done", seconds)
        self.seconds[name] = seconds
        return decode(description, tensors, self.device)

    def _paths(self, name: str) -> tuple[Path, Path]:
        folder = self.folder / "stages"
        return folder / f"{name}.safetensors", folder / f"{name}.json"

    def _load(self, name: str) -> tuple[float, Any, dict[str, torch.Tensor]] | None:
        """The stage's state where it is there, whole, and made from the same things."""
        tensors_at, card_at = self._paths(name)
        card = _read_json(card_at)
        if card.get("key") != self._key:
            return None
        try:
            data = tensors_at.read_bytes()
        except OSError:
            return None
        if digest(data) != card.get("tensors"):
            return None
        return card["seconds"], card["state"], safetensors.torch.load(data)

    def _save(self, name: str, seconds: float, description: Any, tensors: dict[str, torch.Tensor]) -> None:
        tensors_at, card_at = self._paths(name)
        data = safetensors.torch.save(tensors)
        card_at.unlink(missing_ok=True)
        write_whole(tensors_at, data)
        card = {"key": self._key, "seconds": seconds, "tensors": digest(data), "state": description}
        write_whole(card_at, json.dumps(card) + "\n")


def _read_json(path: Path) -> dict[str, Any]:
    """The file's object; an empty one where it is missing or broken."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
