"""Untangling: nothing crosses in the end, judged by others too; order and lengths are kept; what is clean stays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from sheets import sheet

from recon.cloth.intersections import self_intersections
from recon.cloth.untangle import Untangling, untangle
from recon.types import Mesh

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
BODY = Mesh(torch.as_tensor(np.array(BALL.vertices)), torch.as_tensor(np.array(BALL.faces)))


def cap(radius: float, bumps: float = 0.0, seed: int = 0) -> Mesh:
    """The upper part of a sphere around the ball, open below, with smooth bumps."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    v = np.array(ball.vertices)
    keep = (v[np.array(ball.faces)][:, :, 1] > -0.05).all(1)
    f = np.array(ball.faces)[keep]
    used, f = np.unique(f, return_inverse=True)
    v, f = v[used], f.reshape(-1, 3)
    rng = np.random.default_rng(seed)
    wave = sum(np.sin(v @ rng.normal(size=3) * 40 + rng.uniform(0, 6)) for _ in range(4)) / 4
    v = v * (1 + bumps / radius * wave)[:, None]
    return Mesh(torch.as_tensor(v), torch.as_tensor(f))


def joined(layers: list[np.ndarray], meshes: list[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *[len(x) for x in layers]])
    return np.concatenate(layers), np.concatenate([m.faces.numpy() + at for m, at in zip(meshes, starts)])


def crossing(layers: list[np.ndarray], meshes: list[Mesh]) -> int:
    return len(self_intersections(*joined(layers, meshes)))


def edge_change(before: Mesh, after: np.ndarray) -> float:
    f = before.faces.numpy()
    ends = np.concatenate([f[:, [0, 1]], f[:, [1, 2]]])
    old, new = (np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1) for x in (before.vertices.numpy(), after))
    return float(np.abs(new / old - 1).mean())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [2, 3, 5])
def test_layers_are_drawn_apart_in_order(seed: int, count: int) -> None:
    meshes = [cap(0.212 + 0.004 * (count - k), 0.004, seed * 10 + k) for k in range(count)]
    before = crossing([m.vertices.numpy() for m in meshes], meshes)
    done = untangle(meshes, BODY)
    assert before > 10 and done.crossings == before
    assert done.clean and not len(done.left) and done.inside == 0 and done.notes == ()
    assert crossing(done.vertices, meshes) == 0
    away = [np.linalg.norm(x, axis=1) for x in done.vertices]
    assert all(a.mean() > b.mean() for a, b in zip(away, away[1:]))
    assert away[-1].min() > 0.199
    assert max(edge_change(m, x) for m, x in zip(meshes, done.vertices, strict=True)) < 0.03


def test_an_outside_judge_agrees() -> None:
    ipctk = pytest.importorskip("ipctk")
    meshes = [cap(0.216, 0.003, 1), cap(0.213, 0.003, 2)]

    def intersects(layers: list[np.ndarray]) -> bool:
        v, f = joined(layers, meshes)
        return bool(ipctk.has_intersections(ipctk.CollisionMesh(v, ipctk.edges(f), f), v))

    assert intersects([m.vertices.numpy() for m in meshes])
    assert not intersects(untangle(meshes, BODY).vertices)


def test_a_fold_through_itself_opens() -> None:
    """A strip rolled up until its ends pass through each other."""
    made = sheet(40, 8, 0.4, 0.08).mesh
    x = made.vertices.numpy().copy()
    angle = (x[:, 0] / 0.4) * 2 * np.pi * 1.05
    radius = 0.4 / (2 * np.pi * 1.05) * (1 - 0.08 * np.sin(x[:, 1] * 60) * (x[:, 0] > 0.3))
    mesh = made.with_vertices(
        torch.as_tensor(np.column_stack([radius * np.cos(angle), x[:, 1], radius * np.sin(angle)]))
    )
    assert crossing([mesh.vertices.numpy()], [mesh]) > 5
    done = untangle([mesh])
    assert done.clean and crossing(done.vertices, [mesh]) == 0
    assert edge_change(mesh, done.vertices[0]) < 0.03


def test_a_deep_fin_goes_back_beneath_the_outer_layer_without_much_strain() -> None:
    """An inner layer that sticks far out through a narrow outer one: sides alone don't say where to."""
    outer, inner = cap(0.222), cap(0.21)
    x = inner.vertices.numpy().copy()
    near = np.exp(-((x[:, 1] - 0.02) ** 2 + x[:, 2] ** 2) / 0.002) * (x[:, 0] > 0)
    x[:, 0] += 0.08 * near
    meshes = [outer, inner.with_vertices(torch.as_tensor(x))]
    assert crossing([outer.vertices.numpy(), x], meshes) > 20
    loose, tight = (untangle(meshes, BODY, Untangling(tighten=rounds)) for rounds in (0, 6))
    assert loose.clean and tight.clean and crossing(tight.vertices, meshes) == 0
    strain = [sum(edge_change(m, x) for m, x in zip(meshes, done.vertices)) for done in (loose, tight)]
    assert strain[1] < 0.8 * strain[0]


def test_what_is_clean_stays_where_it_is() -> None:
    meshes = [cap(0.23), cap(0.21)]
    done = untangle(meshes, BODY)
    assert done.clean and done.rounds == 0
    for m, x in zip(meshes, done.vertices, strict=True):
        assert np.array_equal(m.vertices.numpy(), x)


def test_cloth_in_the_body_comes_out() -> None:
    mesh = cap(0.197, 0.004, 5)
    done = untangle([mesh], BODY)
    assert done.clean and np.linalg.norm(done.vertices[0], axis=1).min() > 0.199


def test_it_says_where_it_could_not() -> None:
    meshes = [cap(0.215, 0.003, 1), cap(0.213, 0.003, 2)]
    done = untangle(meshes, BODY, Untangling(rounds=0))
    assert not done.clean and len(done.left) == done.crossings > 0
    assert "layers 0 and 1" in done.notes[0] and "pairs of faces" in done.notes[0]


def tube(width: float, depth: float, height: float, around: int = 48, along: int = 16) -> Mesh:
    """An upright elliptic tube about the y axis, open at both ends; half its ``width`` along x, ``depth`` along z."""
    turn, up = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, height, along))
    x = np.stack([width * np.sin(turn), up - height / 2, depth * np.cos(turn)], -1).reshape(-1, 3)
    i, j = (n.ravel() for n in np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    return Mesh(
        torch.as_tensor(x), torch.as_tensor(np.concatenate([np.c_[a, b, b + around], np.c_[a, b + around, a + around]]))
    )


def test_wide_cloth_is_drawn_in_under_narrow() -> None:
    """Sides that stand out along curves from border to border cut nothing off; yet in they go, and the narrow stays."""
    post = trimesh.creation.capsule(height=0.6, radius=0.1)
    post.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [0, 1, 0]))
    post.apply_translation([0, -float(post.centroid[1]), 0])
    body = Mesh(torch.as_tensor(np.array(post.vertices)), torch.as_tensor(np.array(post.faces)))
    meshes = [tube(0.13, 0.13, 0.4), tube(0.19, 0.12, 0.3)]
    assert meshes[0].vertices[:, 0].max() < meshes[1].vertices[:, 0].max() - 0.05
    done = untangle(meshes, body, Untangling(tries=1, tuck=True))
    assert done.clean and crossing(done.vertices, meshes) == 0
    outer, inner = done.vertices
    assert np.abs(inner[:, 0]).max() < np.abs(outer[:, 0]).max()
    assert edge_change(meshes[0], outer) < 0.05
