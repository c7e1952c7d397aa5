"""The simulator: a sheet falls on a ball, a band is held, strangers keep apart, a skirt is carried along."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.constraints import Constraints, close_strangers
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stretch
from recon.cloth.solve import polish
from recon.cloth.xpbd import Carry, Settings, body_mesh, carry, settle
from recon.garments.panels import waistband
from tests.garments.synthetic import tube

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


@pytest.fixture(scope="module")
def skirt():
    """A skirt about a stump that goes 0.15 m aside and 0.05 m up: constraints, transport and the stump's frames."""
    garment = tube(cells=12)
    cloth, held = Cloth.from_garment(garment), waistband(garment)
    stump = trimesh.creation.cylinder(radius=1.0, height=0.7, sections=24).subdivide().subdivide()
    body = stump.vertices[:, [0, 2, 1]] * [0.13, 1.0, 0.10]
    way = np.linspace(0, 1, 9)[:, None, None] * [0.15, 0.05, 0.0]
    limits = Constraints.from_garment(garment, cloth, held)
    return cloth, limits, garment.mesh.vertices.double().numpy() + way, (body + way), stump.faces[:, ::-1]


def test_a_skirt_is_carried_along_by_a_moving_body(skirt) -> None:
    cloth, limits, transport, frames, faces = skirt
    path = list(carry(transport, limits, frames, faces, how=Carry(first_steps=100, steps=10, last_steps=100)))
    assert len(path) == len(frames) and all(np.isfinite(x).all() for x in path)
    for x, level in zip(path, transport[:, limits.held, 1]):
        assert np.abs(x[limits.held, 1] - level).max() < 1e-6
    contact = BodyContact(torch.tensor(frames[-1]), torch.tensor(faces.copy()))
    assert float(contact.signed_distance(torch.tensor(path[-1])).min()) > 0.003
    assert float(torch.quantile(stretch(cloth, torch.tensor(path[-1]).float()), 0.95)) < 1.04
    middle = (path[-1] - path[0]).mean(0)
    assert np.abs(middle - [0.15, 0.05, 0.0]).max() < 0.01


def test_open_cloth_beneath_has_no_sides_at_its_border() -> None:
    """A sheet whose lower half lies over a lower layer's upper border is not drawn down over that border's edge."""
    below, above = sheet(12, 8, 0.24, 0.16), sheet(6, 12, 0.06, 0.12)
    lower, upper = below.mesh.vertices.numpy(), above.mesh.vertices.numpy() + [0.09, 0.1, 0.002]
    lower = lower + np.array([0.0, 0.0, 0.05]) * np.maximum(lower[:, 1:2] - 0.1, 0)  # its border leans out
    cloth = Cloth.from_garment(above)
    limits = Constraints.from_garment(above, cloth, np.arange(12, 91, 13))
    still = [np.repeat(x[None], 2, 0) for x in (upper, lower)]
    end = list(carry(still[0], limits, still[1], below.mesh.faces.numpy(), how=Carry(first_steps=100, last_steps=100)))
    assert np.abs(end[-1][:, 1] - upper[:, 1]).max() < 0.004
    assert end[-1][:, 2].min() > 0.0


def test_carried_twice_the_same_and_the_body_carries_alone(skirt) -> None:
    """Where transport stands still, contact takes the cloth along."""
    _, limits, transport, frames, faces = skirt
    brief, stays = Carry(first_steps=20, steps=20, last_steps=50), np.repeat(transport[:1], 9, 0)
    ends = [list(carry(stays, limits, frames, faces, how=brief))[-1] for _ in range(2)]
    assert np.array_equal(*ends)
    assert (ends[0] - transport[0])[:, 0].mean() > 0.05
