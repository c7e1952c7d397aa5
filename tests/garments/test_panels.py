"""Cutting panels out of a grid, and sewing them."""

from dataclasses import replace

import numpy as np
import pytest

from recon.garments.chains import arc_lengths, chains_of, clean_runs, merge_parameters, pair_chains, without_slits
from recon.garments.dataset import load_garments
from recon.garments.panels import border_loops, cut_panel, grid_axis, move_safely, signed_areas, waistband
from recon.garments.sewing import garment_loops, is_manifold, sew, split_chords, without_slivers

TURNED = [False, True]


def grid(resolution):
    axis = grid_axis(resolution)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)


def box(x, half_width, half_height, centre=(0.0, 0.0)):
    """Signed distance of a rectangle."""
    q = np.abs(x - np.array(centre)) - np.array([half_width, half_height])
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def disc(x, radius, centre=(0.0, 0.0)):
    return np.linalg.norm(x - np.array(centre), axis=-1) - radius


@pytest.mark.parametrize("resolution", [24, 33, 64, 128])
@pytest.mark.parametrize("radius", [0.31, 0.5, 0.77])
def test_a_disc_is_one_loop_of_decent_triangles(resolution, radius):
    panel = cut_panel(disc(grid(resolution), radius))
    areas = signed_areas(panel.points, panel.faces)
    cell = 2 / resolution
    assert len(panel.loops) == 1 and is_manifold(panel.faces)
    assert areas.min() > 0.02 * cell**2
    assert abs(areas.sum() - np.pi * radius**2) < 3 * cell * radius
    assert np.abs(np.linalg.norm(panel.points[panel.border], axis=1) - radius).max() < 0.35 * cell


def test_every_vertex_is_used_and_borders_run_counter_clockwise():
    panel = cut_panel(box(grid(50), 0.4, 0.61))
    assert set(panel.faces.ravel()) == set(range(len(panel.points)))
    x, y = panel.points[panel.loops[0]].T
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0


def test_halves_and_holes_stay_while_specks_vanish():
    x = grid(128)
    halves = np.minimum(box(x, 0.2, 0.5, (-0.3, 0)), box(x, 0.2, 0.5, (0.3, 0)))
    ring = np.maximum(disc(x, 0.6), -disc(x, 0.3))
    speck = np.minimum(ring, disc(x, 0.03, (0.85, 0.85)))
    pinhole = np.maximum(disc(x, 0.6), -disc(x, 0.02))
    assert len(cut_panel(halves).loops) == 2
    assert len(cut_panel(ring).loops) == 2
    assert len(cut_panel(speck).loops) == 2
    assert len(cut_panel(pinhole).loops) == 1


def test_touching_pieces_are_parted_at_the_pinch():
    x = grid(32)
    touching = np.minimum(box(x, 0.25, 0.25, (-0.25, -0.25)), box(x, 0.25, 0.25, (0.25, 0.25)))
    panel = cut_panel(touching)
    assert is_manifold(panel.faces)


@pytest.mark.parametrize("seed", range(8))
def test_random_shapes_are_manifold(seed):
    rng = np.random.default_rng(seed)
    x = grid(40)
    field = np.minimum.reduce([disc(x, rng.uniform(0.1, 0.4), rng.uniform(-0.5, 0.5, 2)) for _ in range(6)])
    field = np.maximum(field, -disc(x, rng.uniform(0.05, 0.3), rng.uniform(-0.5, 0.5, 2)))
    panel = cut_panel(field + 0.01 * rng.normal(size=field.shape))
    assert is_manifold(panel.faces)
    assert signed_areas(panel.points, panel.faces).min() > 0


def test_moves_that_would_flip_a_triangle_are_held_back():
    points = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    moved = move_safely(points, faces, np.array([0]), np.array([[2.0, 2.0]]))
    assert signed_areas(moved, faces).min() > 0
    free = move_safely(points, faces, np.array([0]), np.array([[0.1, 0.1]]))
    np.testing.assert_allclose(free[0], [0.1, 0.1])


def test_short_label_runs_are_noise():
    labels = np.array([0] * 20 + [1] * 10 + [2] + [1] * 9 + [0] * 2)
    clean = clean_runs(labels, np.full(len(labels), 0.01))
    assert set(clean[20:40]) == {1} and set(clean[:19]) == {0}
    wrapped = clean_runs(np.roll(labels, 25), np.full(len(labels), 0.01))
    assert (np.roll(wrapped, -25) == clean).all()


def test_arc_lengths_and_their_common_places():
    a = np.linspace(0, 1, 11)
    b = np.linspace(0, 1, 12)
    t, ia, ib = merge_parameters(a, b, 0.04)
    assert (np.diff(t) > 0).all() and t[0] == 0 and t[-1] == 1
    assert set(range(11)) <= set(ia) and set(range(12)) <= set(ib)
    same = merge_parameters(a, a + 0.0, 0.04)
    assert len(same[0]) == 11 and (same[1] == same[2]).all()
    np.testing.assert_allclose(arc_lengths(np.array([[0.0, 0], [0, 3], [4, 3]])), [0, 3 / 7, 1])


