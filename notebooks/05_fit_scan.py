# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a labelled scan to garments
#
# A scan whose points are labelled (skin, top, trousers) gives the body under the clothes, the garments' codes, and then
# the garments themselves as cloth at rest under the scan (DrapeNet, §4.4, Eq. 13 and 16). The example is a made one, so
# the truth is known: noise of 1.5 mm, holes, and nothing beneath the outer surface.

# %%
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from IPython.display import Image

from pipelines.fit_scan_body import ScanBodyFit
from pipelines.fit_scan_garment import ScanGarmentFit
from pipelines.refine import Refinement
from pipelines.refine_scan import ScanRefinement
from pipelines.scan import ScanFit, fit_scan
from recon.bodies import load_body
from recon.descend import Descent
from recon.draping.dress import Dressing
from recon.types import BodyPose

QUICK = os.environ.get("GARMENT_RECON_NOTEBOOK") == "quick"
root = Path.cwd() if Path("examples").is_dir() else Path.cwd().parent
scan = root / "examples/scans/top-trousers.npz"
out = Path("out/notebook-scan")

# %% [markdown]
# `recon scan examples/scans/top-trousers.npz --garments top,trousers --out out/scan` does the same. PLY, OBJ, GLB and
# STL files do as well; labels may be a property of the PLY file, or lie beside the scan: `--labels labels.npz`.

# %%
config = ScanFit(scan=scan, garments=("top", "trousers"), out=out)
if QUICK:
    short = Descent(steps=12, patience=12)
    config = replace(
        config,
        body_fit=ScanBodyFit(
            facings=4, arms=(45.0,), points=200, fine_points=500, kept=(4, 2, 1), finalists=1, coarse=short
        ),
        garment_fit=ScanGarmentFit(
            levels=((0.06, 32, 4),), points=300, final_resolution=36, retrieval_round=6, starts=1, body_points=200
        ),
        refinement=ScanRefinement(
            Refinement(Dressing(frames=8, steps=6), gradings=0, settle=4, steps=6, untangling=5), points=500
        ),
    )
shutil.rmtree(out, ignore_errors=True)
result = fit_scan(config, say=lambda stage, event, seconds: print(f"{stage:<10} {event:<6} {seconds:6.1f} s"))

# %% [markdown]
# The scan, and body and garments from the same side.

# %%
Image(result.folder / "overlay.png")

# %%
Image(result.folder / "turntable.png")

# %% [markdown]
# How far the garments are from their points, by their codes alone and after refinement.

# %%
for name, found in result.figures["garments"].items():
    print(
        f"{name}: {found['scan_mm']:.1f} mm ({found['scan_mm_code_only']:.1f} by its code), "
        f"{found['penetrating_vertices']} vertices inside the body, {found['self_intersections']} self-intersections"
    )

# %% [markdown]
# And the body under the clothes against the true one, which the fit has never seen.

# %%
body = load_body()
with np.load(scan) as data:
    true = {k: torch.tensor(data[f"body_{k}"])[None] for k in ("shape", "pose", "translation")}
truth = body.pose(BodyPose(**true)).mesh.vertices[0]
truth = truth - (truth.mean(0) - result.body.vertices.mean(0))  # results stand at the origin
away = (result.body.vertices - truth).norm(dim=1)
print(f"body: {1e3 * away.median():.0f} mm (median of its vertices)")
assert QUICK or away.median() < 0.03
