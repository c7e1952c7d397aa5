"""The stand-in for the Hessian: exact where nothing is left out, positive everywhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sheets import sheet

from recon.cloth.curvature import Curvature, angle_changes
from recon.cloth.energies import Cloth, bend_angles
from recon.cloth.solve import Contacts, ElasticEnergy, PolishSettings

SETTINGS = PolishSettings(offset=0.004, stiffness=20.0)
GARMENT = sheet(6, 4, 0.3, 0.2)
CLOTH = Cloth.from_garment(GARMENT)
FLAT = GARMENT.mesh.vertices.numpy()
UP = np.tile([0.0, 0.0, 1.0], (3, 1))
TOUCHING = Contacts(
    vertex=np.array([2, 9, 20]),
    point=FLAT[[2, 9, 20]] - 0.001 * UP,
    normal=UP,
    over=np.array([[30, 12, 17, 18]]),
    weights=np.full((1, 3), 1 / 3),
    direction=UP[:1],
    stuck=np.array([[2, 0, 0, 0], [30, 12, 17, 18]]),
    share=np.array([[0.0, 0, 0], [0.3, 0.3, 0.4]]),
    anchor=np.stack([FLAT[2] * 1.05, FLAT[30] * 1.05 - [0.3, 0.3, 0.4] @ FLAT[[12, 17, 18]] * 1.05]) + [1e-5, 0, 0],
    across=UP[:2],
    grip=np.array([0.1, 0.2]),
)


@pytest.mark.parametrize("contacts", [Contacts(), TOUCHING], ids=["alone", "touching"])
def test_it_is_the_hessian_of_cloth_that_is_flat_and_pulled(contacts: Contacts) -> None:
    energy, x, rng, h = ElasticEnergy(CLOTH), 1.05 * FLAT, np.random.default_rng(0), 1e-7
    energy.touch(contacts, SETTINGS)
    held = np.array([0, 4, 34])  # else it could move as a whole
    solve = Curvature(CLOTH).solve(x, contacts, SETTINGS, held, 0.0)
    for _ in range(3):
        step = rng.standard_normal(x.shape)
        step[held] = 0
        change = (energy(x + h * step)[1] - energy(x - h * step)[1]) / (2 * h)
        assert np.abs(solve(change) - step).max() < 0.02 * np.abs(step).max()


def test_it_is_positive_where_cloth_is_crumpled() -> None:
    x = FLAT + 0.02 * np.random.default_rng(1).standard_normal(FLAT.shape)
    solve = Curvature(CLOTH).solve(x, TOUCHING, SETTINGS, np.array([0, 1]), 0.1)
    rng = np.random.default_rng(2)
    for _ in range(20):
        q = rng.standard_normal(x.shape)
        out = solve(q)
        assert np.isfinite(out).all() and not out[:2].any()
        assert (out * q).sum() > 0


def test_angles_change_as_finite_differences_say_and_degenerate_ones_do_not() -> None:

    rng, h = np.random.default_rng(3), 1e-7
    x, hinges = FLAT + 0.005 * rng.standard_normal(FLAT.shape), CLOTH.hinges.numpy()
    step = rng.standard_normal(x.shape)
    ahead, behind = (bend_angles(CLOTH, torch.from_numpy(x + s * h * step)).numpy() for s in (1, -1))
    along = (angle_changes(x, hinges) * step[hinges]).sum((1, 2))
    assert np.abs((ahead - behind) / (2 * h) - along).max() < 1e-4 * np.abs(along).max()
    assert not angle_changes(np.zeros_like(x), hinges).any()
