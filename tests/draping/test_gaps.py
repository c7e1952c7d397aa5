"""GAPS' network, its training for a moment, and what comes of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.drape_training import read_motions
from pipelines.sequence import Animate, animate
from pipelines.train_gaps import Template, TrainGaps, train_gaps
from recon.bodies import load_body
from recon.bodies.rig import axis_angles, rotation_matrices
from recon.draping.gaps import FEATURES, Bound, GapsNet, GapsShape, load_gaps, motion_features, smooth_basis
from recon.files.animations import read_pc2
from recon.files.meshes import write_obj
from recon.garments.dataset import load_garments
from recon.types import BodyPose, Mesh, UserError

FRAMES = 7


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def garment():
    return load_garments("skirt", "test")[1]


@pytest.fixture(scope="module")
def motions(tmp_path_factory) -> Path:
    """Two made motions in the rig's own numbers: arms and legs swing while the body walks on."""
    folder = tmp_path_factory.mktemp("motions")
    for k, name in enumerate(("stroll", "march")):
        t = np.arange(20) / 30
        pose = np.zeros((20, 24, 3))
        pose[:, 0, 1] = 0.3 * k
        pose[:, 1, 0], pose[:, 2, 0] = 0.4 * np.sin(5 * t + k), -0.4 * np.sin(5 * t + k)
        pose[:, 16, 2], pose[:, 17, 2] = -1.1, 1.1
        np.savez(folder / f"{name}.npz", pose=pose, translation=np.outer(t, [0.0, 0.0, 1.2]), fps=30)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory, motions: Path) -> tuple[Path, TrainGaps]:
    """A training of some steps."""
    out = tmp_path_factory.mktemp("gaps")
    config = TrainGaps(
        "skirt:test:1", motions, name="mini", holdout=("march",), out=out, steps=6, threads=1, windows=2, width=32,
        layers=2, modes=40, burn_in=3, rank=0,
    )  # fmt: skip
    train_gaps(config)
    return out, config


