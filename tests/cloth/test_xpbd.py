"""The simulator: a sheet falls on a ball, a band is held, strangers keep apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stretch
from recon.cloth.solve import polish
from recon.cloth.xpbd import Constraints, Settings, body_mesh, close_strangers, settle

SHORT = Settings(fit_steps=40, fall_steps=500, rest_steps=200)


@pytest.fixture(scope="module")
def scene():
    """A square sheet lying over a ball, and what binds it."""
    garment = sheet(16, 16, 0.4, 0.4)
    cloth = Cloth.from_garment(garment)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    start = garment.mesh.vertices.numpy()[:, [0, 2, 1]] * [1, 1, -1] + [-0.2, 0.11, 0.2]
    hinges = cloth.hinges.numpy()
    spans = np.linalg.norm(start[hinges[:, 2]] - start[hinges[:, 3]], axis=1)
    limits = Constraints(cloth.edges.numpy(), cloth.edge_lengths.numpy(), hinges[:, 2:], spans, start)
    return cloth, ball, start, limits


def test_a_sheet_falls_over_a_ball_and_stays_outside(scene) -> None:
    cloth, ball, start, limits = scene
    x = settle(start, limits, body_mesh(ball.vertices, ball.faces), SHORT)
    contact = BodyContact(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    assert float(contact.signed_distance(torch.tensor(x)).min()) > 0.002
    assert x[:, 1].min() < 0.0 and 0.1 < x[:, 1].max() < 0.12
    assert float(torch.quantile(stretch(cloth, torch.tensor(x)), 0.95)) < 1.06


def test_twice_the_same(scene) -> None:
    _, ball, start, limits = scene
    short = replace(SHORT, fall_steps=60, rest_steps=20)
    runs = [settle(start, limits, body_mesh(ball.vertices, ball.faces), short) for _ in range(2)]
    assert np.array_equal(*runs)


def test_held_vertices_keep_their_height_and_legs_their_side(scene) -> None:
    _, ball, start, limits = scene
    held, side = np.arange(17), np.zeros(len(start))
    side[200:], start = 1.0, start.copy()
    bound = replace(limits, held=held, side=side)
    x = settle(start, bound, body_mesh(ball.vertices, ball.faces), replace(SHORT, fall_steps=100))
    assert np.abs(x[held, 1] - start[held, 1].mean()).max() < 1e-5
    assert x[200:, 0].min() > 0.0014


def test_polish_lowers_the_energy_and_keeps_off_the_body(scene) -> None:
    from recon.cloth.energies import bending, gravity, stvk

    cloth, ball, start, limits = scene
    x = settle(start, limits, body_mesh(ball.vertices, ball.faces), SHORT)
    contact = BodyContact(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    y = polish(cloth, x, contact, limits)

    def energy(p):
        p = torch.tensor(p)
        return float(stvk(cloth, p) + bending(cloth, p) + gravity(cloth, p))

    assert energy(y) < energy(x)
    assert float(contact.signed_distance(torch.tensor(y)).min()) > 0.0


def test_strangers_are_close_in_space_and_far_in_the_pattern() -> None:
    x = np.array([[0.0, 0, 0], [0.005, 0, 0], [0.0, 0.004, 0]])
    rest = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.5, 0, 0]])
    assert {tuple(sorted(p)) for p in close_strangers(x, rest, 0.008).tolist()} == {(0, 2), (1, 2)}
    assert close_strangers(x * 100, rest, 0.008).shape == (0, 2)
