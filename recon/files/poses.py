"""A body's pose from a user's file."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.types import UserError


def read_pose(path: str | Path) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Pose (24, 3) [rad], and where the file has them shape (S,) and translation (3,) [m].

    An npz or json with ``pose`` (24, 3) or (72,) in the rig's joint order, as ``result.json`` has it under
    ``body_model``. UserError: no such file, another format, no pose, numbers that are not finite.
    """
    path = Path(path)
    wanted = "wanted an npz or json with pose (24, 3) in radians"
    if not path.is_file():
        raise UserError(f"{path}: no such file; {wanted}")
    try:
        data = _read(path)
        pose = np.asarray(data["pose"], np.float32).reshape(24, 3)
        rest = [np.asarray(data[k], np.float32).reshape(-1) if k in data else None for k in ("shape", "translation")]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: holds no pose ({type(error).__name__}); {wanted}") from None
    shape, place = rest
    if place is not None and place.shape != (3,):
        raise UserError(f"{path}: translation has {place.size} numbers; wanted 3, in metres")
    if not all(np.isfinite(v).all() for v in (pose, shape, place) if v is not None):
        raise UserError(f"{path}: has numbers that are NaN or infinite; {wanted}")
    tensors = [None if v is None else torch.from_numpy(v) for v in (shape, place)]
    return torch.from_numpy(pose), tensors[0], tensors[1]


def _read(path: Path) -> dict:
    if path.suffix.lower() == ".json":
        import json

        data = json.loads(path.read_text())
        return data.get("body_model", data)
    with np.load(path, allow_pickle=False) as file:
        return {k: file[k] for k in file.files}
