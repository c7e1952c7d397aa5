"""Whole files or none: write beside the target, flush to the disk, rename."""

from __future__ import annotations

import os
from pathlib import Path


def temporary(path: Path) -> Path:
    """Where ``write_whole`` builds a file: always the same name, so that what a kill leaves behind is written over."""
    return path.with_name(f".{path.name}.tmp")


def write_whole(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` to ``path`` so that, killed at any moment, the path holds the old content or the new one.

    Text is written as UTF-8. Missing parent folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = temporary(path)
    try:
        with open(beside, "wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
