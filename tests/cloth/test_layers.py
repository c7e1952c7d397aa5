"""Layers over each other: sheets on a box, where the rest is known, and a sleeve beside a hip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.constraints import Constraints
from recon.cloth.contact import BodyContact
from recon.cloth.energies import GRAVITY, Cloth, Fabric
from recon.cloth.layers import LayeredCloth, stack
from recon.cloth.solve import ElasticEnergy, PolishSettings, lbfgs
from recon.types import Garment

SETTINGS = PolishSettings(apart=0.5)
OUTER, INNER = sheet(7, 7, 0.06, 0.06), sheet(10, 10, 0.1, 0.1)


def box(*centre: float) -> BodyContact:
    """A box 0.1 m high."""
    made = trimesh.creation.box((0.4, 0.1, 0.4))
    return BodyContact(torch.tensor(made.vertices + np.array(centre)), torch.tensor(made.faces))


def layered(
    garments: list[Garment],
    body: BodyContact,
    held: list[np.ndarray] | None = None,
    fabric: Fabric | None = None,
) -> LayeredCloth:
    cloths = [Cloth.from_garment(g, fabric) for g in garments]
    holds = held or [None] * len(garments)
    limits = [Constraints.from_garment(g, c, h) for g, c, h in zip(garments, cloths, holds)]
    return LayeredCloth(cloths, limits, body, SETTINGS)


def lying(garment: Garment, height: float) -> np.ndarray:
    """The sheet level at a height, its middle over the origin, facing up."""
    flat = garment.mesh.vertices.numpy()
    flat = flat - flat.mean(0)
    return np.stack([flat[:, 0], np.full(len(flat), height), -flat[:, 1]], 1)


def standing(garment: Garment, x: float) -> np.ndarray:
    """The sheet upright in the plane at ``x``, facing +x."""
    flat = garment.mesh.vertices.numpy()
    flat = flat - flat.mean(0)
    return np.stack([np.full(len(flat), x), flat[:, 1], -flat[:, 0]], 1)


@pytest.fixture
def scene() -> tuple[LayeredCloth, np.ndarray]:
    """Two sheets on a box whose top is y = 0, uneven; the outer one starts a millimetre beneath the inner."""
    physics = layered([OUTER, INNER], box(0.0, -0.05, 0.0))
    x = np.concatenate([lying(OUTER, 0.004), lying(INNER, 0.005)])
    x = x + 2e-4 * np.random.default_rng(0).standard_normal(x.shape)
    physics.touch(x)
    return physics, x


def settled(physics: LayeredCloth, x: np.ndarray, rounds: int = 5) -> np.ndarray:
    for _ in range(rounds):
        physics.touch(x)
        x = lbfgs(physics, x, 25, precondition=physics.preconditioner())
    return x


def test_gradient_is_finite_differences(scene) -> None:
    physics, x = scene
    rng, h = np.random.default_rng(1), 1e-8
    _, gradient = physics(x)
    for _ in range(5):
        step = rng.standard_normal(x.shape)
        along = (physics(x + h * step)[0] - physics(x - h * step)[0]) / (2 * h)
        assert (gradient * step).sum() == pytest.approx(along, rel=1e-4)


def test_layers_push_each_other(scene) -> None:
    physics, x = scene
    _, both = physics(x)
    alone = []
    for garment, part in zip((OUTER, INNER), physics.split(x)):
        one = layered([garment], box(0.0, -0.05, 0.0))
        one.touch(part)
        alone.append(one(part)[1])
    pull = physics.split(both - np.concatenate(alone))
    assert pull[0][:, 1].max() < 0 < pull[1][:, 1].max()  # gradients: the outer wants up, the inner down
    assert np.abs(pull[0].sum(0) + pull[1].sum(0)).max() < 1e-7 * np.abs(pull[0].sum(0)).max()  # weights are singles


def test_an_outer_sheet_beneath_the_inner_one_comes_out(scene) -> None:
    physics, x = scene
    end = settled(physics, x)
    outer, inner = physics.split(end)
    covered = np.abs(inner[:, [0, 2]]).max(1) < 0.03
    assert inner[:, 1].min() > 0.99 * SETTINGS.offset
    assert outer[:, 1].min() > inner[covered, 1].max() + 0.9 * SETTINGS.offset
    moved = [part[:, 1] for part in physics.split(end - x)]
    assert moved[0].mean() > 0.002 and moved[1][covered].mean() < -0.001
    assert physics(end)[0] < 1e-4 * physics(x)[0]


def test_a_single_layer_lies_on_the_body() -> None:
    physics = layered([INNER], box(0.0, -0.05, 0.0))
    x = settled(physics, lying(INNER, 0.001), rounds=3)
    assert np.abs(x[:, 1] - SETTINGS.offset).max() < 1e-5


def test_a_sleeve_beside_the_hip_covers_nothing() -> None:
    """Facing each other 8 mm apart, sheets leave each other alone; facing the same way, their order counts."""
    turned = replace(OUTER, mesh=replace(OUTER.mesh, faces=OUTER.mesh.faces.flip(1)))

    def contact(sleeve: Garment, at: float) -> float:
        physics = layered([sleeve, INNER], box(1.0, 0.0, 0.0))
        x = np.concatenate([standing(sleeve, at), standing(INNER, 0.0)])
        plain = physics(x)[0]
        physics.touch(x)
        return physics(x)[0] - plain

    assert contact(turned, 0.008) == 0.0
    assert contact(OUTER, 0.008) == 0.0
    assert contact(OUTER, -0.008) > contact(turned, -0.008) > 0.1


def test_a_held_waistband_keeps_its_height_while_the_rest_hangs() -> None:
    hem, waist = np.arange(0, 121, 11), np.arange(10, 121, 11)
    physics = layered([INNER], box(0.0, -1.0, 0.0), held=[waist])
    x = standing(INNER, 0.0)
    physics.hold(x)
    end = settled(physics, x, rounds=2)
    weight = GRAVITY * float(physics.cloth.masses.sum())
    assert np.abs(end[waist, 1] - x[waist, 1]).max() < 2 * weight / SETTINGS.stiffness
    assert (end[hem, 1] < x[hem, 1]).all() and np.isfinite(end).all()


def test_stacked_cloths_have_the_sum_of_their_energies() -> None:
    cloths = [Cloth.from_garment(g) for g in (OUTER, INNER)]
    rng = np.random.default_rng(3)
    parts = [g.mesh.vertices.numpy() + 0.003 * rng.standard_normal(g.mesh.vertices.shape) for g in (OUTER, INNER)]
    singles = [ElasticEnergy(c)(x) for c, x in zip(cloths, parts)]
    value, gradient = ElasticEnergy(stack(cloths))(np.concatenate(parts))
    assert value == pytest.approx(sum(v for v, _ in singles), rel=1e-12)
    assert np.abs(gradient - np.concatenate([g for _, g in singles])).max() < 1e-12 * np.abs(gradient).max()


def test_preconditioner_is_symmetric_and_positive(scene) -> None:
    physics, x = scene
    matrix = physics.preconditioner()(np.eye(len(x)))
    assert np.abs(matrix - matrix.T).max() < 1e-9 * np.abs(matrix).max()
    assert np.linalg.eigvalsh(matrix).min() > 0
    assert physics.touching.max() > 0


def test_preconditioning_reaches_the_same_rest_and_never_climbs() -> None:
    physics = layered([INNER], box(0.0, -0.05, 0.0))
    x = lying(INNER, 0.001) * [1.05, 1.0, 1.1]
    physics.touch(x)
    precondition = physics.preconditioner()
    ends = [lbfgs(physics, x, n, precondition=precondition) for n in (0, 1, 2, 4, 8, 16, 800)]
    values = [physics(end)[0] for end in ends]
    assert all(b <= a for a, b in zip(values, values[1:]))
    assert values[-1] == pytest.approx(physics(lbfgs(physics, x, 800))[0], rel=1e-3)


def test_preconditioning_is_sooner_where_cloth_hardly_stretches() -> None:
    large = sheet(24, 24, 0.5, 0.5)
    waist = np.arange(24, 625, 25)
    physics = layered([large], box(0.0, -1.0, 0.0), [waist], Fabric().scaled(stretch=30.0, bending=20.0))
    x = standing(large, 0.0)
    physics.hold(x)
    x[:, 2] *= 1.05 + 0.3 * x[:, 1]
    physics.touch(x)
    quick, slow = (physics(lbfgs(physics, x, 60, precondition=p))[0] for p in (physics.preconditioner(), None))
    assert quick < 0.2 * slow


def test_twice_the_same(scene) -> None:
    physics, x = scene
    assert np.array_equal(settled(physics, x, 2), settled(physics, x, 2))
