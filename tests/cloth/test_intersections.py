"""Self-intersections: small cases with known answers, and an outside judge on random meshes."""

import numpy as np
import pytest
import torch
import trimesh

from recon.cloth.intersections import Crossings, self_intersections


def triangles(*corners) -> tuple[np.ndarray, np.ndarray]:
    v = np.array(corners, float).reshape(-1, 3)
    return v, np.arange(len(v)).reshape(-1, 3)


LYING = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("other", "crosses"),
    [
        ([[0.2, 0.2, -1], [0.2, 0.2, 1], [0.3, 0.9, 2]], True),  # one edge through the middle
        ([[0.2, -1, -1], [0.2, 2, -1], [0.2, 0.5, 1]], True),  # straddles it
        ([[0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1]], False),  # parallel
        ([[2, 2, -1], [2, 2, 1], [3, 3, 1]], False),  # beside it
        ([[0.2, 0.2, 0.01], [0.2, 0.2, 1], [0.3, 0.9, 2]], False),  # just above
    ],
)
def test_two_triangles(other, crosses: bool) -> None:
    assert len(self_intersections(*triangles(LYING, other))) == int(crosses)


def test_neighbours_are_no_intersection_but_a_neighbour_that_turns_back_through_is() -> None:
    v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2], [0.6, 0.3, -0.5], [0.1, 0.5, 0.5]], float)
    assert len(self_intersections(v, np.array([[0, 1, 2], [2, 1, 3]]))) == 0
    assert len(self_intersections(v, np.array([[0, 1, 2], [0, 4, 5]]))) == 1  # shares corner 0, its far edge crosses


def test_closed_surfaces_are_clean_and_two_in_one_are_not() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert len(self_intersections(ball.vertices, ball.faces)) == 0
    both = trimesh.util.concatenate([ball, ball.copy().apply_translation([0.7, 0.1, 0.05])])
    pairs = self_intersections(torch.tensor(both.vertices), torch.tensor(both.faces))
    assert len(pairs) > 20
    half = len(ball.faces)
    assert ((pairs[:, 0] < half) & (pairs[:, 1] >= half)).all()
    assert (np.unique(pairs, axis=0) == pairs).all()


def test_segments_touching_the_border_count_and_coplanar_ones_do_not() -> None:
    assert len(self_intersections(*triangles(LYING, [[0.5, 0, -1], [0.5, 0, 1], [0.5, -9, 0]])))
    assert not len(self_intersections(*triangles(LYING, [[-1, 0.2, 0], [2, 0.2, 0], [0.5, 9, 0]])))


def grid(seed: int, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """A sheet with random bumps: clean when they are small, tangled when they are large."""
    n = 12
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    v = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], 1).astype(float)
    v += np.random.default_rng(seed).normal(size=v.shape) * roughness
    c = (x[:-1, :-1] * n + y[:-1, :-1]).ravel()
    return v, np.concatenate([np.stack([c, c + n, c + n + 1], 1), np.stack([c, c + n + 1, c + 1], 1)])


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.45, 0.6, 1.0])
def test_agrees_with_ipctk(roughness: float) -> None:
    ipctk = pytest.importorskip("ipctk")
    for seed in range(6):
        v, f = grid(seed, roughness)
        mesh = ipctk.CollisionMesh(v, ipctk.edges(f), f)
        assert bool(ipctk.has_intersections(mesh, v)) == bool(len(self_intersections(v, f))), (seed, roughness)


def volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
    return float(np.dot(np.cross(b - a, c - a), d - a))


def segment_crosses(p: np.ndarray, q: np.ndarray, t: np.ndarray) -> bool:
    """Whether a segment passes through a triangle (3, 3): the slow twin of the kernel's test."""
    a, b, c = t
    above, below = volume(a, b, c, p), volume(a, b, c, q)
    if above * below > 0 or above == below == 0:
        return False
    sides = [volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)]
    return all(s >= 0 for s in sides) or all(s <= 0 for s in sides)


def test_agrees_with_a_test_of_every_pair() -> None:
    v, f = grid(1, 0.7)
    f = f[:70]
    all_pairs = set()
    for i in range(len(f)):
        for j in range(i + 1, len(f)):
            if len(set(f[i]) & set(f[j])) >= 2:
                continue
            for a, b in ((i, j), (j, i)):
                for k in range(3):
                    p, q = f[a][k], f[a][(k + 1) % 3]
                    if p not in f[b] and q not in f[b] and segment_crosses(v[p], v[q], v[f[b]]):
                        all_pairs.add((i, j))
    assert {tuple(p) for p in self_intersections(v, f).tolist()} == all_pairs


def test_what_moved_is_enough_to_ask() -> None:
    v, f = grid(3, 0.02)
    test = Crossings(f, len(v))
    assert not len(test(v))
    moved = np.zeros(len(v), bool)
    moved[[40, 41, 53, 100]] = True
    rough = v + moved[:, None] * np.array([2.5, 1.3, 0.05])
    assert len(test(rough)) and np.array_equal(test(rough, moved), test(rough))
    assert not len(test(rough, np.zeros(len(v), bool)))


def test_a_plane_that_is_turned_does_not_cross_itself_by_rounding() -> None:
    v, f = grid(0, 0.0)
    for seed in range(10):
        turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
        assert not len(self_intersections(0.02 * v @ turn + 0.3, f))
