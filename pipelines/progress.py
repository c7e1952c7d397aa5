"""Progress of a run on stderr: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn


class Progress:
    """Shows stages and the steps inside them; use it as a context."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(file=sys.stderr, highlight=False)
        columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
        self._bar = Bar(*columns, console=self._console, transient=True, disable=not self._console.is_terminal)
        self._stage, self._task = "", None if not self._console.is_terminal else self._bar.add_task("starting")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bar.stop()

    def say(self, stage: str, event: str, seconds: float) -> None:
        """A stage began ("start"), ended ("done") or was taken over from an earlier run ("kept")."""
        self._stage = "results" if event == "done" else stage
        if self._task is not None:
            self._bar.reset(self._task, description=self._stage)
        if event != "start":
            how = " (kept from an earlier run)" if event == "kept" else ""
            self._console.print(f"{stage:<12} {seconds:6.1f} s{how}")

    def tick(self, step: int, loss: float) -> None:
        """A step inside the stage under way."""
        if self._task is not None:
            self._bar.update(self._task, description=f"{self._stage}  step {step}  loss {loss:.4f}")
