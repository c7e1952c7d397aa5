"""Latent codes on disk: a small JSON file that says which decoder it belongs to."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import Tensor

from recon.files.atomic import write_whole
from recon.types import UserError


def write_code(path: str | Path, kind: str, latent: Tensor, decoder: str = "isp") -> None:
    """Write a code (z,) of the ``decoder`` of ``kind``; NaN or infinity is a ValueError."""
    if latent.dim() != 1 or not latent.isfinite().all():
        raise ValueError(f"code of shape {tuple(latent.shape)}: wanted one finite code (z,)")
    values = [round(v, 7) for v in latent.detach().cpu().double().tolist()]
    write_whole(path, json.dumps({"decoder": decoder, "kind": kind, "latent": values}) + "\n")


def read_code(path: str | Path, kind: str, size: int, decoder: str = "isp") -> Tensor:
    """The code (size,) float32 of a file that ``write_code`` wrote, or of a plain JSON list of numbers.

    Raises:
        UserError: missing, no such JSON, of another kind or decoder, of another length, or not finite.
    """
    path = Path(path)
    wanted = f"wanted a code of kind {kind}: {size} numbers"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror}); {wanted}") from None
    except ValueError:
        raise UserError(f"{path}: no JSON; {wanted}") from None
    if isinstance(found, dict):
        if found.get("kind", kind) != kind:
            raise UserError(f"{path}: a code of kind {found['kind']}; {wanted}")
        if found.get("decoder", decoder) != decoder:
            raise UserError(f"{path}: a code of decoder {found['decoder']}; {wanted} for decoder {decoder}")
        found = found.get("latent")
    if not isinstance(found, list) or not all(type(v) in (int, float) for v in found):
        raise UserError(f"{path}: no list of numbers; {wanted}")
    if len(found) != size:
        raise UserError(f"{path}: {len(found)} numbers; {wanted}")
    code = torch.tensor(found, dtype=torch.float32)
    if not code.isfinite().all():
        raise UserError(f"{path}: numbers that are NaN or infinite; {wanted}")
    return code
