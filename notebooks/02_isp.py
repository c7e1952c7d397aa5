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
# # Implicit sewing patterns
#
# A garment is two flat panels, and a map that lifts them into space; both are networks of one latent code (ISP, Li et
# al. 2023). So a code can be decoded at any resolution, found from what is known of a garment, mixed with another, and
# edited through its flat pattern.

# %%
import os
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from pipelines.edit import Edit, edit
from pipelines.fit_code import CodeFit, find_code
from pipelines.fit_evidence import Bank, PatternEvidence, SurfaceEvidence
from recon.bodies import load_body
from recon.files.codes import read_code
from recon.garments.dataset import load_garments
from recon.garments.isp import load_isp
from recon.garments.outlines import panel_loops
from recon.garments.sewing import is_manifold
from recon.garments.textures import Sheet, colours_at, unsewn
from recon.metrics import boundary_loops, compare_meshes, panel_iou, sample_surface
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Mesh

QUICK = os.environ.get("GARMENT_RECON_NOTEBOOK") == "quick"
torch.set_grad_enabled(False)
search = CodeFit(starts=1, rounds=1, steps=4) if QUICK else CodeFit()
size, look = ((120, 120), Look(samples=1, sky_rays=1, lamp_rays=1)) if QUICK else ((420, 380), Look(samples=4))
out = Path("out/notebook-isp")

# %%
body = load_body()
person = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
tops = load_isp("top")


def show(garments, titles, colours=None):
    """Panels above, the garment on the neutral body below."""
    _, axes = plt.subplots(2, len(garments), figsize=(3.2 * len(garments), 5.4), squeeze=False)
    for k, (garment, title) in enumerate(zip(garments, titles)):
        for panel, loops in enumerate(panel_loops(garment)):
            for loop in loops:
                axes[0, k].fill(loop[:, 0] + 1.5 * panel, loop[:, 1], fc="#c7d8ec", ec="#27466b")
        mesh = unsewn(garment)
        colour = colours[k] if colours else (0.27, 0.51, 0.76)
        image = picture([person, mesh], [(0.86, 0.69, 0.58), colour], orbit_camera([person], 0.2, 0.0, size), look=look)
        axes[1, k].imshow(image)
        axes[0, k].set(title=title, aspect="equal")
    for axis in axes.flat:
        axis.axis("off")
    plt.show()


# %% [markdown]
# ## Codes between codes
#
# Half way from a closed shirt to an open jacket the topology changes, and the garment stays sewn.

# %%
ends = tops.codes[tops.variants.index("shirt")], tops.codes[tops.variants.index("jacket")]
shares = (0.0, 1.0) if QUICK else (0.0, 0.3, 0.5, 0.7, 1.0)
between = [tops.decode(torch.lerp(*ends, share), 64 if QUICK else 128) for share in shares]
for garment in between:
    assert is_manifold(garment.mesh.faces.numpy())
show(between, [f"{boundary_loops(g.mesh.faces)} open borders" for g in between])

# %% [markdown]
# ## The code of a garment that the decoder never saw
#
# From its flat pattern, and from 300 points of its surface. `recon decode skirt --fit scan.ply` does this for files.

# %%
skirts = load_isp("skirt")
truth = load_garments("skirt", "test")[2]
pattern = PatternEvidence.of(skirts, truth)
points = SurfaceEvidence(skirts, sample_surface(truth.mesh, 300, torch.Generator().manual_seed(0))[0])
starts = {"pattern": pattern.starts(), "points": points.starts(Bank(skirts, 4 if QUICK else 40))}
found = []
for name, evidence in (("pattern", pattern), ("points", points)):
    latent = find_code(skirts, evidence, skirts.codes[starts[name]], search).latent
    found.append(skirts.decode(latent, 96))
    errors = compare_meshes(found[-1].mesh, truth.mesh, torch.Generator().manual_seed(0), 3000)
    print(f"from its {name}: {errors['surface_mm']:.2f} mm off, panel IoU {panel_iou(found[-1], truth):.3f}")
show([truth, *found], ["truth", "from the pattern", "from points"])

# %% [markdown]
# ## Edited through the pattern (Eq. 12)
#
# The same as `recon edit top:0 --sleeve 0.6 --length 1.2 --open`; an SVG of the panels, edited elsewhere, does as well.

# %%
changes = Edit(("top:0",), out / "edited.obj", sleeve=0.6, length=1.2, open=True, resolution=96, search=search)
said = edit(replace(changes, code=out / "edited.json"))
edited = tops.decode(read_code(out / "edited.json", "top", tops.codes.shape[1]), 96)
print(f"the outline is met to {said['outline_mm']} mm; {said['open_borders']} open borders")
show([tops.decode(tops.codes[0], 96), edited], ["top:0", "edited"])

# %% [markdown]
# ## A texture drawn on the panels
#
# Panels of all tops share one plane: a drawing for one is a drawing for all.

# %%
sheet = Sheet.of(tops.nets.shape)
stripes = np.ones((256, 512, 3), np.float32)
stripes[(np.arange(256) // 10) % 2 == 0] = (0.75, 0.25, 0.25)
garments = [edited, tops.decode(ends[1], 96 if QUICK else 200), tops.decode(ends[0], 96 if QUICK else 200)]
show(
    garments, ["edited", "jacket", "shirt"], [colours_at(torch.tensor(stripes), sheet.coordinates(g)) for g in garments]
)
