"""Learning GAPS from drapes: what they are, what the network begins as, and a training of some steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.gaps_drapes import DrapeLoss, Drapes, Edges, Teaching, drapes, pupil
from pipelines.train_gaps import TrainGaps, train_gaps
from recon.bodies import load_body
from recon.cloth.contact import BodyContact
from recon.draping.gaps import Bound, GapsDraper, GapsNet, GapsShape, load_gaps
from recon.garments.dataset import load_garments
from recon.types import BodyPose, Motion, UserError

SMALL = Teaching(frames=9, burn_in=3, every=2, rank=6, windows=2, drapes=2, steps=2)


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def draper(body) -> GapsDraper:
    garment = load_garments("skirt", "test")[1]
    torch.manual_seed(0)
    net = GapsNet(GapsShape(len(garment.mesh.vertices), body.n_shape, width=24, layers=1))
    return GapsDraper(net, garment, Bound.of(garment.mesh.vertices, garment.mesh.faces, body))


@pytest.fixture(scope="module")
def motion() -> Motion:
    pose = torch.zeros(20, 24, 3)
    pose[:, 1, 0] = torch.linspace(0, -0.8, 20)
    return Motion(pose, torch.zeros(20, 3), 30.0)


@pytest.fixture(scope="module")
def known(draper, motion, body, tmp_path_factory) -> Drapes:
    return drapes(draper, [motion], body, 3, SMALL, tmp_path_factory.mktemp("drapes") / "own")


def placed(draper: GapsDraper, known: Drapes, body) -> tuple[torch.Tensor, torch.Tensor]:
    """The drapes in the world, and the bodies beneath them."""
    count = known.pose.shape[1]
    bodies = BodyPose(known.shape.repeat_interleave(count, 0), known.pose.flatten(0, 1), known.place.flatten(0, 1))
    posed = body.pose(bodies)
    return draper.bound.place(known.moved.flatten(0, 1).float(), posed.transforms, posed.shape), posed.mesh.vertices


def test_unposed_moves_place_vertices_where_they_were(draper, body) -> None:
    g = torch.Generator().manual_seed(0)
    pose = BodyPose(torch.zeros(2, body.n_shape), 0.2 * torch.randn(2, 24, 3, generator=g), torch.zeros(2, 3))
    transforms, still = body.skeleton(pose)[0], torch.zeros(2, *draper.bound.rest.shape)
    move = 0.01 * torch.randn(still.shape, generator=g)
    wanted = draper.bound.place(still, transforms, pose.shape) + move
    found = draper.bound.place(draper.bound.unposed(move, transforms), transforms, pose.shape)
    assert float((found - wanted).norm(dim=-1).max()) < 2e-4


def test_drapes_lie_as_far_from_the_body_as_their_planes_say(draper, known, body) -> None:
    assert known.moved.shape[:2] == (3, 3) and known.features.shape[:2] == (3, 9)
    x, bodies = placed(draper, known, body)
    near = known.normal.flatten(0, 1).float().square().sum(-1) > 0.5
    assert 0.01 < near.float().mean() < 1
    far = torch.stack([BodyContact(b, body.faces).signed_distance(v) for b, v in zip(bodies, x)])
    error = (far - known.gap.flatten(0, 1).float()).abs()[near]
    assert float(error.median()) < 5e-4 and float(error.quantile(0.9)) < 3e-3


def test_drapes_are_kept_and_those_of_other_settings_refused(draper, motion, body, tmp_path) -> None:
    first = drapes(draper, [motion], body, 1, SMALL, tmp_path / "deep" / "own")
    stamp = next(tmp_path.glob("deep/own-*")).stat().st_mtime_ns
    second = drapes(draper, [motion], body, 1, SMALL, tmp_path / "deep" / "own")
    assert torch.equal(first.moved, second.moved) and next(tmp_path.glob("deep/own-*")).stat().st_mtime_ns == stamp
    with pytest.raises(UserError, match="other settings"):
        drapes(draper, [motion], body, 1, replace(SMALL, steps=3), tmp_path / "deep" / "own")


def test_the_pupil_begins_nearer_to_the_drapes_than_its_teacher(draper, known) -> None:
    net = pupil(draper.net, known, Edges(draper.garment.mesh), SMALL, 0)
    assert net.shape.rank == 6
    with torch.no_grad():
        rows = Drapes.rows(SMALL)
        missed = [(n(known.features, known.shape)[0][:, rows] - known.moved).abs().mean() for n in (draper.net, net)]
    assert float(missed[1]) < 0.6 * float(missed[0])


def test_the_loss_is_least_at_the_drapes(draper, known, body) -> None:
    edges = Edges(draper.garment.mesh)
    net = pupil(draper.net, known, edges, SMALL, 0)
    loss = DrapeLoss(known, edges, draper.bound, body, SMALL)
    value, terms = loss(net, torch.Generator().manual_seed(0))
    value.backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters() if p.requires_grad)
    with torch.no_grad():
        net.out.bias += 1.0
        worse, _ = loss(net, torch.Generator().manual_seed(0))
    assert float(worse) > float(value.detach()) and terms["strain"] > 0


def test_a_training_on_drapes_goes_from_a_network_to_a_network(draper, body, tmp_path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    np.savez(clips / "stroll.npz", pose=np.zeros((12, 24, 3)), translation=np.zeros((12, 3)), fps=30)
    config = TrainGaps(
        "skirt:test:1", clips, name="mini", out=tmp_path / "first", steps=1, threads=1, windows=1, width=16, layers=1,
        modes=10, burn_in=1,
    )  # fmt: skip
    train_gaps(config)
    taught = replace(config, out=tmp_path / "second", start=tmp_path / "first", drapes=2, teaching=SMALL, steps=2)
    train_gaps(taught)
    found = load_gaps("mini", body, tmp_path / "second")
    assert found.net.shape.rank == 6
    with pytest.raises(UserError, match="another garment"):
        train_gaps(replace(taught, garment="skirt:test:2", out=tmp_path / "third"))
