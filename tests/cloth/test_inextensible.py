"""Inextensibility (GAPS Eq. 1-4, 15, 16): what rigid motion keeps, closed forms, gradients, degenerate rings."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sheets import sheet

from recon.bodies.rig import rotation_matrices
from recon.cloth.inextensible import (
    OneRings,
    covariances,
    determinant,
    edge_lengths_kept,
    inextensibility,
    one_rings,
    relaxation,
)

SHEET = sheet(5, 4, 0.05, 0.04)
FLAT, FACES = SHEET.mesh.vertices.double(), SHEET.mesh.faces
RINGS = OneRings.of(FLAT, FACES)


def bumpy(seed: int = 0, size: float = 0.003) -> torch.Tensor:
    return FLAT + size * torch.randn(FLAT.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_one_rings_are_the_edges_of_the_mesh() -> None:
    neighbours, count = one_rings(FACES, len(FLAT))
    found = {(i, int(j)) for i in range(len(FLAT)) for j in neighbours[i, : count[i]]}
    edges = {(int(a), int(b)) for f in FACES for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    assert found == edges | {(b, a) for a, b in edges}
    assert all((neighbours[i, count[i] :] == i).all() for i in range(len(FLAT)))


def test_covariance_is_numpys() -> None:
    import numpy as np

    x = bumpy()
    found = covariances(RINGS, x)
    for i in range(len(x)):
        around = x[RINGS.neighbours[i, : RINGS.count[i]]].numpy()
        assert np.allclose(found[i], np.cov(around.T, bias=True), atol=1e-15)


@pytest.mark.parametrize("axis", [(1.0, 0, 0), (0, 2.0, 0), (0, 0, -0.7), (1.0, -2.0, 0.5)])
def test_rigid_motion_costs_nothing(axis: tuple[float, ...]) -> None:
    template = bumpy(1)
    rings = OneRings.of(template, FACES)
    moved = template @ rotation_matrices(torch.tensor(axis, dtype=torch.float64)).T + torch.tensor([1.0, -3.0, 2.0])
    assert float(inextensibility(rings, template)) == pytest.approx(0, abs=1e-9)
    assert float(inextensibility(rings, moved)) == pytest.approx(0, abs=1e-9)
    assert float(edge_lengths_kept(rings, template, moved)) == pytest.approx(0, abs=1e-18)
    assert float(inextensibility(rings, 1.05 * moved)) > 0.01


def test_uniform_stretch_is_the_stretch_factor() -> None:
    """Cloth larger by s has singular values larger by s²: with k_ext = s² nothing is left of Eq. 15."""
    rings = OneRings.of(bumpy(2), FACES)
    x = 1.1 * bumpy(2)
    assert float(inextensibility(rings, x, torch.full((len(x),), 1.21, dtype=torch.float64))) == pytest.approx(
        0, abs=1e-9
    )
    assert float(inextensibility(rings, x, 1.21)) == pytest.approx(0, abs=1e-9)
    assert float(inextensibility(rings, x)) > 0.1


def test_a_flat_ring_has_the_closed_form() -> None:
    """Four neighbours at (±a, 0), (0, ±b): C = diag(a²/2, b²/2, 0); stretched by s along x."""
    a, b, s = 0.02, 0.01, 1.2
    points = torch.tensor([[0.0, 0, 0], [a, 0, 0], [0, b, 0], [-a, 0, 0], [0, -b, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    rings = OneRings.of(points, faces)
    u, v, w = a * a / 2, b * b / 2, s * s * a * a / 2
    assert rings.singular[0].tolist() == pytest.approx([u, v, 0], abs=1e-18)
    only = OneRings(rings.neighbours[:1], rings.count[:1], rings.singular[:1], rings.size[:1])
    x = points * torch.tensor([s, 1.0, 1.0], dtype=torch.float64)
    wanted = abs((w - u) * (v - u) * u) + 0.0 + 0.0  # the roots v and 0 are kept
    assert float(inextensibility(only, x)) == pytest.approx(wanted / ((u + v) / 2) ** 3, rel=1e-9)


def test_determinant_is_torchs() -> None:
    m = torch.randn(20, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(determinant(m), torch.linalg.det(m))


def test_gradients_are_finite_differences() -> None:
    rings = OneRings.of(bumpy(4), FACES)
    x = bumpy(5).requires_grad_()
    factor = 1 + 0.3 * torch.rand(len(x), generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    for energy in (
        lambda p: inextensibility(rings, p, factor),
        lambda p: edge_lengths_kept(rings, FLAT, p),
    ):
        (slope,) = torch.autograd.grad(energy(x), x)
        for seed in range(3):
            step = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            h = 1e-8
            along = (energy(x + h * step) - energy(x - h * step)) / (2 * h)
            assert (slope * step).sum().item() == pytest.approx(float(along), rel=1e-4)


def test_relaxation_follows_equation_16() -> None:
    depth = torch.tensor([0.0, 0.001, 0.003, 0.02])
    assert relaxation(depth, 0).tolist() == [1, 1, 1, 1]
    assert relaxation(depth, 50).tolist() == pytest.approx([1, 1.5, 2.5, 2.5])
    assert relaxation(depth, 500).tolist() == pytest.approx([1, 2, 4, 4])


DEGENERATE = {
    "flat": FLAT,
    "a line": FLAT * torch.tensor([1.0, 0, 0], dtype=torch.float64),
    "a point": torch.zeros_like(FLAT),
    "along y": FLAT[:, [2, 0, 1]],
}


@pytest.mark.parametrize("template", DEGENERATE)
@pytest.mark.parametrize("deformed", DEGENERATE)
def test_degenerate_rings_stay_finite(template: str, deformed: str) -> None:
    rings = OneRings.of(DEGENERATE[template], FACES)
    x = DEGENERATE[deformed].clone().requires_grad_()
    for value in (inextensibility(rings, x), edge_lengths_kept(rings, FLAT, x)):
        (slope,) = torch.autograd.grad(value, x)
        assert math.isfinite(float(value)) and bool(slope.isfinite().all())


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31), vertices=st.integers(3, 24), faces=st.integers(1, 40), spread=st.floats(0, 3),
    flat=st.booleans(),
)  # fmt: skip
def test_no_mesh_gives_a_number_that_is_none(seed: int, vertices: int, faces: int, spread: float, flat: bool) -> None:
    """Random triangles, degenerate and non-manifold ones among them."""
    g = torch.Generator().manual_seed(seed)
    f = torch.randint(vertices, (faces, 3), generator=g)
    points = torch.randn(vertices, 3, generator=g, dtype=torch.float64) * spread
    if flat:
        points[:, 2] = 0
    rings = OneRings.of(points, f)
    x = (points + torch.randn(points.shape, generator=g, dtype=torch.float64) * 0.1).requires_grad_()
    value = inextensibility(rings, x, relaxation(torch.rand(vertices, generator=g) * 0.01, 60))
    (slope,) = torch.autograd.grad(value, x)
    assert math.isfinite(float(value)) and bool(slope.isfinite().all())
