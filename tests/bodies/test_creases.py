"""Creases: the skin of sharply bent limbs keeps to its own side, and nowhere else is it touched."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.bodies.creases import SLOT, open_creases
from recon.bodies.rig import JOINT_NAMES
from recon.cloth.intersections import Crossings
from recon.types import PosedBody

BODY = load_body()


def bent(joint: str, degrees: float, axis: int) -> PosedBody:
    place = BODY.neutral()
    joints = place.pose.clone()
    joints[0, JOINT_NAMES.index(joint), axis] = math.radians(degrees)
    with torch.no_grad():
        return BODY.pose(replace(place, pose=joints))


CASES = [("l_elbow", -120.0, 1), ("r_elbow", 120.0, 1), ("l_knee", 125.0, 0), ("r_knee", 125.0, 0)]


@pytest.mark.parametrize(("joint", "degrees", "axis"), CASES)
def test_a_sharp_bend_no_longer_passes_through_itself(joint: str, degrees: float, axis: int) -> None:
    posed = bent(joint, degrees, axis)
    opened = open_creases(posed)
    test = Crossings(BODY.faces.numpy(), BODY.n_vertices)

    def through(body: PosedBody) -> int:
        """Pairs of faces that cross within 15 cm of the joint."""
        skin = body.mesh.vertices[0].double().numpy()
        at = skin[BODY.faces.numpy()[test.pairs(test(skin))[:, 0]]].mean(1)
        return int((np.linalg.norm(at - body.joints[0, JOINT_NAMES.index(joint)].numpy(), axis=1) < 0.15).sum())

    assert through(posed) > 20 and through(opened) < 0.15 * through(posed)
    moved = (opened.mesh.vertices - posed.mesh.vertices)[0]
    far = moved.norm(dim=1)
    assert (far > 0).sum() < 0.03 * BODY.n_vertices and SLOT / 2 < far.max() < 0.06
    at = (posed.mesh.vertices[0] - posed.joints[0, JOINT_NAMES.index(joint)]).norm(dim=1)
    assert at[far > 0].max() < 0.2


@pytest.mark.parametrize(("joint", "degrees", "axis"), [("l_elbow", -50.0, 1), ("r_knee", 50.0, 0)])
def test_gentle_bends_stay_as_they_are(joint: str, degrees: float, axis: int) -> None:
    posed = bent(joint, degrees, axis)
    assert torch.equal(open_creases(posed).mesh.vertices, posed.mesh.vertices)


def test_the_skin_gives_way_steadily() -> None:
    steps = [open_creases(bent("l_elbow", -d, 1)).mesh.vertices for d in np.arange(50.0, 130.0, 2.0)]
    plain = [bent("l_elbow", -d, 1).mesh.vertices for d in np.arange(50.0, 130.0, 2.0)]
    jumps = [float(((b - a) - (q - p)).norm(dim=-1).max()) for a, b, p, q in zip(steps, steps[1:], plain, plain[1:])]
    assert max(jumps) < 0.008
