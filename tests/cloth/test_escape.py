"""Cloth leaves the body to where its own outside is."""

import numpy as np
import torch
import trimesh

from recon.cloth.escape import Escape, outward_normals, scatter
from recon.cloth.intersections import Crossings
from recon.types import Mesh


def arm(radius: float, height: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.cylinder(radius=radius, height=height, sections=24).subdivide().subdivide()
    return np.array(made.vertices), np.array(made.faces)


def tube(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """An open sleeve along z, its outside outwards."""
    around, along = 32, 16
    angle, z = np.meshgrid(np.arange(around) / around * 2 * np.pi, np.linspace(-0.15, 0.15, along + 1), indexing="ij")
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along), indexing="ij")
    at = lambda i, j: (i % around) * (along + 1) + j  # noqa: E731
    a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return x, faces


def test_a_sleeve_beyond_the_middle_of_its_arm_goes_around_it_again() -> None:
    x, faces = tube(0.07)
    moved = x + [0.09, 0.0, 0.0]  # its far side now lies within the arm, past the middle
    v, f = arm(0.05)
    body = Mesh(torch.as_tensor(v), torch.as_tensor(f))
    escape = Escape(body, moved, faces, Crossings(faces, len(x)).edges)
    assert escape.lack(moved).any()
    before = moved.copy()
    changed = escape.leave(moved, 5e-4, 1.05, 60)
    assert not escape.lack(moved).any()
    angle = np.unwrap(np.arctan2(moved[:, 1], moved[:, 0]).reshape(32, 17)[:, 8])
    assert abs(abs(angle[-1] - angle[0]) - 2 * np.pi * 31 / 32) < 0.5  # once around the arm's middle
    np.testing.assert_array_equal(moved[~changed], before[~changed])


def test_cloth_of_the_trunk_goes_back_out_of_an_arm() -> None:
    flat = np.stack(np.meshgrid(np.linspace(-0.02, 0.02, 5), np.linspace(-0.1, 0.1, 21), indexing="ij"), -1).reshape(
        -1, 2
    )
    x = np.column_stack([np.full(len(flat), 0.13), flat])  # 3 cm into the arm, its outside towards the arm
    i, j = np.meshgrid(np.arange(4), np.arange(20), indexing="ij")
    a = (i * 21 + j).ravel()
    faces = np.concatenate([np.stack([a, a + 21, a + 22], 1), np.stack([a, a + 22, a + 1], 1)])
    if outward_normals(x, faces, Crossings(faces, len(x)).edges)[:, 0].mean() < 0:
        faces = faces[:, ::-1].copy()
    trunk, f = arm(0.09)
    limb, g = arm(0.05)
    both = Mesh(
        torch.as_tensor(np.concatenate([trunk, limb + [0.15, 0, 0]])),
        torch.as_tensor(np.concatenate([f, g + len(trunk)])),
    )
    escape = Escape(both, x, faces, Crossings(faces, len(x)).edges)
    escape.leave(x, 5e-4, 1.05, 60)
    assert not escape.lack(x).any()
    assert x[:, 0].max() < 0.11


def test_scatter_adds_the_mean_of_what_is_asked_for() -> None:
    x = np.zeros((3, 3))
    scatter(x, np.array([0, 0, 2]), np.array([[1.0, 0, 0], [3.0, 0, 0], [0, 1.0, 0]]))
    assert x.tolist() == [[2, 0, 0], [0, 0, 0], [0, 1, 0]]
