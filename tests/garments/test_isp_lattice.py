"""Interpolating the surface map on fine grids."""

import numpy as np
import pytest
import torch

from recon.garments import load_decoder
from recon.garments.isp_lattice import CELLS, cubic_weights, lattice


def grid(resolution: int) -> np.ndarray:
    axis = np.linspace(-0.5, 0.5, resolution // 2 + 1)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def test_cubics_are_exact_for_cubics() -> None:
    cubic = lambda x: 2 - x + 3 * x**2 - 0.7 * x**3  # noqa: E731
    for resolution in (2 * CELLS, 3 * CELLS):
        found = cubic_weights(resolution).astype(float) @ cubic(np.linspace(-1, 1, CELLS + 1))
        np.testing.assert_allclose(found, cubic(np.linspace(-1, 1, resolution + 1)), atol=1e-5)


def test_a_smooth_map_is_reproduced_and_a_quarter_asked() -> None:
    points = grid(2 * CELLS)
    asked, between = lattice(points, np.full(len(points), 3, np.uint8), 2 * CELLS)
    assert asked.mean() < 1 / 3
    smooth = torch.as_tensor(np.sin(9 * points[:, :1]) * np.cos(7 * points[:, 1:])).float().requires_grad_()
    found = between.interpolate(smooth)
    assert float((found - smooth[~asked]).detach().abs().max()) < 1e-4
    (slope,) = torch.autograd.grad(found.sum(), smooth)
    assert float(slope.sum()) == pytest.approx(len(found), rel=1e-5)  # weights of every point sum to one
    assert not slope[~asked].any()


def test_cubics_stay_within_the_panel() -> None:
    points = grid(2 * CELLS)
    used = np.where(points[:, 0] < 0, 3, 1).astype(np.uint8)  # the back panel ends halfway
    asked, between = lattice(points, used, 2 * CELLS)
    values = torch.zeros(len(points), 1, requires_grad=True)
    of_both = between.interpolate(values)[torch.as_tensor(used[~asked] == 3)]
    assert len(of_both)
    (slope,) = torch.autograd.grad(of_both.sum(), values)
    assert not slope[torch.as_tensor(used == 1)].any()


def test_coarse_grids_are_not_interpolated() -> None:
    points = grid(CELLS)
    asked, between = lattice(points, np.full(len(points), 3, np.uint8), CELLS)
    assert asked.all()
    assert not len(between.between)


def test_interpolated_garment_is_the_surface_map() -> None:
    decoder = load_decoder("skirt")
    with torch.no_grad():
        garment = decoder.decode(decoder.codes[3], 256)
        direct = decoder.surface(decoder.codes[3], garment.panel_points)
    inner = garment.border_labels < 0
    panel = torch.zeros(len(direct), dtype=torch.long)
    panel[garment.panel_faces[garment.panel_of_face == 1]] = 1
    want = direct[torch.arange(len(direct)), panel][inner]
    off = (garment.mesh.vertices[garment.vertex_of_point[inner]] - want).norm(dim=1)
    assert float(off.mean()) < 3e-5
    assert float(off.max()) < 1e-3
