"""Learned weights: one safetensors file per network and one ``manifest.json`` with a card for each.

The shipped weights lie in the package (``recon/weights``); a user's own training writes such a folder anywhere.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import tempfile
from collections.abc import Collection
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor

from recon.files.atomic import write_whole
from recon.types import UserError

PACKAGED = Path(__file__).resolve().parent.parent / "weights"
"""The weights that come with the project."""

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Weights:
    """Tensors of one network and the card that says what they are."""

    name: str
    tensors: dict[str, Tensor]
    card: dict[str, Any]
    """JSON: data, seed, steps, time, machine, metrics, licence, and what the builder needs to rebuild the network."""


def read_weights(name: str, folder: str | Path | None = None, device: str | torch.device = "cpu") -> Weights:
    """The weights called ``name`` from ``folder`` (the packaged ones if None); floats come back as float32.

    Raises:
        UserError: no manifest, no such name (those that exist are listed), file missing, or content not as recorded.
    """
    folder = Path(folder) if folder is not None else PACKAGED
    cards = read_manifest(folder)
    if name not in cards:
        known = ", ".join(sorted(cards)) or "nothing"
        raise UserError(f"{folder / MANIFEST}: no weights called {name}; it lists {known}")
    card = cards[name]
    path = folder / str(card.get("file", f"{name}.safetensors"))
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: weights of {name} can't be read ({error.strerror}); train or install them") from error
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        raise UserError(f"{path}: content does not match {MANIFEST} (sha256); fetch or train the weights again")
    tensors = load(data)
    to_float = {k: v.float() if v.is_floating_point() else v for k, v in tensors.items()}
    return Weights(name, {k: v.to(device) for k, v in to_float.items()}, card)


def read_manifest(folder: str | Path | None = None) -> dict[str, dict[str, Any]]:
    """All cards of a weights folder by name; {} where the folder has no manifest.

    Raises:
        UserError: the manifest is no JSON object of cards.
    """
    path = (Path(folder) if folder is not None else PACKAGED) / MANIFEST
    if not path.is_file():
        return {}
    try:
        cards = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(cards, dict) or not all(isinstance(c, dict) for c in cards.values()):
            raise ValueError("not an object of cards")
    except ValueError as error:
        raise UserError(f"{path}: not a weights manifest ({error})") from error
    return cards


def folder_with(prefix: str, folder: str | Path | None) -> Path | None:
    """The user's folder, if it lists weights whose names begin so; else None, which stands for those that ship.

    UserError: as :func:`read_manifest`.
    """
    own = folder is not None and any(name.startswith(prefix) for name in read_manifest(folder))
    return Path(folder) if folder is not None and own else None


def write_weights(
    name: str,
    tensors: dict[str, Tensor],
    card: dict[str, Any],
    folder: str | Path,
    dtype: torch.dtype = torch.float16,
    exact: Collection[str] = (),
) -> Path:
    """Write ``name.safetensors`` (floats as ``dtype``) and enter its card in the manifest; both whole or not at all.

    Replaces weights of the same name, leaves the others as they are; several processes may write to one folder.
    Tensors named in ``exact`` keep their own type: places in metres need more digits than weights.
    """
    folder = Path(folder)
    stored = {
        k: v.detach().cpu().to(dtype if v.is_floating_point() and k not in exact else v.dtype).contiguous()
        for k, v in tensors.items()
    }
    bad = [k for k, v in stored.items() if v.is_floating_point() and not v.isfinite().all()]
    if bad:
        raise ValueError(f"{name}: {bad[0]} is not finite in {dtype}")
    data = save(stored)
    path = folder / f"{name}.safetensors"
    write_whole(path, data)
    entry = {**card, "file": path.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    with _locked(folder):
        cards = {**read_manifest(folder), name: entry}
        text = json.dumps(dict(sorted(cards.items())), indent=1, allow_nan=False, ensure_ascii=False)
        write_whole(folder / MANIFEST, text + "\n")
    return path


@contextmanager
def _locked(folder: Path):
    """One writer of the manifest at a time."""
    key = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
    with open(Path(tempfile.gettempdir()) / f"garment-recon-{key}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