def test_common_places_rise_and_keep_every_point():
    rng = np.random.default_rng(3)
    for _ in range(50):
        a, b = (np.sort(np.r_[0, rng.random(rng.integers(0, 30)), 1]) for _ in range(2))
        t, ia, ib = merge_parameters(a, b, 0.02)
        assert (np.diff(t) >= 0).all() and t[0] == 0 and t[-1] == 1
        assert (ia[ia >= 0] == np.arange(len(a))).all() and (ib[ib >= 0] == np.arange(len(b))).all()
        both = (ia >= 0) & (ib >= 0)
        assert (np.abs(a[ia[both]] - b[ib[both]]) <= 0.02).all()
        assert ((ia >= 0) | (ib >= 0)).all()


def side_labels(panel):
    """Left and right sides are seams 2 and 1, top and bottom are open."""
    p = panel.points[panel.border]
    half, low, high = np.abs(p[:, 0]).max(), p[:, 1].min(), p[:, 1].max()
    rim = np.minimum(p[:, 1] - low, high - p[:, 1]) < half - np.abs(p[:, 0])
    return np.where(rim, 0, np.where(p[:, 0] > 0, 1, 2))


@pytest.mark.parametrize(("resolution", "shift"), [(40, 0.0), (40, 0.013), (97, 0.007), (128, -0.01)])
def test_two_sheets_sewn_at_the_sides_make_a_tube(resolution, shift):
    front = cut_panel(box(grid(resolution), 0.5, 0.6))
    back = cut_panel(box(grid(resolution), 0.5 + shift, 0.6 - shift))
    sewn = sew([front, back], [side_labels(front), side_labels(back)], TURNED, 2 / resolution)
    faces = sewn.vertex_of_point[sewn.faces]
    assert is_manifold(faces)
    assert len(garment_loops(faces)) == 2
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), 1)
    euler = len(np.unique(faces)) - len(np.unique(edges, axis=0)) + len(faces)
    assert euler == 0
    assert signed_areas(sewn.points, sewn.faces[sewn.panel_of_face == 0]).min() > 0
    assert signed_areas(sewn.points, sewn.faces[sewn.panel_of_face == 1]).max() < 0
    counts = np.bincount(sewn.vertex_of_point)
    assert counts.max() == 2 and (sewn.labels[counts[sewn.vertex_of_point] == 2] > 0).all()
    assert (counts[sewn.vertex_of_point[sewn.labels > 0]] == 2).all()


def test_an_open_front_gives_three_borders_less_one():
    """A jacket without sleeves: two front halves, one border running all around."""
    x = grid(96)
    front = cut_panel(np.maximum(box(x, 0.5, 0.6), -box(x, 0.04, 2.0)))
    back = cut_panel(box(x, 0.5, 0.6))
    sewn = sew([front, back], [side_labels(front), side_labels(back)], TURNED, 2 / 96)
    faces = sewn.vertex_of_point[sewn.faces]
    assert is_manifold(faces) and len(garment_loops(faces)) == 1


@pytest.mark.parametrize("noise", [0.02, 0.08])
def test_label_noise_does_not_tear_a_seam(noise):
    rng = np.random.default_rng(3)
    front, back = cut_panel(box(grid(64), 0.5, 0.6)), cut_panel(box(grid(64), 0.49, 0.6))
    labels = [side_labels(p) for p in (front, back)]
    for values in labels:
        values[rng.random(len(values)) < noise] = rng.integers(3)
    sewn = sew([front, back], labels, TURNED, 2 / 64)
    faces = sewn.vertex_of_point[sewn.faces]
    assert is_manifold(faces) and len(garment_loops(faces)) == 2


def test_a_seam_without_partner_stays_open():
    front, back = cut_panel(box(grid(64), 0.5, 0.6)), cut_panel(box(grid(64), 0.5, 0.6))
    one_sided = side_labels(back)
    one_sided[one_sided == 1] = 0
    sewn = sew([front, back], [side_labels(front), one_sided], TURNED, 2 / 64)
    faces = sewn.vertex_of_point[sewn.faces]
    assert is_manifold(faces) and len(garment_loops(faces)) == 1
    assert not (sewn.labels == 1).any()


def test_chords_between_seam_points_are_split():
    points = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    p, f, labels = split_chords(points, faces, np.array([1, 0, 1, 0]))
    assert len(f) == 4 and len(p) == 5 and labels[4] == -1
    np.testing.assert_allclose(signed_areas(p, f), 0.25)
    assert len(border_loops(f)) == 1


