# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a photo to garments with their sewing patterns
#
# The same functions as `recon photo`, step by step. Open it with `jupytext --to ipynb notebooks/01_fit_photo.py` and
# Jupyter, or run it as a script. With `GARMENT_RECON_NOTEBOOK=quick` (as in CI) it takes few steps at low resolution:
# everything runs, nothing converges.

# %%
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

import recon
from pipelines.fit_body import BodyFit
from pipelines.fit_garment import GarmentFit
from pipelines.photo import PhotoFit, fit_photo
from pipelines.refine import Refinement

QUICK = os.environ.get("GARMENT_RECON_NOTEBOOK") == "quick"
REPOSITORY = Path(recon.__file__).parent.parent

# %% [markdown]
# ## Settings
#
# One frozen dataclass holds them all; the command line reads the same one. A result folder belongs to one photo and one
# set of garments: run the next cells again and the stages are taken from there, change a setting and what depends on it
# is computed again.

# %%
config = PhotoFit(
    photo=REPOSITORY / "examples" / "photos" / "man-hoodie-trousers.jpg",
    garments=("top", "trousers"),
    out=Path(tempfile.mkdtemp()) / "hoodie" if QUICK else REPOSITORY / "out" / "notebook",
)
if QUICK:
    body, refinement = BodyFit(), Refinement()
    config = replace(
        config,
        body_fit=replace(
            body, posing=replace(body.posing, steps=12), shaping=replace(body.shaping, steps=4), long_side=96
        ),
        garment_fit=GarmentFit(
            levels=((64, 4),),
            resolution=48,
            final_resolution=64,
            retrieval_resolution=32,
            retrieval_pixels=48,
            starts=1,
        ),
        refinement=replace(
            refinement,
            dressing=replace(refinement.dressing, frames=8),
            settle=5,
            rounds=1,
            steps=4,
            long_side=96,
        ),
    )

# %% [markdown]
# ## What the photo shows
#
# Perception finds the person, splits the named garments and says how far each mask can be trusted. Your own masks
# (`PhotoFit.masks`) take its place.

# %%
from recon.files.photos import read_photo  # noqa: E402
from recon.perceive import perceive  # noqa: E402

photo = perceive(read_photo(config.photo), config.garments)
fig, axes = plt.subplots(1, 1 + len(photo.garments), figsize=(4 * (1 + len(photo.garments)), 5))
axes[0].imshow(photo.rgb)
axes[0].plot(*photo.landmarks[photo.landmarks[:, 2] > 0.5, :2].T, "w.", ms=4)
axes[0].set_title("photo and landmarks")
for axis, (name, mask) in zip(axes[1:], photo.garments.items()):
    axis.imshow(photo.rgb * mask[..., None])
    axis.set_title(f"{name}, confidence {photo.confidence.get(name, float('nan')):.2f}")
for axis in axes:
    axis.axis("off")

# %% [markdown]
# ## The fit
#
# Body and camera; each garment, from the outermost inwards; then all of them as cloth. The files are those of
# `recon photo`.

# %%
result = fit_photo(config, say=lambda stage, event, seconds: event == "done" and print(f"{stage}: {seconds:.1f} s"))
for name, found in result.figures["garments"].items():
    print(name, {key: value for key, value in found.items() if key in ("iou", "penetrating_vertices", "stretch_p95")})
print(sorted(path.name for path in result.folder.iterdir()))

# %%
fig, axes = plt.subplots(2, 1, figsize=(12, 9), height_ratios=(2, 1))
for axis, name in zip(axes, ("overlay", "turntable")):
    axis.imshow(plt.imread(result.folder / f"{name}.png"))
    axis.axis("off")

# %% [markdown]
# ## The sewing patterns
#
# Every corner of a garment's triangles knows its place on a flat panel. `patterns/*.svg` holds the same at true scale.

# %%
fig, axes = plt.subplots(1, len(result.layers), figsize=(6 * len(result.layers), 5), squeeze=False)
for axis, layer in zip(axes[0], result.layers):
    garment = layer.garment
    for panel, colour in ((0, "tab:blue"), (1, "tab:orange")):
        faces = garment.panel_faces[garment.panel_of_face == panel]
        axis.triplot(*garment.panel_points.T, faces, color=colour, lw=0.2)
    axis.set(aspect="equal", title=f"{layer.name}: front blue, back orange [m]")

# %% [markdown]
# ## Checks
#
# What must hold whatever the photo: finite meshes, welded and open, and not one vertex inside the body.

# %%
for name, mesh in result.garments.items():
    assert mesh.vertices.isfinite().all()
    assert mesh.faces.max() < len(mesh.vertices)
    if not QUICK:
        assert result.figures["garments"][name]["penetrating_vertices"] == 0
