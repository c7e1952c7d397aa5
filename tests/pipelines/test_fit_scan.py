"""The scan's stages: where the body starts and ends, the two-way distance, and its energy for refinement."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.fit_body import to_body
from pipelines.fit_scan_body import (
    ARMS,
    CloudLoss,
    ScanBodyFit,
    SurfaceLoss,
    evenly,
    fit_scan_body,
    search,
    thinned,
    with_other_arms,
)
from pipelines.fit_scan_garment import TwoWay
from pipelines.refine_scan import ScanRefinement, ToScan
from recon.bodies import load_body
from recon.bodies.poses import a_pose
from recon.metrics import sample_surface, surface_distance
from recon.types import BodyPose, Mesh, Scan

BODY = load_body()


def made_scan(turn: float = 2.2, count: int = 3000) -> tuple[Scan, BodyPose]:
    """A body with its arms half down, turned; its trunk and thighs wear labels of clothes two centimetres off it."""
    pose = a_pose(1, 45.0)
    pose[0, 0, 1] = turn
    shape = torch.zeros(1, BODY.n_shape)
    shape[0, 0] = 1.0
    place = BodyPose(shape, pose, torch.tensor([[0.3, 0.1, -0.2]]))
    mesh = Mesh(BODY.pose(place).mesh.vertices[0], BODY.faces)
    points, normals = sample_surface(mesh, count, torch.Generator().manual_seed(0))
    nearest = torch.cdist(points, mesh.vertices).argmin(1)
    top, legs = (BODY.region_mask(name)[nearest] for name in ("torso", "legs"))
    labels = torch.where(top, 1, torch.where(legs, 2, 0))
    return Scan(points + 0.02 * normals * (labels > 0)[:, None], labels, ("body", "top", "trousers")), place


QUICK = replace(ScanBodyFit(), facings=4, arms=(20.0, 60.0), points=250, kept=(8, 4, 2), finalists=1, fine_points=800)


def test_the_body_is_found_whichever_way_it_faces():
    scan, place = made_scan()
    truth = BODY.pose(place).mesh.vertices[0]
    values = search(scan, BODY, QUICK)
    found = BODY.pose(to_body(values)).mesh.vertices[0]
    assert (found - truth).norm(dim=1).mean() < 0.06
    values = fit_scan_body(scan, BODY, QUICK, BodyPose(*(values[k][:1] for k in ("shape", "pose", "translation"))))
    found = BODY.pose(to_body(values)).mesh.vertices[0]
    away = surface_distance(truth[::20], Mesh(found, BODY.faces))[0]
    assert away.median() < 0.008 and (found - truth).norm(dim=1).median() < 0.03


def test_both_losses_are_least_at_the_truth():
    scan, place = made_scan()
    true = {"shape": place.shape, "pose": place.pose, "translation": place.translation}
    cloud, surface = CloudLoss(scan, BODY, QUICK), SurfaceLoss(scan, BODY, QUICK, 500)
    flipped = true | {"pose": place.pose.clone()}
    flipped["pose"][0, 0, 1] += math.pi
    moved = true | {"translation": place.translation + 0.05}
    for other in (flipped, moved):
        assert cloud.at(0.3).each(true) < cloud.at(0.3).each(other)
        assert surface(true) < surface(other)


def test_limbs_in_empty_space_cost_something():
    scan, place = made_scan()
    raised = place.pose.clone()
    raised[0, 16, 2] += 1.0
    without = Scan(scan.points[scan.points[:, 0] < 0.45], scan.labels[scan.points[:, 0] < 0.45], scan.names)
    loss = SurfaceLoss(without, BODY, replace(QUICK, ends=1.0), 500)
    bare = SurfaceLoss(without, BODY, replace(QUICK, ends=0.0), 500)
    values = {"shape": place.shape, "pose": raised, "translation": place.translation}
    assert loss(values) > bare(values) + 0.05


def test_evenly_thins_to_at_most_so_many():
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    keep = evenly(points, 300)
    assert 200 < len(keep) <= 300 and len(keep.unique()) == len(keep)
    assert torch.cdist(points, points[keep]).min(1).values.max() < 0.35
    assert len(evenly(points[:50], 300)) == 50
    assert 200 < len(thinned(BODY, 0.1)) < len(thinned(BODY, 0.05)) < BODY.n_vertices


def sheet(n: int = 12, height: float = 0.0) -> Mesh:
    """A square metre, n x n cells, level."""
    axis = torch.linspace(0, 1, n + 1)
    x, z = torch.meshgrid(axis, axis, indexing="ij")
    vertices = torch.stack([x.reshape(-1), torch.full(((n + 1) ** 2,), height), z.reshape(-1)], 1)
    corner = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + n + 2, corner + n + 1
    return Mesh(vertices, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]))


def test_two_way_distance_of_parallel_sheets_is_their_gap():
    mesh, reach = sheet(), 0.1
    points, _ = sample_surface(mesh, 20000, torch.Generator().manual_seed(1))
    scan = Scan(points + torch.tensor([0, 0.05, 0]), torch.ones(20000).long(), ("body", "top"))
    distance = TwoWay(scan, "top", (), 500)
    each = 0.05**2 / (0.05**2 + reach**2)
    assert distance(mesh.vertices, mesh.faces, reach).item() == pytest.approx(2 * each, rel=0.03)


def test_what_lies_beneath_another_garment_counts_for_nothing():
    mesh = sheet()
    own, _ = sample_surface(mesh, 20000, torch.Generator().manual_seed(1))
    left = own[own[:, 0] < 0.5]  # the other half is under the outer garment
    above = own[own[:, 0] >= 0.5] + torch.tensor([0, 0.01, 0])
    points = torch.cat([left, above])
    labels = torch.cat([torch.full((len(left),), 2), torch.ones(len(above)).long()])
    scan = Scan(points, labels, ("body", "jacket", "top"))
    seeing, blind = TwoWay(scan, "top", ("jacket",), 500), TwoWay(scan, "top", (), 500)
    assert seeing(mesh.vertices, mesh.faces, 0.02) < 0.1
    assert blind(mesh.vertices, mesh.faces, 0.02) > 0.3


def test_energy_and_gradient_of_refinement_agree():
    mesh = sheet(6)
    points, _ = sample_surface(mesh, 3000, torch.Generator().manual_seed(1))
    scan = Scan(points + torch.tensor([0.0, 0.02, 0.0]), torch.ones(3000).long(), ("body", "top"))
    energy = ToScan(scan, ("top",), [mesh.faces], ScanRefinement(points=400))
    x = mesh.vertices.double().numpy() + np.random.default_rng(0).normal(0, 0.004, (49, 3))
    value, gradient = energy([x])
    assert value > 0 and gradient.shape == (49, 3)
    step = np.zeros_like(x)
    step[:, 1] = 1e-4  # moving as a whole keeps most of the pairs
    slope = (energy([x + step])[0] - energy([x - step])[0]) / 2e-4
    assert (gradient * step / 1e-4).sum() == pytest.approx(slope, rel=0.03)
    assert slope < 0


def test_other_arms_are_the_same_body_otherwise():
    """Of those that join, each differs in one arm at least and in nothing but arms; the same call gives the same."""
    values = {"shape": torch.randn(3, 4), "pose": 0.1 * torch.randn(3, 24, 3), "translation": torch.randn(3, 3)}
    more = with_other_arms(values, 7)
    assert all(len(v) == 10 and torch.equal(v[:3], values[k]) for k, v in more.items())
    number = torch.arange(7) % 3
    changed = (more["pose"][3:] != values["pose"][number]).any(2)
    arms = torch.zeros(24, dtype=torch.bool)
    arms[[joint for arm in ARMS for joint in arm]] = True
    assert not changed[:, ~arms].any() and changed[:, arms].any(1).all()
    assert torch.equal(more["shape"][3:], values["shape"][number])
    assert torch.equal(with_other_arms(values, 7)["pose"], more["pose"])
