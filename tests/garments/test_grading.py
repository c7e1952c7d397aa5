"""Grading: what made the cloth larger is found again, and what was sewn together still fits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from recon.cloth.energies import Cloth, stretch
from recon.garments.dataset import load_garments
from recon.garments.grading import grade
from recon.types import Garment
from tests.garments.synthetic import tube

PANELS = tube(cells=10)


def worn_flat(garment: Garment, points: torch.Tensor) -> torch.Tensor:
    """(V, 3) the garment pressed flat, its panels on each other at ``points`` (P, 2): no strain but what these make."""
    out = torch.zeros(len(garment.mesh.vertices), 3, dtype=points.dtype)
    out[garment.vertex_of_point, :2] = points
    return out


def uneven(points: torch.Tensor) -> torch.Tensor:
    """Wider towards the top, longer towards the left."""
    x, y = points.unbind(1)
    return torch.stack([x * (1.15 + 0.3 * y), y * (0.95 + 0.2 * x)], 1)


def strains(garment: Garment, worn: torch.Tensor) -> torch.Tensor:
    """Percentiles 5 and 95 of the largest stretch."""
    cloth = Cloth.from_garment(replace(garment, panel_points=garment.panel_points.double()))
    return torch.quantile(stretch(cloth, worn.double()), torch.tensor([0.05, 0.95], dtype=torch.float64))


@pytest.mark.parametrize("scale", [0.8, 1.3])
def test_an_even_scale_is_found(scale: float) -> None:
    worn = worn_flat(PANELS, PANELS.panel_points * scale)
    graded = grade(PANELS, worn)
    assert (strains(graded, worn) - 1).abs().max() < 1e-3
    size = [p.panel_points.amax(0) - p.panel_points.amin(0) for p in (PANELS, graded)]
    torch.testing.assert_close(size[1], size[0] * scale, rtol=2e-3, atol=0)


def test_an_uneven_map_is_found() -> None:
    worn = worn_flat(PANELS, uneven(PANELS.panel_points))
    assert strains(PANELS, worn)[1] > 1.15
    assert (strains(grade(PANELS, worn), worn) - 1).abs().max() < 0.01


def test_the_front_may_grow_where_the_back_does_not() -> None:
    """Longer in the middle of the front only: found there, while the seams of both panels keep one length."""
    points, front = PANELS.panel_points, torch.zeros(len(PANELS.panel_points), dtype=torch.bool)
    front[PANELS.panel_faces[PANELS.panel_of_face == 0].flatten()] = True
    middle = torch.exp(-((points[:, 0] / 0.1) ** 2)) * front
    longer = torch.stack([points[:, 0], points[:, 1] * (1 + 0.2 * middle)], 1)
    worn = worn_flat(PANELS, points)
    inner = torch.bincount(PANELS.vertex_of_point)[PANELS.vertex_of_point] == 1
    worn[PANELS.vertex_of_point[inner], :2] = longer[inner]
    before, after = strains(PANELS, worn)[1] - 1, strains(grade(PANELS, worn), worn)[1] - 1
    assert after < 0.6 * before


def test_what_fits_stays_as_it_is() -> None:
    graded = grade(PANELS, worn_flat(PANELS, PANELS.panel_points))
    assert (graded.panel_points - PANELS.panel_points).abs().max() < 1e-4


def test_seams_still_match_and_nothing_flips() -> None:
    graded = grade(PANELS, worn_flat(PANELS, uneven(PANELS.panel_points)))
    points, vertex = graded.panel_points, PANELS.vertex_of_point
    order = torch.argsort(vertex, stable=True)
    same = vertex[order][1:] == vertex[order][:-1]
    first, second = order[:-1][same], order[1:][same]
    assert len(first) == 2 * 11
    along = torch.argsort(PANELS.panel_points[first, 1] + 10 * PANELS.panel_points[first, 0].sign())
    lengths = [(points[ends[along]][1:] - points[ends[along]][:-1]).norm(dim=1) for ends in (first, second)]
    torch.testing.assert_close(lengths[0], lengths[1], rtol=1e-5, atol=0)

    def areas(p: torch.Tensor) -> torch.Tensor:
        c = p[PANELS.panel_faces]
        return torch.linalg.det(c[:, 1:] - c[:, :1])

    assert (areas(points) * areas(PANELS.panel_points) > 0).all()


def test_only_the_panels_change_even_without_gradients() -> None:
    worn = worn_flat(PANELS, PANELS.panel_points * 1.1).requires_grad_()
    graded = grade(PANELS, worn)
    assert replace(graded, panel_points=PANELS.panel_points) == PANELS
    assert not graded.panel_points.requires_grad and graded.panel_points.shape == PANELS.panel_points.shape
    with torch.no_grad():
        again = grade(PANELS, worn)
    assert torch.equal(again.panel_points, graded.panel_points)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_the_panels(dtype: torch.dtype) -> None:
    garment = replace(PANELS, panel_points=PANELS.panel_points.to(dtype))
    worn = worn_flat(PANELS, PANELS.panel_points * 1.1)
    assert grade(garment, worn, iterations=5).panel_points.dtype == dtype
    assert grade(garment, worn.double(), iterations=5).panel_points.dtype == dtype


def test_a_few_torn_triangles_do_not_spoil_the_rest() -> None:
    worn = worn_flat(PANELS, PANELS.panel_points * 1.1)
    worn[[60, 61, 100]] += torch.tensor([0.0, 0.0, 0.3])
    cloth = Cloth.from_garment(grade(PANELS, worn))
    assert abs(float(stretch(cloth, worn).median()) - 1) < 0.01


def test_a_shirt_on_a_larger_body() -> None:
    shirt = load_garments("top", "test")[0]
    worn = shirt.mesh.vertices * torch.tensor([1.12, 1.05, 1.15])
    assert strains(shirt, worn)[1] > 1.1
    graded = grade(shirt, worn)
    assert strains(graded, worn)[1] < 1.05


def test_without_panels_the_space_is_graded() -> None:
    """The cubic map that made a bare tube larger is found; its mesh stays, and an even scale is found exactly."""
    bare = Garment.bare("skirt", PANELS.mesh)
    x, y, z = bare.mesh.vertices.unbind(1)
    worn = torch.stack([1.2 * x * (1 + 0.2 * y), 0.95 * y, 1.1 * z], 1)
    assert strains(bare, worn)[1] > 1.15
    graded = grade(bare, worn)
    assert (strains(graded, worn) - 1).abs().max() < 0.02
    assert graded.mesh is bare.mesh and graded.unstrained is not None and not graded.has_panels
    even = grade(bare, 1.3 * bare.mesh.vertices)
    assert (strains(even, 1.3 * bare.mesh.vertices) - 1).abs().max() < 2e-3
