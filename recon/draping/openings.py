"""Which limbs go through which of a garment's openings: an arm that has left its sleeve is worse than any stretch.

Lengths, areas and contact do not tell: cloth that a limb has passed through lies outside of it, unstretched. Each
border is spanned by triangles around its middle; a chain of bones that crosses them an odd number of times goes
through. A border that lies at a sharply bent elbow may be misjudged: there the chain passes close by its edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.bodies import Body
from recon.bodies.rig import JOINT_NAMES
from recon.garments.panels import border_loops
from recon.types import Mesh

CHAINS = {
    "left arm": ("l_collar", "l_shoulder", "l_elbow", "l_wrist"),
    "right arm": ("r_collar", "r_shoulder", "r_elbow", "r_wrist"),
    "left leg": ("pelvis", "l_hip", "l_knee", "l_ankle"),
    "right leg": ("pelvis", "r_hip", "r_knee", "r_ankle"),
    "head": ("spine3", "neck", "head"),
}
"""Limb -> joints along it."""


def passes(border: Tensor, joints: Tensor) -> Tensor:
    """(B,) whether a chain of joints (B, J, 3) goes through a closed border (B, N, 3)."""
    middle = border.mean(1)
    a, b = border - middle[:, None], border.roll(-1, 1) - middle[:, None]
    start, step = joints[:, :-1], joints[:, 1:] - joints[:, :-1]
    p = (start - middle[:, None])[:, :, None]  # (B, J-1, 1, 3)
    d, a, b = step[:, :, None], a[:, None], b[:, None]
    a, b = a.expand(*d.shape[:2], -1, -1), b.expand(*d.shape[:2], -1, -1)
    d, p = d.expand_as(a), p.expand_as(a)
    normal = torch.linalg.cross(a, b)
    along = (d * normal).sum(-1)
    safe = torch.where(along.abs() < 1e-12, torch.ones_like(along), along)
    t = -(p * normal).sum(-1) / safe
    side = torch.linalg.cross(d, p)  # Möller & Trumbore 1997, the fan's middle as origin
    u, v = (side * b).sum(-1) / safe, -(side * a).sum(-1) / safe
    hit = (along.abs() >= 1e-12) & (t >= 0) & (t < 1) & (u >= 0) & (v >= 0) & (u + v <= 1)
    return hit.sum((1, 2)) % 2 == 1


@dataclass(frozen=True)
class Openings:
    """A garment's borders, and the limbs that go through them at rest."""

    worn: tuple[tuple[str, Tensor], ...]
    """Limb, and the vertices (N,) of a border that it goes through."""

    @classmethod
    def of(cls, rest: Tensor, faces: Tensor, joints: Tensor) -> Openings:
        """Of a garment at rest (V, 3) on a body whose joints (24, 3) are in the T pose."""
        found = []
        for loop in border_loops(faces.cpu().numpy()):
            border = torch.as_tensor(loop)
            for limb, names in CHAINS.items():
                chain = joints[[JOINT_NAMES.index(n) for n in names]]
                if passes(rest[border][None], chain[None]):
                    found.append((limb, border))
        return cls(tuple(found))

    @classmethod
    def worn_by(cls, body: Body, rest: Mesh) -> Openings:
        """Of a garment at rest on the neutral body."""
        return cls.of(rest.vertices, rest.faces, body.rest_joints(body.neutral().shape)[0])

    def left(self, x: Tensor, joints: Tensor) -> dict[str, float]:
        """Limb -> share of the B drapes (B, V, 3) on joints (B, 24, 3) in which it has left an opening of its own."""
        out: dict[str, Tensor] = {}
        for limb, border in self.worn:
            chain = joints[:, [JOINT_NAMES.index(n) for n in CHAINS[limb]]]
            gone = ~passes(x[:, border], chain)
            out[limb] = out.get(limb, torch.zeros_like(gone)) | gone
        return {limb: float(gone.float().mean()) for limb, gone in out.items()}
