"""The one training loop: by the clock or by steps, logged, and resumable after a kill."""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn

from recon.types import UserError

SAVE_EVERY = 60.0
"""Training seconds between checkpoints."""
LOG_EVERY = 100
"""Steps from one line of the log to the next."""


@dataclass(frozen=True)
class Budget:
    """How long a training lasts."""

    minutes: float
    """Training time; 0 = none, without ``steps``."""
    steps: int = 0
    """So many steps instead; 0 = by the clock."""


FREE = ("out", "minutes", "steps", "threads")
"""Settings that may change between a checkpoint and what goes on from it."""


def settings_of(config: Any, free: Collection[str] = (), **more: Any) -> str:
    """What a checkpoint must agree with: all settings but ``FREE`` and ``free``, and ``more``."""
    kept = {k: str(v) for k, v in asdict(config).items() if k not in (*FREE, *free)}
    return json.dumps({**kept, **more}, sort_keys=True)


def curve(log: Path, points: int = 8) -> list[dict[str, float]]:
    """What is learned against time: evenly spaced lines of a log's last training, seconds as minutes; [] = no log."""
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    begun = max((k for k, line in enumerate(lines) if line["step"] == LOG_EVERY), default=0)
    lines = list({line["step"]: line for line in lines[begun:]}.values())  # a resumed training says some steps twice
    chosen = sorted({round((k + 1) * len(lines) / points) - 1 for k in range(points)} - {-1})
    return [
        {"minutes": round(lines[k]["seconds"] / 60, 1)}
        | {name: float(f"{v:.3g}") for name, v in lines[k].items() if name not in ("step", "seconds")}
        for k in chosen
    ]


@dataclass
class Training:
    """A training under way: what learns, and how far it is."""

    name: str
    """Of the weights, and of log and checkpoint."""
    module: nn.Module
    """Everything that learns."""
    optimizer: torch.optim.Optimizer
    """Each group's ``lr`` is the rate at the start; it decays along a cosine."""
    settings: str
    """What a checkpoint must agree with to go on from it."""
    out: Path
    """Folder for log and checkpoint."""
    step: int = 0
    seconds: float = 0.0

    @property
    def checkpoint(self) -> Path:
        """The checkpoint's file."""
        return self.out / f"{self.name}.checkpoint"

    @property
    def log(self) -> Path:
        """The log's file: a line each ``LOG_EVERY`` steps."""
        return self.out / f"{self.name}.log.jsonl"

    def card(self, config: Any) -> dict[str, Any]:
        """What the card of every network says of its training; folders of this machine stay out of it."""
        told = {k: str(v) for k, v in asdict(config).items() if v is not None and not isinstance(v, Path)}
        return {
            "settings": told,
            "seed": config.seed,
            "steps": self.step,
            "minutes": round(self.seconds / 60, 1),
            "machine": f"{platform.machine()} CPU, {config.threads} threads, torch {torch.__version__}",
            "curve": curve(self.log),
        }

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        self.out.mkdir(parents=True, exist_ok=True)
        beside = self.checkpoint.with_suffix(".tmp")
        kept = {"module": self.module.state_dict(), "optimizer": self.optimizer.state_dict()}
        torch.save({**kept, "step": self.step, "seconds": self.seconds, "settings": self.settings}, beside)
        beside.replace(self.checkpoint)

    def resume(self) -> None:
        """Go on from the checkpoint, where there is one. UserError: it is of other settings, or unreadable."""
        if not self.checkpoint.is_file():
            return
        try:
            kept = torch.load(self.checkpoint, weights_only=True)
        except Exception as error:
            raise UserError(f"{self.checkpoint}: not a readable checkpoint; delete it to train anew") from error
        if kept.get("settings") != self.settings:
            raise UserError(f"{self.checkpoint}: checkpoint of other settings; finish that training or delete it")
        self.module.load_state_dict(kept["module"])
        self.optimizer.load_state_dict(kept["optimizer"])
        self.step, self.seconds = kept["step"], kept["seconds"]

    def run(self, budget: Budget, loss_of: Callable[[float], tuple[torch.Tensor, dict[str, float]]]) -> None:
        """Descend until the budget is spent, from where it stands; the checkpoint goes at the end.

        Args:
            budget: see :class:`Budget`.
            loss_of: share of the budget spent in [0, 1) -> loss and the terms to log.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        rates = [group.setdefault("first_lr", group["lr"]) for group in self.optimizer.param_groups]
        columns = TextColumn(self.name), BarColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}")
        saved, smooth = self.seconds, dict[str, float]()
        with open(self.log, "a") as log, Progress(*columns) as progress:
            bar = progress.add_task("train", total=1.0, note="")
            while (share := self._share(budget)) < 1:
                begun = time.perf_counter()
                rate = min(1.0, (self.step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * share) + 2e-3)
                for group, first in zip(self.optimizer.param_groups, rates, strict=True):
                    group["lr"] = first * rate
                terms = self._descend(*loss_of(share))
                self.step += 1
                self.seconds += time.perf_counter() - begun
                smooth = {k: 0.97 * smooth.get(k, v) + 0.03 * v for k, v in terms.items()}
                if self.step % LOG_EVERY == 0:
                    line = {"step": self.step, "seconds": round(self.seconds, 1), **smooth}
                    log.write(json.dumps(line) + "\n")
                    log.flush()
                if self.step % 10 == 0:
                    note = "  ".join(f"{k} {v:.3g}" for k, v in smooth.items())
                    progress.update(bar, completed=share, note=f"step {self.step}  {note}")
                if self.seconds - saved > SAVE_EVERY:
                    saved = self.seconds
                    self.save()
        self.checkpoint.unlink(missing_ok=True)

    def _share(self, budget: Budget) -> float:
        if budget.steps or not budget.minutes:
            return self.step / budget.steps if budget.steps else 1.0
        return self.seconds / (60 * budget.minutes)

    def _descend(self, loss: torch.Tensor, terms: dict[str, float]) -> dict[str, float]:
        """One step; a loss that is no number changes nothing."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        if bool(torch.isfinite(loss)) and bool(torch.isfinite(norm)):
            self.optimizer.step()
        return terms
