"""Projective steps: what fits stays, stretch goes, cloth leaves the body, held and hopeless vertices stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, stvk
from recon.cloth.projective import Projecting, Projective
from recon.types import Mesh, PosedBody

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
FAR = torch.tensor([0.0, -9.0, 0.0])
PARTS = torch.eye(24)


def ball(at: torch.Tensor, count: int = 1, part: int = 0) -> PosedBody:
    """``count`` balls at a place, of one part."""
    vertices = torch.as_tensor(np.array(BALL.vertices), dtype=torch.float32) + at
    mesh = Mesh(vertices.expand(count, -1, -1), torch.as_tensor(np.array(BALL.faces)))
    none = torch.zeros(count, 0)
    return PosedBody(mesh, mesh, none, none, PARTS[part].expand(len(vertices), -1), none)


@pytest.fixture(scope="module")
def flat():
    made = sheet(20, 20, 0.4, 0.4)
    x = made.mesh.vertices
    return Cloth.from_garment(made), torch.stack([x[:, 0] - 0.2, torch.full_like(x[:, 0], 0.19), x[:, 1] - 0.2], 1)


def rides(cloth: Cloth, part: int = 0) -> torch.Tensor:
    return PARTS[part].expand(len(cloth.masses), -1)


def test_bent_cloth_that_is_not_stretched_stays(flat) -> None:
    cloth, x = flat
    angle = x[:, 0] / 0.1
    rolled = torch.stack([0.1 * angle.sin(), 0.1 * angle.cos(), x[:, 2]], 1)  # chords: shorter by 0.2 %
    found = Projective(cloth, rides(cloth))(rolled[None], ball(FAR))[0]
    assert float((found - rolled).norm(dim=1).max()) < 1e-3


def test_without_anchor_stretch_goes_and_with_a_strong_one_it_stays(flat) -> None:
    cloth, x = flat
    guess = (x * torch.tensor([1.2, 1.0, 0.9]))[None]
    loose = Projective(cloth, rides(cloth), settings=Projecting(steps=1, anchor=1e-6))(guess, ball(FAR))[0]
    torch.testing.assert_close(loose - loose.mean(0), x - x.mean(0), atol=1e-6, rtol=0)
    firm = Projective(cloth, rides(cloth), settings=Projecting(anchor=1e9))(guess, ball(FAR))
    torch.testing.assert_close(firm, guess, atol=1e-4, rtol=0)


def test_each_step_lowers_the_strain_of_a_crumpled_sheet(flat) -> None:
    cloth, x = flat
    generator = torch.Generator().manual_seed(0)
    guess = (x + 0.003 * torch.randn(x.shape, generator=generator, dtype=x.dtype))[None]
    energies = [float(stvk(cloth, guess[0]))]
    for steps in (1, 2, 4, 8):
        found = Projective(cloth, rides(cloth), settings=Projecting(steps=steps))(guess, ball(FAR))
        energies.append(float(stvk(cloth, found[0])))
    assert all(b < a for a, b in zip(energies, energies[1:]))
    assert energies[-1] < 0.02 * energies[0]


def test_cloth_leaves_the_body_and_others_in_the_batch_play_no_part(flat) -> None:
    cloth, x = flat
    guess = torch.stack([x, x + 0.005])
    projective = Projective(cloth, rides(cloth))
    both = projective(guess, ball(torch.zeros(3), 2))
    assert BodyContact(ball(torch.zeros(3)).mesh.vertices[0], ball(FAR).mesh.faces).penetrating(x.float()).any()
    for k in range(2):
        contact = BodyContact(torch.as_tensor(np.array(BALL.vertices)), torch.as_tensor(np.array(BALL.faces)))
        assert float(contact.signed_distance(both[k]).min()) > 0.0015
        torch.testing.assert_close(projective(guess[k : k + 1], ball(torch.zeros(3)))[0], both[k])


def test_cloth_deep_in_a_part_that_it_does_not_ride_on_stays(flat) -> None:
    cloth, x = flat
    deep = (x - torch.tensor([0.0, 0.05, 0.0]))[None]
    settings = Projecting(anchor=1e6, reach=0.2)
    own = Projective(cloth, rides(cloth, 0), settings=settings)(deep, ball(torch.zeros(3)))[0]
    other = Projective(cloth, rides(cloth, 1), settings=settings)(deep, ball(torch.zeros(3)))[0]
    middle = int(x.norm(dim=1).argmin())
    assert float(own[middle, 1]) > float(deep[0, middle, 1]) + 0.015
    assert float(other[middle, 1]) == pytest.approx(float(deep[0, middle, 1]), abs=1e-3)


def test_held_vertices_stay(flat) -> None:
    cloth, x = flat
    guess = (x * 1.1)[None]
    held = np.flatnonzero(x[:, 0] < -0.199)
    found = Projective(cloth, rides(cloth), held)(guess, ball(FAR))
    free = Projective(cloth, rides(cloth))(guess, ball(FAR))
    assert float((found - guess)[0, held].norm(dim=1).max()) < 1e-3 < float((free - guess)[0, held].norm(dim=1).max())


def test_degenerate_faces_give_finite_drapes(flat) -> None:
    cloth, x = flat
    folded = x.clone()
    folded[cloth.faces[0]] = x[cloth.faces[0, 0]]
    broken = replace(cloth, inverse=cloth.inverse.clone().index_fill(0, torch.tensor([7]), 0.0))
    for start in (folded, torch.zeros_like(x)):
        assert Projective(broken, rides(cloth))(start[None], ball(FAR)).isfinite().all()


def test_nothing_to_drape_is_no_error(flat) -> None:
    cloth, x = flat
    assert Projective(cloth, rides(cloth))(x[None][:0], ball(FAR, 0)).shape == (0, *x.shape)