def test_slivers_turn_their_long_edge_unless_it_is_a_border():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.005], [0.5, -0.6], [0.5, 0.7]])
    faces = np.array([[0, 1, 2], [1, 0, 3], [2, 1, 4], [0, 2, 4]])
    found = without_slivers(points, faces)
    assert {frozenset(f) for f in found.tolist()} == {
        frozenset(f) for f in ((2, 0, 3), (2, 3, 1), (2, 1, 4), (0, 2, 4))
    }
    assert (signed_areas(points, found) > 0.1).all()
    assert signed_areas(points, found).sum() == pytest.approx(signed_areas(points, faces).sum())
    np.testing.assert_array_equal(without_slivers(points, faces[[0, 2, 3]]), faces[[0, 2, 3]])  # nothing lies across


def test_chains_pair_by_label_and_place():
    front = cut_panel(box(grid(64), 0.5, 0.6))
    _, chains, labels = chains_of(front, side_labels(front))
    assert sorted(c.label for c in chains) == [1, 2]
    pairs = pair_chains(front, front, chains, chains)
    assert all((a.points == b.points).all() for a, b in pairs)
    ends = front.points[[chains[0].points[0], chains[0].points[-1]]]
    np.testing.assert_allclose(np.abs(ends), [[0.5, 0.6]] * 2, atol=0.05)
    assert (labels[front.border] >= 0).all()


@pytest.mark.parametrize("resolution", [64, 128, 256])
@pytest.mark.parametrize("angle", [0.0, 0.35, 0.7])
def test_seams_end_in_true_corners_wherever_the_grid_cuts_them(resolution, angle):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cell, half = 2 / resolution, np.array([0.4, 0.5])
    for shift in np.random.default_rng(0).uniform(-cell, cell, (6, 2)):
        panel = cut_panel(box((grid(resolution) - shift) @ turn, *half))
        x = np.clip((panel.points[panel.border] - shift) @ turn, -half, half)
        nearest = (np.arange(len(x)), (np.abs(x) - half).argmax(1))
        x[nearest] = np.sign(x[nearest]) * half[nearest[1]]
        panel = replace(panel, points=move_safely(panel.points, panel.faces, panel.border, x @ turn.T + shift))
        labels = np.where(np.abs(x[:, 0]) > half[0] - 0.3 * cell, np.where(x[:, 0] < 0, 1, 2), 0)
        sharp, chains, _ = chains_of(panel, labels)
        ends = (sharp.points[np.concatenate([c.points[[0, -1]] for c in chains])] - shift) @ turn
        assert np.abs(np.abs(ends) - half).max() < 0.45 * cell
        assert len(chains) == 2 and (signed_areas(sharp.points, sharp.faces) > 0).all()


def test_a_slit_within_a_seam_is_sewn_and_openings_between_seams_stay() -> None:
    labels = np.array([1] * 8 + [0] * 2 + [1] * 6 + [0] * 4 + [2] * 9 + [0] * 4)
    whole = np.array([1] * 16 + [0] * 4 + [2] * 9 + [0] * 4)
    even = np.ones(len(labels))
    for shift in (0, -9, 5):  # also across the loop's start
        assert without_slits(np.roll(labels, shift), even).tolist() == np.roll(whole, shift).tolist()
    tube = np.array([1, 1, 1, 0, 0, 0])
    assert without_slits(tube, np.ones(6)).tolist() == tube.tolist()
    near_its_end = np.array([1] * 10 + [0] * 6 + [1] * 5 + [0] * 4 + [2] * 9 + [0] * 4)
    assert without_slits(near_its_end, np.ones(38)).tolist() == [1] * 21 + near_its_end.tolist()[21:]
    stray = np.array([1] * 20 + [0] * 10 + [1] * 2 + [2] * 9 + [0] * 4)  # a trace of the seam beyond an open hem
    assert without_slits(stray, np.ones(45)).tolist() == stray.tolist()
    both_ways = np.array([1] * 4 + [0] * 4 + [1] * 4 + [0] * 4)  # a tube with one seam label on both sides
    assert without_slits(both_ways, np.ones(16)).tolist() == both_ways.tolist()


@pytest.mark.parametrize("kind", ["trousers", "skirt"])
def test_the_waistband_is_the_highest_border(kind):
    for garment in load_garments(kind, "test")[:3]:
        band = waistband(garment)
        heights = garment.mesh.vertices[:, 1].numpy()
        others = [loop for loop in border_loops(garment.mesh.faces.numpy()) if not set(loop) & set(band)]
        assert len(others) == {"trousers": 2, "skirt": 1}[kind]  # hems
        assert max(heights[loop].max() for loop in others) < heights[band].min() - 0.1
        assert np.ptp(heights[band]) < 1e-3 and heights[band].max() == heights.max()
        assert len(set(band)) == len(band)
