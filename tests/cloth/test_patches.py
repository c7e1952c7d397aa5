"""Pockets of cloth that poke through other cloth."""

import numpy as np

from recon.cloth.intersections import Crossings
from recon.cloth.patches import Pockets, border_numbers, film, laid_across


def sheet(cells: int, height: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    axis = np.arange(cells + 1) / cells
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    n = cells + 1
    c = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    faces = np.concatenate([np.stack([c, c + n, c + n + 1], 1), np.stack([c, c + n + 1, c + 1], 1)])
    return np.column_stack([grid, np.broadcast_to(height, len(grid))]), faces


def poked() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat sheet and, 1 cm beneath it, one with a bump 10 cm high."""
    flat, f = sheet(24)
    away = ((flat[:, :2] - 0.52) ** 2).sum(1)
    bumped = flat + np.column_stack([np.zeros((len(flat), 2)), -0.01 + 0.1 * np.exp(-away / 0.01)])
    return np.concatenate([flat, bumped]), np.concatenate([f, f + len(flat)]), np.repeat([0, 1], len(flat))


def test_a_bump_is_found_and_laid_across_the_curve() -> None:
    x, faces, layer = poked()
    search = Crossings(faces, len(x))
    crossing = np.zeros(len(search.edges), bool)
    crossing[search(x)[:, 0]] = True
    found = Pockets(search, x, layer).find(crossing)
    half = len(x) // 2
    assert found[half:].any()
    assert set(np.flatnonzero(x[half:, 2] > 0.01)) <= set(np.flatnonzero(found[half:]))
    done = laid_across(x, search.edges, found)
    assert np.abs(done[:, 2]).max() < 0.015
    np.testing.assert_array_equal(done[~found], x[~found])


def test_pieces_that_hold_an_open_border_are_no_pockets() -> None:
    x, faces, layer = poked()
    search = Crossings(faces, len(x))
    crossing = (x[search.edges][:, :, 0] > 0.9).sum(1) == 1  # cut off a strip along the sheets' right side
    found = Pockets(search, x, layer).find(crossing)
    assert found.any()  # a strip of the border is not all of it
    ring = np.abs(x[:, :2] - 0.5).max(1) > 0.48
    crossing = ring[search.edges].sum(1) == 1  # now the whole border
    assert not Pockets(search, x, layer).find(crossing)[ring].any()


def test_laid_cloth_lies_within_its_border() -> None:
    x, faces = sheet(10)
    rng = np.random.default_rng(0)
    free = (np.abs(x[:, :2] - 0.5) < 0.35).all(1)
    rough = x + free[:, None] * rng.normal(0, 0.1, x.shape)
    done = laid_across(rough, Crossings(faces, len(x)).edges, free)
    assert np.abs(done[:, 2]).max() < 1e-6


def test_a_film_keeps_open_borders_where_they_are() -> None:
    x, faces = sheet(10)
    search = Crossings(faces, len(x))
    free = x[:, 0] > 0.45
    rough = x + np.column_stack([np.zeros((len(x), 2)), 0.1 * free * np.sin(20 * x[:, 1])])
    done = film(rough, search.edges, search.rim, free)
    np.testing.assert_array_equal(done[~free], rough[~free])
    assert done[:, 0].max() > 0.95  # it is not drawn in
    assert np.abs(done[free, 2]).max() < 0.5 * np.abs(rough[free, 2]).max()


def test_nothing_free_nothing_moved() -> None:
    x, faces = sheet(3)
    edges = Crossings(faces, len(x)).edges
    np.testing.assert_array_equal(laid_across(x, edges, np.zeros(len(x), bool)), x)


def test_border_numbers_tell_borders_apart() -> None:
    rim = np.array([[0, 1], [1, 2], [2, 0], [4, 5], [5, 6], [6, 4]])
    assert border_numbers(rim, 8).tolist() == [0, 0, 0, -1, 1, 1, 1, -1]
