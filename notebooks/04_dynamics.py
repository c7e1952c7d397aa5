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
# # Garments in motion
#
# A network that learned from physics alone drapes a garment over a moving body (GAPS); the simulator drapes anything
# else; what passes through the body or another layer is drawn apart; and the solver brings cloth to rest.

# %%
import os
from pathlib import Path

import numpy as np
import torch
from IPython.display import Image

from pipelines.sequence import Animate, animate
from recon.bodies import load_body
from recon.bodies.poses import stroll
from recon.draping.binding import METHODS, BodyField
from recon.draping.gaps import load_gaps

QUICK = os.environ.get("GARMENT_RECON_NOTEBOOK") == "quick"
seconds = 0.3 if QUICK else 3.0
out = Path("out/notebook-dynamics")

# %% [markdown]
# A motion of our own. Any npz clip, AMASS file or BVH does as well: `recon animate tshirt --motion walk.bvh`.

# %%
body = load_body()
motion = stroll(seconds)
out.mkdir(parents=True, exist_ok=True)
np.savez(out.parent / "stroll.npz", pose=motion.pose, translation=motion.translation, fps=motion.fps)

# %% [markdown]
# ## Geometry-aware skinning (GAPS Eq. 5-7) and its alternatives
#
# How far the skirt's seam between the legs is torn when one leg is lifted, in the worst edge.

# %%
draper = load_gaps("skirt", body)
rest = draper.garment.mesh
pose = body.neutral()
pose.pose[0, 1, 0] = -0.8
posed = body.pose(pose)
edges = torch.cat([rest.faces[:, [0, 1]], rest.faces[:, [1, 2]]])


def worst_edge(method: str) -> float:
    weights = METHODS[method](BodyField.of(body), rest.vertices, rest.faces)[:, :24]
    weights = weights / weights.sum(1, keepdim=True)
    homogeneous = torch.cat([rest.vertices, torch.ones(len(rest.vertices), 1)], 1)
    x = torch.einsum("vj,jab,vb->va", weights, posed.transforms[0], homogeneous)[:, :3]
    lengths = [(p[edges[:, 0]] - p[edges[:, 1]]).norm(dim=1) for p in (rest.vertices, x)]
    return float((lengths[1] / lengths[0]).max())


for method in METHODS:
    print(f"{method:10} longest edge {worst_edge(method):5.2f} times its length")

# %% [markdown]
# ## From a motion to a film
#
# More garments can be named, outermost first; each is then drawn apart from the others and from itself.

# %%
config = Animate(("skirt",), Path("out/stroll.npz"), out, formats=("glb", "gif"), size=240)
done = animate(config)
done.figures["garments"]

# %%
Image(str(out / "film.gif"))

# %% [markdown]
# ## Cloth at rest
#
# The skirt, held at its waistband and nowhere else, finds the shape of least energy: elastic and potential together.

# %%
from recon.cloth.energies import Cloth  # noqa: E402
from recon.cloth.rest import rest as come_to_rest  # noqa: E402

skirt = draper.garment
cloth = Cloth.from_garment(skirt)
held = np.argsort(-skirt.mesh.vertices[:, 1].numpy())[:60]
found = come_to_rest(cloth, skirt.mesh.vertices.double().numpy(), held)
print(f"residual {found.residual:.3f} of a vertex's weight, energy {found.energies[0]:.3f} to {found.energy:.3f} J")
done.figures["untangle"]
