"""Limbs in their openings."""

from __future__ import annotations

import torch

from recon.bodies import load_body
from recon.bodies.poses import a_pose
from recon.draping.openings import Openings, passes
from recon.draping.skinning import SkinningDraper
from recon.garments.dataset import load_garments
from recon.types import BodyPose


def test_a_chain_passes_a_ring_or_not() -> None:
    angle = torch.linspace(0, 6.2832, 13)[:-1]
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)[None]
    through = torch.tensor([[[0.3, 0.1, -1.0], [0.2, 0.2, 1.0]]])
    beside = through + torch.tensor([1.5, 0.0, 0.0])
    back = torch.cat([through, through[:, :1] + torch.tensor([-0.5, 0.0, 0.0])], 1)
    short = through * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.0, 0.0, 2.0])
    assert [bool(passes(ring, c)) for c in (through, beside, back, short)] == [True, False, False, False]


def test_arms_leave_sleeves_that_are_elsewhere() -> None:
    body = load_body()
    shirt = next(g for g in load_garments("top", "test") if g.variant != "jacket").mesh
    openings = Openings.of(shirt.vertices, shirt.faces, body.rest_joints(body.neutral().shape)[0])
    assert {"left arm", "right arm", "head"} <= {limb for limb, _ in openings.worn}
    pose = torch.cat([a_pose(degrees=20.0), a_pose(degrees=50.0)])
    posed = body.pose(BodyPose(torch.zeros(2, body.n_shape), pose, torch.zeros(2, 3)))
    x = SkinningDraper(body).drape_vertices(shirt, posed)
    assert not any(openings.left(x, posed.joints).values())
    x[1, x[1, :, 0] > 0.2, 2] += 0.25  # the left sleeve hangs in front of its arm
    assert openings.left(x, posed.joints)["left arm"] == 0.5
