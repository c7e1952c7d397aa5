"""Cloth energies against closed forms, finite differences and the compiled kernel."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from sheets import sheet

from recon.cloth.energies import GRAVITY, Cloth, Fabric, bend_angles, bending, gravity, strain, stretch, stvk
from recon.cloth.solve import ElasticEnergy, lbfgs


@pytest.fixture
def cloth() -> Cloth:
    return Cloth.from_garment(sheet(6, 4, 0.3, 0.2))


@pytest.fixture
def flat() -> torch.Tensor:
    return sheet(6, 4, 0.3, 0.2).mesh.vertices


def crumpled(x: torch.Tensor, size: float = 0.01) -> torch.Tensor:
    return x + size * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)


def test_rest_state_has_no_energy(cloth: Cloth, flat: torch.Tensor) -> None:
    assert stvk(cloth, flat) == pytest.approx(0, abs=1e-20)
    assert bending(cloth, flat) == pytest.approx(0, abs=1e-20)
    assert torch.allclose(stretch(cloth, flat), torch.ones(len(cloth.faces), dtype=flat.dtype))
    assert float(cloth.areas.sum()) == pytest.approx(0.06)


def test_uniform_stretch_is_the_closed_form(cloth: Cloth, flat: torch.Tensor) -> None:
    e, f = 0.1, cloth.fabric
    green = ((1 + e) ** 2 - 1) / 2
    wanted = f.thickness * 0.06 * (f.lame_mu * green**2 + f.lame_lambda / 2 * green**2)
    wider = flat * torch.tensor([1 + e, 1.0, 1.0], dtype=torch.float64)
    assert float(stvk(cloth, wider)) == pytest.approx(wanted, rel=1e-9)


def test_shear_is_the_closed_form(cloth: Cloth, flat: torch.Tensor) -> None:
    shear, f = 0.2, cloth.fabric
    x = flat.clone()
    x[:, 0] += shear * flat[:, 1]
    green = torch.tensor([[0.0, shear / 2], [shear / 2, shear**2 / 2]], dtype=torch.float64)
    assert torch.allclose(strain(cloth, x), green.expand(len(cloth.faces), 2, 2))
    wanted = f.thickness * 0.06 * (f.lame_mu * (green**2).sum() + f.lame_lambda / 2 * green.trace() ** 2)
    assert float(stvk(cloth, x)) == pytest.approx(float(wanted), rel=1e-9)


def test_moving_and_turning_costs_nothing(cloth: Cloth, flat: torch.Tensor) -> None:
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    x = crumpled(flat)
    for energy in (stvk, bending):
        assert float(energy(cloth, x @ turn.T + 1.0)) == pytest.approx(float(energy(cloth, x)), rel=1e-9)


def test_bending_into_a_cylinder_is_the_closed_form() -> None:
    """A strip rolled to radius R: every cross edge bends by width / n / R; SNUG's weights add l² / (4 · 2 areas)."""
    n, width, height, radius = 64, 0.4, 0.05, 0.1
    garment = sheet(n, 1, width, height)
    cloth, flat = Cloth.from_garment(garment), garment.mesh.vertices
    angle = flat[:, 0] / radius
    x = torch.stack([radius * angle.sin(), flat[:, 1], radius * (1 - angle.cos())], 1)
    step = width / n
    across = height**2 / (4 * step * height) * (step / radius) ** 2 * (n - 1)
    assert float(bending(cloth, x)) == pytest.approx(cloth.fabric.bending * across, rel=0.01)
    assert float(bend_angles(cloth, x).abs().max()) == pytest.approx(step / radius, rel=0.01)


def test_gravity_is_weight_times_height(cloth: Cloth, flat: torch.Tensor) -> None:
    mass = 0.06 * cloth.fabric.density * cloth.fabric.thickness
    assert float(cloth.masses.sum()) == pytest.approx(mass)
    lifted = flat + torch.tensor([0.0, 2.0, 0.0])
    assert float(gravity(cloth, lifted) - gravity(cloth, flat)) == pytest.approx(2 * mass * GRAVITY)


@pytest.mark.parametrize("energy", [stvk, bending, gravity])
def test_gradients_are_finite_differences(energy, cloth: Cloth, flat: torch.Tensor) -> None:
    x = crumpled(flat).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p: energy(cloth, p) * 1e4, (x,), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_batches_are_single_energies(cloth: Cloth, flat: torch.Tensor) -> None:
    both = torch.stack([crumpled(flat), crumpled(flat, 0.02)])
    for energy in (stvk, bending, gravity):
        assert torch.allclose(energy(cloth, both), torch.stack([energy(cloth, x) for x in both]))


def test_degenerate_triangles_and_hinges_give_finite_gradients(cloth: Cloth, flat: torch.Tensor) -> None:
    collapsed = torch.zeros_like(flat).requires_grad_(True)
    folded = (flat * torch.tensor([1.0, 0.0, 0.0])).requires_grad_(True)
    for x in (collapsed, folded):
        (gradient,) = torch.autograd.grad(stvk(cloth, x) + bending(cloth, x), x)
        assert torch.isfinite(gradient).all()
    garment = sheet(2, 2, 0.1, 0.1)
    points = garment.panel_points.clone()
    points[4] = points[0]
    broken = Cloth.from_garment(replace(garment, panel_points=points))
    assert torch.isfinite(stvk(broken, garment.mesh.vertices))
    assert torch.isfinite(bending(broken, garment.mesh.vertices))


def test_snug_constants_follow_from_young_and_poisson() -> None:
    young, poisson, f = 0.7e5, 0.485, Fabric()
    assert f.lame_mu == pytest.approx(young / (2 * (1 + poisson)), rel=1e-3)
    assert f.lame_lambda == pytest.approx(young * poisson / (1 - poisson**2), rel=1e-3)
    assert f.scaled(stretch=2.0, bending=3.0).lame_mu == 2 * f.lame_mu


def test_compiled_energy_and_gradient_are_autograd(cloth: Cloth, flat: torch.Tensor) -> None:
    x = crumpled(flat).requires_grad_(True)
    energy = stvk(cloth, x) + bending(cloth, x) + gravity(cloth, x)
    (gradient,) = torch.autograd.grad(energy, x)
    value, by_hand = ElasticEnergy(cloth)(x.detach().numpy())
    assert value == pytest.approx(float(energy), rel=1e-10)
    assert np.abs(by_hand - gradient.numpy()).max() < 1e-10 * float(gradient.abs().max())


def test_lbfgs_finds_a_minimum_and_never_climbs() -> None:
    scale = np.linspace(1, 100, 30).reshape(10, 3)

    def bowl(x):
        return float((scale * (x - math.pi) ** 2).sum()), 2 * scale * (x - math.pi)

    assert np.abs(lbfgs(bowl, np.zeros((10, 3)), 60) - math.pi).max() < 1e-5

    def wall(x):
        return (float("nan"), x) if np.abs(x).max() > 1e-6 else (0.0, np.ones_like(x))

    assert np.array_equal(lbfgs(wall, np.zeros((4, 3)), 5), np.zeros((4, 3)))
