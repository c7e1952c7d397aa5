"""Dressing: a T-shirt over trousers, put on in the T pose and carried into another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.bodies.poses import a_pose
from recon.cloth.constraints import open_rim
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stretch
from recon.draping.dress import Dressing, dress, limits_of, neutral
from recon.draping.skinning import SkinningDraper
from recon.garments.dataset import load_garments
from recon.garments.panels import waistband
from recon.types import BodyPose, Garment

BODY = load_body()
DRAPER = SkinningDraper(BODY)
SETTINGS = Dressing(frames=5, steps=12)


def mild() -> BodyPose:
    """Arms half down, one leg a little forward, the whole body turned and put elsewhere."""
    pose = a_pose(1, 40.0)
    pose[0, 0, 1], pose[0, 1, 0] = 0.5, -0.2
    return BodyPose(torch.zeros(1, BODY.n_shape), pose, torch.tensor([[0.1, 0.0, -0.5]]))


@pytest.fixture(scope="module")
def garments() -> list[Garment]:
    shirt = next(g for g in load_garments("top", "test") if g.variant == "tshirt")
    return [shirt, next(g for g in load_garments("trousers", "test") if g.variant == "shorts")]


@pytest.fixture(scope="module")
def dressed(garments: list[Garment]) -> tuple[list[np.ndarray], list[int]]:
    heard: list[int] = []
    ends = dress(garments, BODY, mild(), DRAPER, SETTINGS, lambda frame, _: heard.append(frame))
    return ends, heard


def test_clothes_are_whole_and_outside_the_body(garments: list[Garment], dressed) -> None:
    ends, heard = dressed
    assert heard == 2 * list(range(SETTINGS.frames + 1))
    contact = BodyContact(BODY.pose(mild()).mesh.vertices[0], BODY.faces)
    for garment, x in zip(garments, ends, strict=True):
        assert x.shape == garment.mesh.vertices.shape and x.dtype == np.float64 and np.isfinite(x).all()
        assert not contact.penetrating(torch.tensor(x).float()).any()
        cloth = Cloth.from_garment(garment)
        assert torch.quantile(stretch(cloth, torch.tensor(x).float()), 0.95) < 1.05


def test_clothes_follow_the_pose(garments: list[Garment], dressed) -> None:
    skinned = DRAPER.drape(garments[0], BODY.pose(mild())).vertices[0].double().numpy()
    off = np.linalg.norm(dressed[0][0] - skinned, axis=1)
    assert np.median(off) < 0.015 and off.max() < 0.06


def test_a_waistband_stays_at_its_height(garments: list[Garment], dressed) -> None:
    held = waistband(garments[1])
    skinned = DRAPER.drape(garments[1], BODY.pose(mild())).vertices[0].numpy()
    assert np.abs(dressed[0][1][held, 1] - skinned[held, 1]).max() < 1e-3


def test_twice_the_same_and_alone_as_beneath(garments: list[Garment], dressed) -> None:
    """The garment beneath does not know what comes over it: dressed alone it lies bit by bit as before."""
    (alone,) = dress(garments[1:], BODY, mild(), DRAPER, SETTINGS)
    assert np.array_equal(alone, dressed[0][1])


def test_the_shirt_lies_over_the_waistband(garments: list[Garment], dressed) -> None:
    """The border beneath neither catches it nor draws it down over its edge."""
    shirt, shorts = (torch.tensor(x).float() for x in dressed[0])
    beneath = BodyContact(shorts, garments[1].mesh.faces)
    rim = torch.tensor(open_rim(garments[1].mesh.faces.numpy(), len(shorts)))
    face, weights, _ = beneath.closest(shirt)
    inner = ~(rim[garments[1].mesh.faces[face]] | (weights < 1e-3)).all(1)
    distance = beneath.signed_distance(shirt)
    near = inner & (distance.abs() < 0.01)
    assert near.sum() > 300 and (distance[near] > 0).float().mean() > 0.97


def test_limits_know_waistband_and_rest(garments: list[Garment]) -> None:
    shirt, shorts = (limits_of(g) for g in garments)
    assert not len(shirt.held) and np.array_equal(shorts.held, waistband(garments[1]))
    assert np.array_equal(shirt.rest, garments[0].mesh.vertices.double().numpy())


def test_neutral_is_the_t_pose_of_the_same_body() -> None:
    pose = mild()
    assert not neutral(pose).pose.any() and neutral(pose).shape is pose.shape
    assert replace(neutral(pose), pose=pose.pose) == pose
