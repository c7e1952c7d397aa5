"""Skin gives way in the creases of bent elbows and knees, so that cloth finds room between the limb's two halves.

Linear blend skinning pushes the skin on either side of a sharp bend through the other side; flesh would be pressed flat
between them. No cloth can be outside of both halves there without crossing itself. The plane that halves the bend
separates them: what is beyond it is pressed back to its own side of a slot along that plane.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.bodies.rig import JOINT_NAMES
from recon.types import PosedBody

HINGES = (("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot"))
"""Joints along a limb: the one before the bend, the bending one, and those beyond it."""
SLOT = 0.008
"""Room between the two halves [m]: some layers of cloth on either side."""
SHARP = (1.0, 1.6)
"""Bends up to the first angle leave the skin as it is; from the second on it keeps wholly to its side [rad]."""
BLEND = 0.5
"""Where the weights of both halves differ by less the slot is narrower: its bottom is closed."""


@torch.no_grad()
def open_creases(posed: PosedBody, slot: float = SLOT) -> PosedBody:
    """The posed bodies with slots [m] in the creases of their elbows and knees; others as they were."""
    vertices = posed.mesh.vertices
    for side in "lr":
        for names in HINGES:
            vertices = _pressed(vertices, posed, [JOINT_NAMES.index(f"{side}_{name}") for name in names], slot)
    return replace(posed, mesh=posed.mesh.with_vertices(vertices))


def _pressed(vertices: Tensor, posed: PosedBody, limb: list[int], slot: float) -> Tensor:
    """(B, V, 3) skin on its own side of one bend, of joints as in ``HINGES``."""
    before, *beyond = limb
    joint = posed.joints[:, beyond[0]]
    up, down = (F.normalize(posed.joints[:, k] - joint, dim=-1) for k in (before, beyond[1]))
    across, inner = F.normalize(up - down, dim=-1), F.normalize(up + down, dim=-1)
    own, other = posed.weights[:, before], posed.weights[:, beyond].sum(1)
    side = torch.where(own > other, 1.0, -1.0) * (own + other > 0.5)
    room = slot / 2 * ((own - other).abs() / BLEND).clamp(max=1)
    at = vertices - joint[:, None]
    height = torch.einsum("bvi,bi->bv", at, across) * side
    within = (torch.einsum("bvi,bi->bv", at, inner) > 0) & (side != 0)
    bend = torch.pi - (up * down).sum(-1).clamp(-1, 1).acos()
    share = ((bend - SHARP[0]) / (SHARP[1] - SHARP[0])).clamp(0, 1)[:, None]
    lack = torch.where(within, (room - height).clamp_min(0), 0.0) * share * side
    return vertices + lack[..., None] * across[:, None]