def random_motion(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return 0.4 * torch.randn(1, FRAMES, 24, 3, generator=g), torch.randn(1, FRAMES, 3, generator=g) * 0.05


def test_features_do_not_know_where_the_person_stands_or_faces() -> None:
    pose, place = random_motion()
    turn = rotation_matrices(torch.tensor([0.0, 1.1, 0.0]))
    turned = pose.clone()
    turned[:, :, 0] = axis_angles(turn @ rotation_matrices(pose[:, :, 0]))
    moved = place @ turn.T + torch.tensor([3.0, 0.0, -2.0])
    found, wanted = motion_features(turned, moved, 30.0), motion_features(pose, place, 30.0)
    assert wanted.shape == (1, FRAMES, FEATURES)
    torch.testing.assert_close(found, wanted, atol=2e-4, rtol=1e-4)


def test_features_hold_velocity_and_turning_of_the_pelvis() -> None:
    pose, place = torch.zeros(1, 3, 24, 3), torch.zeros(1, 3, 3)
    pose[0, :, 0, 1] = math.pi / 2 + torch.tensor([0.0, 0.02, 0.04])
    place[0, :, 2] = torch.tensor([0.0, 0.1, 0.2])
    last = motion_features(pose, place, 10.0)[0, 2, -9:]
    assert last[:3].tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    turned = math.pi / 2 + 0.04
    wanted = [-0.3 * math.sin(turned), 0, 0.3 * math.cos(turned)]
    assert last[3:6].tolist() == pytest.approx(wanted, abs=1e-5)
    assert last[6:].tolist() == pytest.approx([0, 0.3 * 0.2, 0], abs=1e-4)


def test_folding_the_basis_in_changes_nothing(garment) -> None:
    basis = smooth_basis(garment.mesh.vertices, garment.mesh.faces, 30)
    assert basis.shape == (len(garment.mesh.vertices), 30)
    assert float(basis[:, 0].std() / basis[:, 0].abs().mean()) < 1e-3  # the smoothest function is constant
    net = GapsNet(GapsShape(len(garment.mesh.vertices), 20, width=16, layers=2), basis)
    features = torch.randn(2, 5, FEATURES, generator=torch.Generator().manual_seed(1))
    shape = torch.randn(2, 20, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        moved, hidden = net(features, shape)
        again, same = net.folded()(features, shape)
    assert moved.shape == (2, 5, len(garment.mesh.vertices), 3)
    torch.testing.assert_close(again, moved, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(same, hidden)


def test_streaming_is_the_same_as_all_at_once(trained, body) -> None:
    draper = load_gaps("mini", body, trained[0])
    pose, place = random_motion(3)
    whole = BodyPose(torch.zeros(FRAMES, body.n_shape), pose[0], place[0])
    with torch.no_grad():
        posed = body.pose(whole)
        one_by_one = torch.cat(list(draper.stream((whole[k] for k in range(FRAMES)), body, 30.0)))
    torch.testing.assert_close(one_by_one, draper.animate(posed, whole, 30.0), atol=1e-5, rtol=1e-4)


def test_without_displacement_it_is_skinning(garment, body) -> None:
    bound = Bound.of(garment.mesh.vertices, garment.mesh.faces, body)
    rest = body.neutral()
    with torch.no_grad():
        x = bound.place(torch.zeros(1, *garment.mesh.vertices.shape), body.pose(rest).transforms, rest.shape)
    torch.testing.assert_close(x[0], garment.mesh.vertices, atol=1e-5, rtol=0)


def test_weights_keep_the_garment_to_the_digit(trained, body, garment) -> None:
    draper = load_gaps("mini", body, trained[0])
    assert torch.equal(draper.garment.mesh.vertices, garment.mesh.vertices)
    assert torch.equal(draper.garment.panel_points, garment.panel_points.float())
    assert draper.garment.kind == "skirt" and draper.garment.seam_names == garment.seam_names
    with pytest.raises(UserError, match="gaps-hat"):
        load_gaps("hat", body, trained[0])


def test_the_same_seed_learns_the_same(trained, tmp_path) -> None:
    out, config = trained
    again = train_gaps(replace(config, out=tmp_path))
    assert again.read_bytes() == (out / "gaps-mini.safetensors").read_bytes()


def test_held_out_clips_are_not_learned_from(motions, body, tmp_path) -> None:
    config = TrainGaps("skirt:test:1", motions, holdout=("march",))
    first = read_motions(config.motions, config.holdout, body, config.fps, tmp_path)
    assert len(first) == 2  # one clip and its mirror image
    assert len(list((tmp_path / "clips").iterdir())) == 1
    again = read_motions(config.motions, config.holdout, body, config.fps, tmp_path)
    assert torch.equal(again[0].pose, first[0].pose) and torch.equal(again[0].translation, first[0].translation)
    with pytest.raises(UserError, match="no motion clips"):
        read_motions(config.motions, ("march", "stroll"), body, config.fps)


def test_any_mesh_can_be_a_template(garment, body) -> None:
    template = Template.of(Mesh(garment.mesh.vertices, garment.mesh.faces), body)
    by_panels = Template.of(garment, body)
    assert not len(template.held) and len(by_panels.held) > 20
    assert float(template.cloth.areas.sum()) == pytest.approx(float(by_panels.cloth.areas.sum()), rel=0.03)


def test_unknown_garments_and_skinnings_are_one_line(motions) -> None:
    for bad, says in (("hat:3", "wanted KIND"), ("skirt:test:999", "from 0 to 19"), ("skirt:x", "number")):
        with pytest.raises(UserError, match=says):
            train_gaps(TrainGaps(bad, motions))
    with pytest.raises(UserError, match="wanted one of rbf"):
        train_gaps(TrainGaps("skirt:test:1", motions, skinning="glue"))


def test_animate_writes_what_it_was_asked_for(trained, motions, tmp_path) -> None:
    config = Animate(
        ("mini",), motions / "march.npz", tmp_path / "out", seconds=0.2, formats=("glb", "pc2", "gif"), size=64,
        weights=trained[0],
    )  # fmt: skip
    done = animate(config, say=lambda line: None)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "scene.glb", "film.gif", "mini.pc2", "body.pc2", "mini", "body", "result.json", "run.json", "stages",
    }  # fmt: skip
    figures = done.figures["garments"]["mini"]
    assert done.figures["frames"] == 6 and done.figures["untangle"]["clean_frames"] == 6
    assert figures["eps_c"] == 0 and figures["eps_e"] < 15
    torch.testing.assert_close(read_pc2(tmp_path / "out" / "mini.pc2"), done.parts["mini"].frames)
    heard: list[str] = []
    again = animate(config, say=heard.append)
    assert all(line.endswith("(kept)") for line in heard) and len(heard) == 2
    assert torch.equal(again.parts["mini"].frames, done.parts["mini"].frames)


def test_a_mesh_without_panels_is_simulated(garment, motions, tmp_path) -> None:
    write_obj(garment.mesh, tmp_path / "cloth.obj")
    config = Animate(
        (str(tmp_path / "cloth.obj"),), motions / "stroll.npz", tmp_path / "out", seconds=0.1, untangle=False,
        formats=("obj",),
    )  # fmt: skip
    found = animate(config, say=lambda line: None).figures["garments"]["cloth"]
    assert found["eps_c"] < 1 and found["eps_e"] < 6


def test_layers_are_simulated_over_each_other(motions, tmp_path) -> None:
    config = Animate(
        ("top:test:18", "skirt:test:1"), motions / "stroll.npz", tmp_path / "out", seconds=0.1, formats=("obj",)
    )
    done = animate(config, say=lambda line: None)
    assert list(done.parts) == ["top-test-18", "skirt-test-1", "body"]
    assert done.figures["untangle"]["clean_frames"] == 3
    assert all(f["eps_c"] == 0 and f["eps_e"] < 6 for f in done.figures["garments"].values())
    assert len(list((tmp_path / "out" / "body").iterdir())) == 3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"draper": "glue"}, "--draper"),
        ({"formats": ("fbx",)}, "--formats"),
        ({"garments": ("mini", "mini")}, "different names"),
        ({"start": 99.0}, "--start"),
        ({"fps": 0.0}, "--fps"),
        ({"shape": (0.0,) * 99}, "--shape"),
        ({"motion": Path("nowhere.npz")}, "no such file"),
    ],
)
def test_mistakes_are_one_line(change: dict, says: str, trained, motions, tmp_path) -> None:
    config = Animate(("mini",), motions / "march.npz", tmp_path / "out", weights=trained[0])
    with pytest.raises(UserError, match=says):
        animate(replace(config, **change), say=lambda line: None)


def test_a_folder_of_something_else_is_left_alone(trained, motions, tmp_path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="no run wrote"):
        animate(Animate(("mini",), motions / "march.npz", tmp_path, weights=trained[0]), say=lambda line: None)
    assert (tmp_path / "thesis.txt").read_text() == "mine"
    (tmp_path / "result.json").write_text('{"schema": 1, "garments": {}}')  # a photo's
    with pytest.raises(UserError, match="no run wrote"):
        animate(Animate(("mini",), motions / "march.npz", tmp_path, weights=trained[0]), say=lambda line: None)
    assert "schema" in (tmp_path / "result.json").read_text()


def test_a_network_goes_on_from_stored_weights(body, garment) -> None:
    mesh = garment.mesh
    basis = smooth_basis(mesh.vertices, mesh.faces, 20)
    shape = GapsShape(len(mesh.vertices), body.n_shape, 16, 2)
    first, second = GapsNet(shape, basis), GapsNet(shape, basis)
    second.take_over(first.folded())
    features = torch.randn(2, 3, first.gru.input_size - body.n_shape)
    betas = torch.randn(2, body.n_shape)
    assert torch.allclose(first(features, betas)[0], second(features, betas)[0], atol=1e-6)
