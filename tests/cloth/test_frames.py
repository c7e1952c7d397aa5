"""Energies of many frames: the kernel against its slow twins, gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from sheets import sheet

from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, bend_angles, bending, collision, gravity, inertia, stvk, towards_template
from recon.cloth.frames import FramePhysics, FrameWeights
from recon.cloth.inextensible import OneRings, inextensibility, relaxation
from recon.types import Mesh

GARMENT = sheet(7, 5, 0.07, 0.05)
FLAT, FACES = GARMENT.mesh.vertices.double(), GARMENT.mesh.faces
WEIGHTS = FrameWeights(collision=1e4, margin=0.006, inextensibility=1e-4, steep=0.007)
FRAMES = 3


def floor(height: float) -> torch.Tensor:
    """A wide tetrahedron whose upper face lies at ``height``."""
    points = [[-2.0, -2.0, 0.0], [2.0, -2.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, -2.0]]
    return torch.tensor(points) + torch.tensor([0.0, 0.0, height])


FLOOR_FACES = torch.tensor([[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]])
BODIES = torch.stack([floor(h) for h in (-0.5, 0.0, 0.001)])


def crumpled(seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return FLAT + 0.003 * torch.randn(FRAMES, *FLAT.shape, generator=g, dtype=torch.float64)


@pytest.fixture(scope="module")
def cloth() -> Cloth:
    made = Cloth.from_garment(GARMENT)
    return towards_template(made, crumpled(9)[0], torch.linspace(0, 1, len(made.hinges), dtype=torch.float64))


@pytest.fixture(scope="module")
def physics(cloth: Cloth) -> FramePhysics:
    return FramePhysics(cloth, OneRings.of(FLAT, FACES), Mesh(floor(0.0), FLOOR_FACES), WEIGHTS, FRAMES)


@pytest.mark.parametrize("epoch", [0, 40])
def test_terms_are_those_of_the_slow_twins(epoch: int, physics: FramePhysics, cloth: Cloth) -> None:
    x, rings = crumpled(), OneRings.of(FLAT, FACES)
    energy, terms = physics(x, BODIES, epoch)
    distance = torch.stack([BodyContact(b, FLOOR_FACES).signed_distance(p) for b, p in zip(BODIES, x, strict=True)])
    depth = (WEIGHTS.margin - distance).clamp_min(0)
    assert int((depth > 0).sum()) > 20
    wanted = {
        "strain": stvk(cloth, x),
        "bending": bending(cloth, x),
        "gravity": gravity(cloth, x),
        "collision": collision(depth, WEIGHTS.collision, WEIGHTS.steep),
        "inextensibility": WEIGHTS.inextensibility
        * inextensibility(rings, x, relaxation((-distance).clamp_min(0), epoch)),
    }
    for name, value in wanted.items():
        torch.testing.assert_close(terms[name], value, rtol=2e-4, atol=1e-9, msg=name)
    torch.testing.assert_close(energy, sum(terms.values()).to(energy))


def test_gradients_are_finite_differences(physics: FramePhysics) -> None:
    x = crumpled(1).requires_grad_()
    energy, _ = physics(x, BODIES, 0)
    (slope,) = torch.autograd.grad(energy.sum(), x)
    for seed in range(4):
        step = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        h = 2e-6
        along = (physics(x + h * step, BODIES, 0)[0] - physics(x - h * step, BODIES, 0)[0]).sum() / (2 * h)
        assert (slope * step).sum().item() == pytest.approx(float(along), rel=5e-3)


def test_bodies_may_move_between_calls(physics: FramePhysics) -> None:
    x = crumpled(2)
    before = physics(x, BODIES)[1]["collision"]
    away = physics(x, BODIES - 1)[1]["collision"]
    assert float(before.max()) > 0 and float(away.abs().max()) == 0
    torch.testing.assert_close(physics(x, BODIES)[1]["collision"], before)


def test_another_garment_shares_the_bodies(physics: FramePhysics) -> None:
    other = sheet(5, 5, 0.05, 0.05)
    cloth, rings = Cloth.from_garment(other), OneRings.of(other.mesh.vertices.double(), other.mesh.faces)
    both, alone = (
        physics.dressed(cloth, rings),
        FramePhysics(cloth, rings, Mesh(floor(0.0), FLOOR_FACES), WEIGHTS, FRAMES),
    )
    x = other.mesh.vertices.double().expand(FRAMES, -1, -1)
    physics(crumpled(2), BODIES)  # poses the bodies for both
    torch.testing.assert_close(both(x)[0], alone(x, BODIES)[0])


def test_wrong_sizes_are_refused(physics: FramePhysics) -> None:
    with pytest.raises(ValueError, match="wanted"):
        physics(crumpled()[:2], BODIES[:2])


def test_template_balance_is_equation_12(cloth: Cloth) -> None:
    made = Cloth.from_garment(GARMENT)
    template, x = crumpled(3)[0], crumpled(4)[0]
    balance = torch.rand(len(made.hinges), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    bent, rest = bend_angles(made, x), bend_angles(made, template)
    terms = balance * (bent - rest) ** 2 + (1 - balance) * bent**2
    wanted = made.fabric.bending * (made.hinge_weights * terms).sum()
    constant = made.fabric.bending * (made.hinge_weights * balance * (1 - balance) * rest**2).sum()
    torch.testing.assert_close(bending(towards_template(made, template, balance), x) + constant, wanted)


def test_free_flight_costs_nothing(cloth: Cloth) -> None:
    x, v = crumpled(6)[0], torch.tensor([0.01, 0.0, -0.02], dtype=torch.float64)
    assert float(inertia(cloth, x + 2 * v, x + v, x, 1 / 30)) == pytest.approx(0, abs=1e-15)
    pushed = inertia(cloth, x + 2 * v + torch.tensor([0.0, 0.01, 0.0]), x + v, x, 1 / 30)
    assert float(pushed) == pytest.approx(0.5 * float(cloth.masses.sum()) * 0.01**2 * 30**2, rel=1e-6)
