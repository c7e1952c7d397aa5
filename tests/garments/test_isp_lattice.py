"""Interpolating the surface map on fine grids."""

import numpy as np
import torch

from recon.garments import load_decoder
from recon.garments.isp_lattice import CELLS, cubic_weights, lattice_stencils


def grid(resolution: int) -> np.ndarray:
    axis = np.linspace(-0.5, 0.5, resolution // 2 + 1)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def test_cubics_are_exact_for_cubics() -> None:
    t = np.linspace(0, 1, 7)
    nodes = np.arange(-1, 3.0)
    cubic = lambda x: 2 - x + 3 * x**2 - 0.7 * x**3  # noqa: E731
    np.testing.assert_allclose(cubic_weights(t) @ cubic(nodes), cubic(t), atol=1e-12)


def test_stencils_reproduce_a_smooth_map_and_ask_a_quarter() -> None:
    points = grid(2 * CELLS)
    asked, stencils = lattice_stencils(points, np.full(len(points), 3, np.uint8), 2 * CELLS)
    assert asked.mean() < 1 / 3
    smooth = torch.as_tensor(np.sin(9 * points[:, :1]) * np.cos(7 * points[:, 1:]))
    found = stencils.interpolate(smooth)
    assert float((found - smooth[~asked]).abs().max()) < 1e-4


def test_stencils_stay_within_the_panel() -> None:
    points = grid(2 * CELLS)
    used = np.where(points[:, 0] < 0, 3, 1).astype(np.uint8)  # the back panel ends halfway
    asked, stencils = lattice_stencils(points, used, 2 * CELLS)
    between = np.nonzero(~asked)[0]
    assert ((used[between][:, None] & ~used[stencils.nodes.numpy()]) == 0).all()


def test_coarse_grids_are_not_interpolated() -> None:
    points = grid(CELLS)
    asked, stencils = lattice_stencils(points, np.full(len(points), 3, np.uint8), CELLS)
    assert asked.all()
    assert not len(stencils.nodes)


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
