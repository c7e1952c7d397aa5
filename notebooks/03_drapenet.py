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
# # Draping any garment with DrapeNet
#
# One network drapes tops and dresses, another trousers and skirts, vertex by vertex: whatever mesh, from whichever
# decoder or none (De Luigi et al. 2023, §3.2). They learned from physics alone, without a simulated drape.

# %%
import os
from pathlib import Path

import torch
from IPython.display import Image, display

from recon.bodies import load_body
from recon.bodies.pose_prior import sample_poses
from recon.cloth.contact import BodyContact
from recon.draping.drapenet import load_drapenet
from recon.draping.skinning import SkinningDraper
from recon.files.weights import read_manifest
from recon.garments.dataset import load_garments
from recon.metrics import inside_pct
from recon.render.shade import Look, orbit_camera, picture
from recon.types import BodyPose, Garment, Mesh

QUICK = os.environ.get("GARMENT_RECON_NOTEBOOK") == "quick"
out = Path("out/notebook-drapenet")
out.mkdir(parents=True, exist_ok=True)
body = load_body()
draper, skinning = load_drapenet(body), SkinningDraper(body)
for part, card in read_manifest()["drapenet"]["parts"].items():
    print(f"{part}: learned for {card['minutes']} minutes, {card['steps']} steps")

# %% [markdown]
# A garment of the test split, which no training saw, and a body in a random pose.

# %%
generator = torch.Generator().manual_seed(3)
shape = torch.randn(1, body.n_shape, generator=generator).clamp(-2, 2)
posed = body.pose(BodyPose(shape, sample_poses(1, generator), torch.zeros(1, 3)))
top = min(load_garments("top", "test"), key=lambda g: float(g.mesh.vertices[:, 1].min()))
trousers = max(load_garments("trousers", "test"), key=lambda g: float(g.mesh.vertices[:, 1].max()))
skin = Mesh(posed.mesh.vertices[0], body.faces)
contact = BodyContact(skin.vertices, body.faces)
with torch.no_grad():
    for name, way in (("skinning", skinning), ("DrapeNet", draper)):
        worn = [way.drape(g, posed) for g in (top, trousers)]
        inside = [inside_pct(m.with_vertices(m.vertices[0]), contact) for m in worn]
        print(f"{name}: {inside[0]:.2f} % of the top and {inside[1]:.2f} % of the trousers inside the body")

# %% [markdown]
# Top over bottom: the intersection solver draws the trousers under the top (Eq. 9), and the top ends above them.

# %%
size = (240, 160) if QUICK else (640, 420)


def show(name: str, *garments: Mesh) -> None:
    meshes = [skin, *garments]
    colours = [(0.80, 0.66, 0.57), (0.36, 0.53, 0.76), (0.42, 0.42, 0.50)][: len(meshes)]
    view = picture(meshes, colours, orbit_camera(meshes, 0.4, 0.1, size), size, Look(samples=4, sky_rays=4))
    import cv2

    cv2.imwrite(str(out / f"{name}.png"), view.cpu().numpy()[..., ::-1])
    display(Image(out / f"{name}.png"))


with torch.no_grad():
    upper, lower = (m.with_vertices(m.vertices[0]) for m in draper.outfit(top, trousers, posed))
show("outfit", upper, lower)

# %% [markdown]
# The network's code comes from the mesh itself: a garment cut in two, or refined, is draped alike.

# %%
faces = top.mesh.faces
half = Garment.bare("top", Mesh(top.mesh.vertices, faces[top.mesh.vertices[faces].mean(1)[:, 0] > 0]))
with torch.no_grad():
    show("half", (m := draper.drape(half, posed)).with_vertices(m.vertices[0]))
    codes = torch.stack([draper.nets.code(g.mesh) for g in load_garments("top", "test")[:6]])
print("distances between the codes of six tops:\n", torch.cdist(codes, codes).round(decimals=1))
