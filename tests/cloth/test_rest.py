"""Cloth at rest: a closed form, refinement, contact, pins, and an energy that only falls."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.contact import BodyContact
from recon.cloth.energies import GRAVITY, Cloth, Fabric
from recon.cloth.rest import Resting, rest
from recon.cloth.solve import PolishSettings


def hanging(cells: int) -> tuple[Cloth, np.ndarray, np.ndarray]:
    """A square held at two corners that are a little closer than it is wide."""
    made = sheet(cells, cells, 1.0, 1.0)
    x = made.mesh.vertices.numpy().copy()
    pins = np.flatnonzero((x[:, 1] > 1 - 1e-9) & ((x[:, 0] < 1e-9) | (x[:, 0] > 1 - 1e-9)))
    x[:, 2] += 0.01 * np.sin(7 * x[:, 0]) * (1 - x[:, 1])
    x[pins, 0] += np.where(x[pins, 0] < 0.5, 0.1, -0.1)
    return Cloth.from_garment(made), x, pins


def test_a_hanging_strip_has_the_closed_form() -> None:
    """Without cross contraction every height s carries the weight below: Y lambda (lambda² - 1) / 2 = w s."""
    made = sheet(4, 16, 0.25, 1.0)
    fabric = Fabric(lame_lambda=0.0)
    x = made.mesh.vertices.numpy()
    found = rest(Cloth.from_garment(made, fabric), x, np.flatnonzero(x[:, 1] > 1 - 1e-9))
    modulus, weight = 2 * fabric.lame_mu * fabric.thickness, fabric.density * fabric.thickness * GRAVITY
    heights = np.linspace(0, 1, 1001)
    stretch = np.array([max(np.roots([modulus / 2, 0, -modulus / 2, -weight * s]).real) for s in heights])
    length = float(((stretch[1:] + stretch[:-1]) / 2).mean())
    assert found.converged and length > 1.03
    assert 1 - found.x[:, 1].min() == pytest.approx(length, rel=1e-3)


def test_pins_stay_and_energy_falls() -> None:
    cloth, x, pins = hanging(12)
    found = rest(cloth, x, pins, settings=Resting(search=50))
    assert found.converged and found.residual <= 0.02
    assert np.array_equal(found.x[pins], x[pins])
    assert all(b <= a for a, b in zip(found.energies, found.energies[1:]))
    assert found.energy < found.energies[0] - 0.1
    assert found.x[:, 1].min() < -0.08  # it sags


def test_stopping_early_is_told() -> None:
    cloth, x, pins = hanging(12)
    assert not rest(cloth, x, pins, settings=Resting(iterations=5)).converged


def over_a_ball() -> tuple[Cloth, np.ndarray, BodyContact]:
    """A square just above a ball that it will hang over."""
    made = sheet(24, 24, 0.7, 0.7)
    flat = made.mesh.vertices.numpy()
    x = np.column_stack([flat[:, 0] - 0.35, np.full(len(flat), 0.206), 0.35 - flat[:, 1]])
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    body = BodyContact(torch.as_tensor(np.array(ball.vertices)), torch.as_tensor(np.array(ball.faces)))
    return Cloth.from_garment(made), x, body


def test_cloth_on_a_ball_comes_to_rest() -> None:
    cloth, x, body = over_a_ball()
    found = rest(cloth, x, body=body, settings=Resting(tolerance=0.05, friction=0.3))
    assert found.converged and found.residual <= 0.05
    away = np.linalg.norm(found.x, axis=1)
    assert away.min() > 0.2 and found.x[:, 1].min() < -0.02
    assert found.energy < found.energies[0]
    assert all(b <= a for a, b in zip(found.energies, found.energies[1:]))
    middle = np.linalg.norm(x, axis=1).argmin()
    assert found.x[middle, 1] == pytest.approx(0.2035, abs=2e-3)  # it lies on top


def test_without_friction_nothing_stays_on_a_ball() -> None:
    """Turned about the ball's centre, which its own centre lies above, cloth comes down: no rest is stable."""
    cloth, x, body = over_a_ball()
    found = rest(cloth, x, body=body, settings=Resting(tolerance=0.05, iterations=450))
    assert not found.converged and found.x[:, 1].mean() < -0.2
    assert all(b <= a for a, b in zip(found.energies, found.energies[1:]))


