"""ISP's draper: D_s on garments of any mesh, its training for a moment, and what comes of it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.train_drape_isp import TrainDrapeIsp, moving_joints, train_drape_isp
from pipelines.train_layers_isp import TrainLayersIsp, train_layers_isp
from recon.bodies import load_body
from recon.bodies.pose_prior import sample_poses
from recon.bodies.rig import JOINT_NAMES, axis_angles, rotation_matrices
from recon.cloth.energies import Cloth, stvk
from recon.draping import DRAPERS, Draper, load_draper
from recon.draping.drapenet import DrapeNets, DrapeShape
from recon.draping.isp import DisplacementNet, DisplacementShape, IspDraper, load_isp_draper, pose_features
from recon.draping.layering import load_layering
from recon.draping.uv import Box
from recon.files.weights import write_weights
from recon.garments import load_decoder
from recon.types import BodyPose, Garment, PosedBody, UserError


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def skirt():
    decoder = load_decoder("skirt")
    with torch.no_grad():
        return decoder.decode(decoder.codes[3], 40)


@pytest.fixture(scope="module")
def motions(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("motions")
    pose = np.zeros((12, 24, 3))
    pose[:, 1, 0] = np.linspace(-0.5, 0.5, 12)
    np.savez(folder / "step.npz", pose=pose, translation=np.zeros((12, 3)), fps=30)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory, motions: Path) -> tuple[Path, TrainDrapeIsp]:
    """Both networks after some steps."""
    out = tmp_path_factory.mktemp("weights")
    config = TrainDrapeIsp(
        "skirt", motions, out=out, steps=8, garments=3, vertices=300, bodies=2, worn=1, modes=60, rank=16, width=32
    )
    train_drape_isp(config)
    train_layers_isp(
        TrainLayersIsp(motions, weights=out, out=out, steps=2, garments=2, vertices=300, bodies=2, pairs=1)
    )
    return out, config


def draper_of(body, seed: int = 0) -> IspDraper:
    """An untrained network that does something."""
    torch.manual_seed(seed)
    shape = DisplacementShape(
        "skirt", (1, 2, 4, 5), body.n_shape, Box((-0.5, 0.2), (0.5, 1.1)), modes=40, rank=8, width=16
    )
    net = DisplacementNet(shape)
    torch.nn.init.normal_(net.out.weight, 0.0, 0.2)
    return IspDraper({"skirt": net}, body)


def raw(draper: IspDraper, garment: Garment, at: PosedBody) -> torch.Tensor:
    """The network's drape (B, V, 3) before its ending."""
    worn = draper.prepare(garment)
    moved = worn.displaced(draper.nets["skirt"](at.transforms, at.shape, worn.code))
    return worn.bound.place(moved, at.transforms, at.shape)


def posed(body, count: int = 2):
    g = torch.Generator().manual_seed(4)
    shape = 0.5 * torch.randn(count, body.n_shape, generator=g)
    return body.pose(BodyPose(shape, sample_poses(count, g), torch.zeros(count, 3)))


def test_without_displacement_it_is_skinning(body, skirt) -> None:
    draper = draper_of(body)
    torch.nn.init.zeros_(draper.nets["skirt"].out.weight)
    at = posed(body)
    found = draper.drape(skirt, at)
    assert isinstance(draper, Draper) and found.vertices.shape == (2, *skirt.mesh.vertices.shape)
    skinned = draper.prepare(skirt).ending(draper.skinning.drape(skirt, at).vertices, at)
    torch.testing.assert_close(found.vertices, skinned, atol=1e-5, rtol=0)


def test_the_last_rounds_take_strain_away(body, skirt) -> None:
    draper, at, cloth = draper_of(body), posed(body), Cloth.from_garment(skirt)
    assert (stvk(cloth, draper.drape(skirt, at).vertices) < 0.4 * stvk(cloth, raw(draper, skirt, at))).all()


def test_a_batch_is_its_bodies_one_by_one(body, skirt) -> None:
    draper, at = draper_of(body), posed(body)
    whole = draper.drape(skirt, at).vertices
    mesh = at.mesh.with_vertices(at.mesh.vertices[:1])
    first = replace(at, mesh=mesh, transforms=at.transforms[:1], shape=at.shape[:1])
    torch.testing.assert_close(draper.drape(skirt, first).vertices[0], whole[0], atol=1e-5, rtol=0)


