"""Limbs are turned out of the body, as little as does it."""

from __future__ import annotations

import pytest
import torch

from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearance, clear_bodies, clear_motion
from recon.bodies.poses import a_pose, t_pose
from recon.types import BodyPose, Motion


@pytest.fixture(scope="module")
def body() -> Body:
    return load_body()


@pytest.fixture(scope="module")
def clearance(body: Body) -> Clearance:
    return Clearance(body, body.neutral().shape)


def test_balls_lie_in_the_body_and_touch_its_skin(body: Body, clearance: Clearance) -> None:
    balls = clearance.balls
    apart = torch.cdist(balls.centre, body.rest(body.neutral().shape).vertices[0]).min(1).values
    assert (apart - balls.radius).abs().max() < 0.006  # relief of the skin within a centimetre does not count
    assert 0.08 < balls.radius.max() < 0.15 and balls.pairs.shape[1] > 1000


def test_clear_poses_come_back_as_they_are(clearance: Clearance) -> None:
    pose = torch.cat([t_pose(), a_pose(degrees=40.0)])
    assert torch.equal(clearance.cleared(pose), pose)


def test_arms_leave_the_trunk(clearance: Clearance) -> None:
    pose = torch.cat([a_pose(degrees=88.0), a_pose(degrees=30.0)])
    before, found = clearance.deepest(pose), clearance.cleared(pose)
    after = clearance.deepest(found)
    assert before[0] > 0.04 and after[0] < 0.55 * before[0]  # cost and room in balance
    turned = (found - pose).abs().amax((0, 2)) > 1e-3
    assert turned[[16, 17]].all() and not turned[[0, 3, 6, 9, 12, 15]].any()
    assert before[1] == 0 and torch.equal(found[1], pose[1])
    left, right = found[0, 16], found[0, 17]
    assert (left + right * torch.tensor([-1.0, 1.0, 1.0])).abs().max() < 0.15  # alike on both sides, nearly


def test_motions_stay_smooth_and_say_so(body: Body) -> None:
    pose = torch.cat([a_pose(degrees=d) for d in (60.0, 70.0, 80.0, 88.0, 80.0, 70.0, 60.0)])
    motion = Motion(pose, torch.zeros(7, 3), 30.0)
    found = clear_motion(motion, body, body.neutral().shape)
    assert "turned in" in found.notes[-1] and found.fps == 30.0
    extra = (found.pose - pose)[:, 16]
    assert (extra[1:] - extra[:-1]).norm(dim=1).max() < 0.35
    still = clear_motion(Motion(t_pose(3), torch.zeros(3, 3), 30.0), body, body.neutral().shape)
    assert not still.notes and torch.equal(still.pose, t_pose(3))


def test_each_body_by_its_own_shape(body: Body) -> None:
    shape = torch.zeros(2, body.n_shape)
    shape[1, 1] = 2.0
    bodies = BodyPose(shape, torch.cat([a_pose(degrees=88.0)] * 2), torch.zeros(2, 3))
    found = clear_bodies(bodies, body)
    assert torch.equal(found.shape, shape) and not torch.equal(found.pose[0], found.pose[1])
