"""GAPS' last layer fitted to drapes: what they are, what the fit gives, and a training of some steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.gaps_drapes import Drapes, Teaching, Window, drapes
from pipelines.gaps_refit import LinearMap, narrowed, refitted, taught, unposed_planes
from pipelines.low_rank import low_rank
from pipelines.train_gaps import TrainGaps, train_gaps
from recon.bodies import load_body
from recon.cloth.contact import BodyContact
from recon.draping.gaps import Bound, GapsDraper, GapsNet, GapsShape, load_gaps
from recon.garments.dataset import load_garments
from recon.types import BodyPose, Motion, UserError

SMALL = Teaching(windows=3, frames=9, burn_in=3, every=2, rank=6, steps=2)
ONE = replace(SMALL, windows=1)


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
    return drapes(draper, [motion], body, SMALL, tmp_path_factory.mktemp("drapes") / "own")


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


def test_narrowed_alone_the_network_stays_what_it_was(draper, motion, body, tmp_path) -> None:
    few = taught(draper, [motion], body, replace(SMALL, windows=20, rank=20, fit=False), tmp_path / "own")
    window = Window.drawn([motion], body, SMALL, torch.Generator().manual_seed(5))
    with torch.no_grad():
        wide, narrow = (net(window.features[None], window.shape[None])[0] for net in (draper.net, few))
    assert few.shape.rank == 20 and not list(tmp_path.iterdir())
    assert (narrow - wide).norm() < 0.1 * wide.norm()


def test_drapes_are_kept_and_those_of_other_settings_refused(draper, motion, body, tmp_path) -> None:
    first = drapes(draper, [motion], body, ONE, tmp_path / "deep" / "own")
    stamp = next(tmp_path.glob("deep/own-*")).stat().st_mtime_ns
    second = drapes(draper, [motion], body, ONE, tmp_path / "deep" / "own")
    assert torch.equal(first.moved, second.moved) and next(tmp_path.glob("deep/own-*")).stat().st_mtime_ns == stamp
    with pytest.raises(UserError, match="other settings"):
        drapes(draper, [motion], body, replace(ONE, steps=3), tmp_path / "deep" / "own")


def missed(net: GapsNet, known: Drapes) -> float:
    """Mean distance from the drapes [m]."""
    with torch.no_grad():
        moved = net(known.features, known.shape)[0][:, Drapes.rows(SMALL)]
    return float((moved - known.moved).norm(dim=-1).mean())


def inside(net: GapsNet, known: Drapes, draper: GapsDraper, body) -> float:
    """Share of vertices beyond the planes of the body."""
    with torch.no_grad():
        moved = net(known.features, known.shape)[0][:, Drapes.rows(SMALL)]
    x, bodies = placed(draper, replace(known, moved=moved), body)
    return float(torch.stack([BodyContact(b, body.faces).penetrating(v) for b, v in zip(bodies, x)]).double().mean())


def fitted(draper: GapsDraper, known: Drapes, body, pushes: int) -> GapsNet:
    problem, planes = LinearMap.of(draper.net, known, SMALL), unposed_planes(known, draper.bound, body)
    return refitted(draper.net, problem, planes, replace(SMALL, pushes=pushes))


def test_a_fitted_network_is_nearer_to_the_drapes_than_its_teacher(draper, known, body) -> None:
    net = fitted(draper, known, body, 0)
    assert missed(net, known) < 0.6 * missed(draper.net, known)


def test_pushes_bring_vertices_out_of_the_body(draper, known, body) -> None:
    deep = replace(known, moved=known.moved - 0.01 * known.normal, gap=known.gap - 0.01)
    near, out = (fitted(draper, deep, body, pushes) for pushes in (0, SMALL.pushes))
    assert inside(out, deep, draper, body) < 0.5 * inside(near, deep, draper, body)


def test_a_narrowed_network_is_the_same_with_all_and_near_with_few(draper, known) -> None:
    states, rest = LinearMap.of(draper.net, known, SMALL).states[:, :-1], draper.garment.mesh
    with torch.no_grad():
        wanted = draper.net.displaced(states)
        off = [float((narrowed(draper.net, states, rest, r).displaced(states) - wanted).norm()) for r in (24, 6, 2)]
    assert off[0] < 1e-3 * float(wanted.norm()) and off[0] <= off[1] < off[2]
    again = GapsNet(draper.net.shape)
    again.take_over(narrowed(draper.net, states, rest, 24))
    with torch.no_grad():
        torch.testing.assert_close(again.displaced(states), wanted, atol=1e-5, rtol=1e-3)


def test_a_training_ends_with_the_fit_and_goes_on_from_it(body, tmp_path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    np.savez(clips / "stroll.npz", pose=np.zeros((12, 24, 3)), translation=np.zeros((12, 3)), fps=30)
    config = TrainGaps(
        "skirt:test:1", clips, name="mini", out=tmp_path / "first", steps=1, threads=1, windows=1, width=16, layers=1,
        modes=10, burn_in=1, teaching=SMALL,
    )  # fmt: skip
    train_gaps(config)
    assert load_gaps("mini", body, tmp_path / "first").net.shape.rank == 6
    assert {f.suffix for f in (tmp_path / "first").iterdir() if f.is_file()} == {".safetensors", ".json", ".jsonl"}
    assert len(list((tmp_path / "first").glob("*.safetensors"))) == 1  # drapes are gone
    fitted = replace(config, out=tmp_path / "second", start=tmp_path / "first", steps=0, minutes=0)
    assert train_gaps(fitted).is_file()
    with pytest.raises(UserError, match="another garment"):
        train_gaps(replace(fitted, garment="skirt:test:2", out=tmp_path / "third"))


def test_a_layer_in_two_is_the_layer_where_states_are_few() -> None:
    torch.manual_seed(0)
    layer, states = torch.nn.Linear(9, 20), torch.randn(50, 3) @ torch.randn(3, 9) + 1
    with torch.no_grad():
        few, out = low_rank(layer, states, 3, lambda moved: moved)
        torch.testing.assert_close(out(few(states)), layer(states), atol=1e-4, rtol=1e-4)
        few, out = low_rank(layer, states, 1, lambda moved: moved)
        assert float((out(few(states)) - layer(states)).norm()) > 0.1
