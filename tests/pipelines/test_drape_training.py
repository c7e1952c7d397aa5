"""Bodies to learn draping on: repeatable, within limits, of all sources."""

from __future__ import annotations

from dataclasses import replace

import torch

from pipelines.drape_garments import garments_of, shoulders, wearable
from pipelines.drape_training import BodySampler, Sampling
from recon.bodies import load_body
from recon.bodies.clearance import Clearance, Clearing
from recon.bodies.pose_prior import joint_limits
from recon.bodies.poses import stroll
from recon.garments import load_decoder
from recon.garments.dataset import load_garments


def draw(settings: Sampling, motions=(), count: int = 40):
    return BodySampler(motions, 7, settings)(count, torch.Generator().manual_seed(3))


def farthest(poses: torch.Tensor, among: torch.Tensor) -> torch.Tensor:
    apart = torch.cdist(poses.flatten(1), among.flatten(1), compute_mode="donot_use_mm_for_euclid_dist")
    return apart.min(1).values.max()


def test_repeatable_shapes_and_limits() -> None:
    settings = Sampling(clips=0.0)
    first, second = draw(settings), draw(settings)
    assert first.shape.shape == (40, 7) and first.pose.shape == (40, 24, 3) and first.translation.shape == (40, 3)
    assert torch.equal(first.pose, second.pose) and torch.equal(first.shape, second.shape)
    assert first.shape.abs().max() <= 2
    limits = joint_limits()
    assert (first.pose >= limits[..., 0] - 1e-6).all() and (first.pose <= limits[..., 1] + 1e-6).all()


def test_clip_poses_are_the_clips() -> None:
    motion = stroll(1.0)
    poses = draw(Sampling(clips=1.0, swap=0.0, calm=0.0), [motion]).pose
    assert farthest(poses, motion.pose) < 1e-5


def test_swapped_arms_come_from_another_frame() -> None:
    motion = stroll(2.0)
    poses = draw(Sampling(clips=1.0, swap=1.0, calm=0.0), [motion]).pose
    assert farthest(poses, motion.pose) > 1e-3


def test_calm_poses_lie_on_the_way_to_t() -> None:
    motion = stroll(1.0)
    calm = draw(Sampling(clips=1.0, swap=0.0, calm=1.0), [motion]).pose[:, 1:].flatten(1)
    clip = motion.pose[:, 1:].flatten(1)
    cosine = torch.nn.functional.normalize(calm, dim=1) @ torch.nn.functional.normalize(clip, dim=1).T
    assert (cosine.max(1).values > 0.999).all()


def test_cleared_poses_are_fewer_and_hardly_pass_through_the_body() -> None:
    body = load_body()
    clearance = Clearance(body, body.neutral().shape, Clearing(gap=0.0))
    settings = Sampling(clips=0.0, pool=6)
    found = BodySampler([], body.n_shape, settings, clearance)(30, torch.Generator().manual_seed(1))
    drawn = BodySampler([], body.n_shape, settings)(30, torch.Generator().manual_seed(1))
    assert len(found.pose.unique(dim=0)) <= 6 < len(drawn.pose.unique(dim=0))
    assert clearance.deepest(drawn.pose).max() > 0.02
    assert clearance.deepest(found.pose).max() < 0.5 * clearance.deepest(drawn.pose).max()


def test_clothes_hang_on_shoulder_seams_if_no_waistband_holds_them() -> None:
    for kind in ("top", "dress", "skirt", "trousers"):
        garment = load_garments(kind, "test")[0]
        hung, y = shoulders(garment), garment.mesh.vertices[:, 1]
        assert bool(len(hung)) == (kind in ("top", "dress"))
        if len(hung):
            assert len(hung) >= 4 and y[hung].min() > y.quantile(0.6)


def test_torn_garments_are_not_learned_on() -> None:
    decoder = load_decoder("skirt")
    whole = garments_of(decoder, 3, 300, torch.Generator().manual_seed(0))
    assert len(whole) == 3 and all(wearable(g) for g in whole)
    x = whole[0].mesh.vertices.clone()
    x[0] += 0.5
    assert not wearable(replace(whole[0], mesh=whole[0].mesh.with_vertices(x)))