def test_the_same_garment_on_a_finer_mesh_drapes_alike(body, skirt) -> None:
    draper, at = draper_of(body), posed(body, 1)
    decoder = load_decoder("skirt")
    with torch.no_grad():
        fine = decoder.decode(decoder.codes[3], 80)  # its grid holds the coarse one's
    inner = (skirt.border_labels < 0) & (skirt.side_of_point == 0)
    front = (fine.side_of_point == 0).nonzero()[:, 0]
    apart, at_fine = torch.cdist(skirt.panel_points[inner], fine.panel_points[front]).min(1)
    coarse, dense = raw(draper, skirt, at)[0], raw(draper, fine, at)[0]
    coarse, dense = coarse[skirt.vertex_of_point[inner]], dense[fine.vertex_of_point[front[at_fine]]]
    same = apart < 1e-3
    assert int(same.sum()) > 100
    plain = draper.skinning.drape(skirt, at).vertices[0][skirt.vertex_of_point[inner]]
    assert float((coarse - dense)[same].norm(dim=1).median()) < 0.1 * float((coarse - plain)[same].norm(dim=1).median())


def test_maps_are_read_at_the_panels_points(body, skirt) -> None:
    draper, at = draper_of(body), posed(body, 1)
    worn = draper.prepare(skirt)
    maps = draper.nets["skirt"](at.transforms, at.shape, worn.code)
    assert maps.shape[:3] == (1, 3, 2)
    plain = torch.ones_like(maps) * torch.tensor([0.01, 0.02, -0.03]).view(1, 3, 1, 1, 1)
    wanted = torch.tensor([0.01, 0.02, -0.03]).expand(1, len(skirt.mesh.vertices), 3)
    torch.testing.assert_close(worn.displaced(plain), wanted)


def test_gradients_reach_the_garment_and_the_pose(body, skirt) -> None:
    draper = draper_of(body)
    x = skirt.mesh.vertices.clone().requires_grad_()
    pose = torch.zeros(1, 24, 3).requires_grad_()
    at = body.pose(BodyPose(torch.zeros(1, body.n_shape), pose, torch.zeros(1, 3)))
    made = replace(skirt, mesh=skirt.mesh.with_vertices(x))
    draper.drape(made, at).vertices[..., 1].sum().backward()
    assert float(x.grad.abs().max()) > 0 and float(pose.grad[0, 1].abs().max()) > 0


def test_features_know_gravity_and_not_the_heading(body) -> None:
    pose = torch.zeros(2, 24, 3)
    pose[:, 1, 0] = 0.4
    pose[1, 0] = axis_angles(rotation_matrices(torch.tensor([0.0, 1.0, 0.0])))
    made = body.pose(BodyPose(torch.zeros(2, body.n_shape), pose, torch.zeros(2, 3)))
    first, second = pose_features(made.transforms, (1, 4))
    torch.testing.assert_close(first, second, atol=1e-5, rtol=0)
    assert first.shape == (15,) and first[-3:].tolist() == pytest.approx([0.0, -1.0, 0.0], abs=1e-5)


def test_moving_joints_hang_together() -> None:
    followed = torch.zeros(24)
    followed[JOINT_NAMES.index("l_knee")] = 0.4
    assert [JOINT_NAMES[j] for j in moving_joints(followed)] == ["l_hip", "l_knee"]


def test_training_is_kept_repeatable_and_drapes(trained, body, skirt, tmp_path) -> None:
    out, config = trained
    draper = load_draper("isp", body, out)
    assert isinstance(draper, IspDraper) and list(draper.nets) == ["skirt"] and draper.knows(skirt)
    assert draper.drape(skirt, posed(body)).vertices.isfinite().all()
    assert load_layering(out).net is not None
    again = train_drape_isp(replace(config, out=tmp_path))
    assert again.read_bytes() == (out / "drape-isp-skirt.safetensors").read_bytes()


def test_mistakes_are_told(trained, body, motions, tmp_path) -> None:
    decoder = load_decoder("trousers")
    with torch.no_grad():
        trousers = decoder.decode(decoder.codes[0], 32)
    with pytest.raises(UserError, match="trousers; it has learned skirt"):
        load_isp_draper(body, trained[0]).drape(trousers, posed(body, 1))
    with pytest.raises(UserError, match="found 'magic'"):
        load_draper("magic", body)
    with pytest.raises(UserError, match="--kind"):
        train_drape_isp(TrainDrapeIsp("hat", motions, out=tmp_path))
    with pytest.raises(UserError, match="drape-isp-KIND"):
        train_layers_isp(TrainLayersIsp(motions, weights=tmp_path, out=tmp_path))


@pytest.mark.parametrize("name", DRAPERS)
def test_every_draper_answers_alike(name: str, trained, body, skirt) -> None:
    if name == "drapenet":
        shape = DrapeShape(body.n_shape, width=16)
        card = {"shape": asdict(shape), "body": body.name, "parts": {}}
        write_weights("drapenet", dict(DrapeNets(shape).state_dict()), card, trained[0])
    draper = load_draper(name, body, trained[0])
    assert isinstance(draper, Draper)
    at = posed(body)
    found = draper.drape(skirt, at, under=[at.mesh])
    assert found.vertices.shape == (2, *skirt.mesh.vertices.shape) and torch.equal(found.faces, skirt.mesh.faces)
    assert float((found.vertices.mean(1) - at.joints[:, 0]).norm(dim=1).max()) < 0.6
