"""The minimiser: contacts against closed forms and finite differences, and what a preconditioner may and may not do."""

from __future__ import annotations

import numpy as np
import pytest
from sheets import sheet

from recon.cloth.energies import Cloth
from recon.cloth.solve import Contacts, ElasticEnergy, PolishSettings, lbfgs

SETTINGS = PolishSettings(offset=0.004, stiffness=5e3)
GARMENT = sheet(6, 4, 0.3, 0.2)
FLAT = GARMENT.mesh.vertices.numpy()
DOWN = np.tile([0.0, 0.0, -1.0], (35, 1))
ABOVE = np.full((2, 3), 1 / 3) + [[0.1, -0.05, -0.05], [0.0, 0.2, -0.2]]
CONTACTS = {
    "plane": Contacts(vertex=np.arange(35), point=FLAT, normal=DOWN),
    "pair": Contacts(pair=np.array([[0, 34], [3, 21], [4, 5]]), apart=np.array([0.4, 0.3, 0.01])),
    "over": Contacts(over=np.array([[7, 0, 5, 6], [30, 12, 17, 18]]), weights=ABOVE, direction=DOWN[:2]),
}


def crumpled(seed: int = 0) -> np.ndarray:
    return FLAT + 0.01 * np.random.default_rng(seed).standard_normal(FLAT.shape)


@pytest.fixture
def energy() -> ElasticEnergy:
    return ElasticEnergy(Cloth.from_garment(GARMENT))


@pytest.mark.parametrize("names", [("plane",), ("pair",), ("over",), ("plane", "pair", "over")])
def test_contact_gradients_are_finite_differences(names: tuple[str, ...], energy: ElasticEnergy) -> None:
    x, rng = crumpled(), np.random.default_rng(1)
    without, _ = energy(x)
    energy.touch(Contacts.join([CONTACTS[n] for n in names]), SETTINGS)
    value, gradient = energy(x)
    assert value > without + 1e-3
    for _ in range(5):
        step, h = rng.standard_normal(x.shape), 1e-7
        along = (energy(x + h * step)[0] - energy(x - h * step)[0]) / (2 * h)
        assert (gradient * step).sum() == pytest.approx(along, rel=1e-4)


def test_contact_energies_are_the_closed_form(energy: ElasticEnergy) -> None:
    x = crumpled()
    plain = energy(x)[0]
    plane = SETTINGS.offset - ((x - FLAT) * DOWN).sum(1)
    pair = CONTACTS["pair"]
    near = pair.apart - np.linalg.norm(x[pair.pair[:, 0]] - x[pair.pair[:, 1]], axis=1)
    over = CONTACTS["over"]
    below = (x[over.over[:, 1:]] * over.weights[..., None]).sum(1)
    deep = SETTINGS.offset - ((x[over.over[:, 0]] - below) * over.direction).sum(1)
    for name, depth in (("plane", plane), ("pair", near), ("over", deep)):
        energy.touch(CONTACTS[name], SETTINGS)
        wanted = SETTINGS.stiffness * (np.maximum(depth, 0) ** 2).sum()
        assert energy(x)[0] - plain == pytest.approx(wanted, rel=1e-6), name


@pytest.mark.parametrize("name", ["pair", "over"])
def test_what_cloth_does_to_cloth_comes_back(name: str, energy: ElasticEnergy) -> None:
    x = crumpled()
    _, plain = energy(x)
    energy.touch(CONTACTS[name], SETTINGS)
    pull = energy(x)[1] - plain
    assert np.abs(pull).max() > 0.1 and np.abs(pull.sum(0)).max() < 1e-9


def test_nothing_touches_what_keeps_its_distance(energy: ElasticEnergy) -> None:
    far = [
        Contacts(vertex=np.arange(35), point=FLAT - 0.1, normal=-DOWN),
        Contacts(pair=np.array([[0, 34]]), apart=np.array([0.01])),
        Contacts(over=CONTACTS["over"].over, weights=ABOVE, direction=DOWN[:2] * [1, 1, 0] + [0.0, 1.0, 0.0]),
    ]
    value, gradient = energy(FLAT)
    energy.touch(Contacts.join(far[:2]), SETTINGS)
    assert energy(FLAT)[0] == value and np.array_equal(energy(FLAT)[1], gradient)
    assert Contacts.join(far).over.shape == (2, 4) and Contacts.join([Contacts()]).pair.shape == (0, 2)


def springs(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """The stiffness matrix of a chain of springs, and the inverse of nearly the same."""
    chain = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    return chain + np.diag(np.linspace(0, 0.01, count)), np.linalg.inv(chain + 1e-3 * np.eye(count))


def test_preconditioned_lbfgs_finds_the_same_minimum_sooner() -> None:
    matrix, inverse = springs()
    wanted = np.random.default_rng(2).standard_normal((60, 3))

    def bowl(x: np.ndarray) -> tuple[float, np.ndarray]:
        off = x - wanted
        return 0.5 * float((off * (matrix @ off)).sum()), matrix @ off

    def solve(iterations: int, **options) -> np.ndarray:
        return lbfgs(bowl, np.zeros((60, 3)), iterations, **options)

    quick = {"precondition": lambda q: inverse @ q, "longest": 10.0}
    assert np.abs(solve(400) - wanted).max() < 1e-4
    assert np.abs(solve(40, **quick) - wanted).max() < 1e-4
    assert bowl(solve(12, **quick))[0] < 0.1 * bowl(solve(12))[0]


def test_preconditioned_lbfgs_never_climbs_and_takes_no_long_steps() -> None:
    energy, longest = ElasticEnergy(Cloth.from_garment(GARMENT)), 0.002
    energy.touch(Contacts.join(list(CONTACTS.values())), SETTINGS)
    ends = [lbfgs(energy, crumpled(), n, precondition=lambda q: q / 50, longest=longest) for n in range(12)]
    values = [energy(x)[0] for x in ends]
    assert all(b <= a for a, b in zip(values, values[1:])) and values[-1] < 0.7 * values[0]
    assert max(np.abs(b - a).max() for a, b in zip(ends, ends[1:])) <= longest * (1 + 1e-12)


def test_preconditioned_lbfgs_stays_where_every_step_is_worse() -> None:
    def wall(x: np.ndarray) -> tuple[float, np.ndarray]:
        return (float("nan"), x) if np.abs(x).max() > 1e-9 else (0.0, np.ones_like(x))

    assert np.array_equal(lbfgs(wall, np.zeros((4, 3)), 5, precondition=lambda q: q), np.zeros((4, 3)))