def tilted(angle: float) -> tuple[Cloth, np.ndarray, BodyContact, np.ndarray]:
    """A small sheet lying just over a large plane that falls by ``angle`` [rad] along x; last, the way down."""
    made = sheet(6, 6, 0.1, 0.1)
    flat = made.mesh.vertices.numpy() - [0.05, 0.05, 0.0]
    down, up = np.array([np.cos(angle), -np.sin(angle), 0]), np.array([np.sin(angle), np.cos(angle), 0])
    across = np.cross(down, up)
    corners = np.array([-down - across, -down + across, down + across, down - across]) * 5
    plane = BodyContact(torch.as_tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    assert float(plane.signed_distance(torch.as_tensor(up[None]))[0]) > 0
    x = flat[:, :1] * down + flat[:, 1:2] * -across + 0.0034 * up
    return Cloth.from_garment(made), x, plane, down


def test_friction_holds_cloth_on_a_slope_as_coulomb_says() -> None:
    """On a plane of angle a cloth slides if and only if tan a > mu; held, it creeps by slip tan a / mu."""
    cloth, x, plane, down = tilted(np.arctan(0.5))
    soft = PolishSettings(stiffness=1.0)  # as soft as friction, or sliding takes for ever
    held = rest(cloth, x, body=plane, settings=Resting(tolerance=0.01, search=20, friction=0.6, contact=soft))
    assert held.converged
    crept = ((held.x - x) @ down).mean()
    assert crept == pytest.approx(soft.slip * 0.5 / 0.6, rel=0.1)
    slid = rest(cloth, x, body=plane, settings=Resting(tolerance=0.01, iterations=400, friction=0.4, contact=soft))
    assert not slid.converged
    assert ((slid.x - x) @ down).mean() > 10 * crept


def on_another(angle: float) -> tuple[list[Cloth], np.ndarray, np.ndarray, np.ndarray]:
    """A small sheet lying just over a large one that falls by ``angle`` [rad]: cloths, (V, 3), the lower one's
    vertices and the way down."""
    small, large = sheet(6, 6, 0.1, 0.1), sheet(12, 12, 0.3, 0.3)
    down, up = np.array([np.cos(angle), -np.sin(angle), 0]), np.array([np.sin(angle), np.cos(angle), 0])
    parts = []
    for made, height in ((small, 0.0034), (large, 0.0)):
        flat = made.mesh.vertices.numpy() - made.mesh.vertices.numpy().mean(0)
        parts.append(flat[:, :1] * down - flat[:, 1:2] * np.cross(down, up) + height * up)
    under = np.arange(len(parts[0]), len(parts[0]) + len(parts[1]))
    return [Cloth.from_garment(small), Cloth.from_garment(large)], np.concatenate(parts), under, down


def test_friction_between_layers_is_coulombs_too() -> None:
    """On a layer of slope tan a that is pinned a layer slides if and only if tan a > mu."""
    cloths, x, under, down = on_another(np.arctan(0.5))
    soft, top = PolishSettings(stiffness=1.0), len(cloths[0].masses)
    held = rest(cloths, x, under, settings=Resting(tolerance=0.01, search=20, friction=0.6, contact=soft))
    assert held.converged and np.array_equal(held.x[under], x[under])
    crept = ((held.x - x)[:top] @ down).mean()
    assert crept == pytest.approx(soft.slip * 0.5 / 0.6, rel=0.1)
    assert all(b <= a for a, b in zip(held.energies, held.energies[1:]))
    slid = rest(cloths, x, under, settings=Resting(tolerance=0.01, iterations=400, friction=0.4, contact=soft))
    assert not slid.converged
    assert ((slid.x - x)[:top] @ down).mean() > 10 * crept


def test_layers_hold_each_other_on_a_slope() -> None:
    """The lower layer, itself held by friction alone, carries the upper one; what is no rougher than that slides."""
    angle = np.arctan(0.5)
    cloths, x, under, down = on_another(angle)
    _, _, plane, _ = tilted(angle)
    x += 0.0034 * np.array([np.sin(angle), np.cos(angle), 0])
    soft = PolishSettings(stiffness=1.0)
    held = rest(cloths, x, None, plane, Resting(tolerance=0.02, search=20, friction=0.6, contact=soft))
    assert held.converged
    assert np.abs((held.x - x) @ down).max() < 3 * soft.slip
