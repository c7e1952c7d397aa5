"""Point clouds from files: PLY, NPY, XYZ."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.types import UserError

READABLE = ("ply", "npy", "xyz", "txt")


def read_points(path: str | Path) -> Tensor:
    """Points (N, 3) float32 [m] of a PLY file, of a NumPy array (N, 3+), or of text with x y z at each line's start.

    Raises:
        UserError: missing, another format, unreadable, fewer than 30 points, or not finite.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if not path.is_file():
        raise UserError(f"{path}: no such file; wanted points ({', '.join(READABLE)})")
    if kind not in READABLE:
        raise UserError(f"{path}: a .{kind} file; wanted points ({', '.join(READABLE)})")
    try:
        found = _read(path, kind)
    except Exception as error:  # whatever a parser raises on a broken file is the file's fault
        raise UserError(f"{path}: cannot be read as {kind} ({type(error).__name__}); wanted points") from None
    if found.ndim != 2 or found.shape[1] < 3 or len(found) < 30:
        raise UserError(f"{path}: an array of shape {found.shape}; wanted at least 30 points (N, 3)")
    points = torch.as_tensor(np.array(found[:, :3], np.float32))
    if not points.isfinite().all():
        raise UserError(f"{path}: has points that are NaN or infinite; wanted numbers in metres")
    return points


def _read(path: Path, kind: str) -> np.ndarray:
    if kind == "npy":
        return np.asarray(np.load(path, allow_pickle=False), float)
    if kind == "ply":
        import trimesh

        return np.asarray(trimesh.load(io.BytesIO(path.read_bytes()), file_type="ply", process=False).vertices, float)
    return np.loadtxt(path, comments=("#", "//"), ndmin=2)
