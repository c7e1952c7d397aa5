"""Following a simulated motion: where that passes through itself cloth stays clean, else it goes as simulated."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from recon.cloth.contact import BodyContact
from recon.cloth.follow import follow
from recon.cloth.intersections import Crossings
from recon.types import Mesh

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
FACES = torch.tensor(BALL.faces)


def sheet(height: float, n: int = 13, size: float = 0.3) -> Mesh:
    """A square of cloth, level, at a height [m]."""
    u = np.linspace(-size / 2, size / 2, n)
    x = np.stack([*np.meshgrid(u, u, indexing="ij"), np.full((n, n), height)], -1).reshape(-1, 3)[:, [0, 2, 1]]
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (at[i : n - 1 + i, j : n - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    return Mesh(torch.tensor(x), torch.tensor(np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])))


def bodies(frames: int, lift: float = 0.0) -> np.ndarray:
    """A ball under the cloth that rises."""
    return np.stack([BALL.vertices - [0, 0.11, 0] + [0, lift * k / (frames - 1), 0] for k in range(frames)])


def towards(goals: np.ndarray):
    """Goes as the goals do, whatever the cloth did."""
    return lambda k, x: x + goals[k] - goals[k - 1]


def crossings(layers: list[np.ndarray], meshes: list[Mesh]) -> int:
    starts = np.cumsum([0, *[len(x) for x in layers]])
    faces = np.concatenate([m.faces.numpy() + s for m, s in zip(meshes, starts)])
    return len(Crossings(faces, int(starts[-1]))(np.concatenate(layers)))


def test_a_clean_motion_is_followed_exactly() -> None:
    cloth = sheet(0.0)
    x = cloth.vertices.numpy()
    goals = np.stack([x + [0.01 * k, 0.01 * k, 0] for k in range(5)])
    (end,) = follow([cloth], goals, bodies(5), FACES, towards(goals))
    assert np.abs(end - goals[-1]).max() < 1e-7


def test_a_layer_that_a_simulation_tilts_through_another_stays_above_it() -> None:
    upper, lower = sheet(0.02), sheet(0.0, 16, 0.28)
    over, under = upper.vertices.numpy(), lower.vertices.numpy()
    goals = [np.concatenate([over + over[:, :1] * [0, slope, 0], under]) for slope in np.linspace(0, 0.4, 9)]
    ends = follow([upper, lower], np.stack(goals), bodies(9) - [0, 1, 0], FACES, towards(np.stack(goals)))
    assert crossings([goals[-1][: len(over)], under], [upper, lower]) > 20
    assert not crossings(ends, [upper, lower])
    dipped = (goals[-1][: len(over), 1] < -0.01) & (np.abs(over) < 0.13).all(1)
    beneath = [ends[1][np.linalg.norm(ends[1][:, [0, 2]] - p[[0, 2]], axis=1).argmin(), 1] for p in ends[0][dipped]]
    assert dipped.sum() > 20 and (ends[0][dipped, 1] > np.array(beneath) - 2e-3).all()


def test_a_fold_pressed_through_itself_is_not() -> None:
    cloth = sheet(0.0)
    x = cloth.vertices.numpy()
    goals = []
    for share in np.linspace(0, 1, 14):  # the right half is folded over the left one, and one side of it through it
        y, turn = x.copy(), np.pi * share * (1 + 1.5 * x[:, 2])
        right = np.maximum(x[:, 0], 0)
        y[:, 0] = np.minimum(x[:, 0], 0) + np.cos(turn) * right
        y[:, 1] = np.sin(turn) * right
        goals.append(y)
    still = bodies(len(goals)) - [0, 1, 0]
    assert crossings([goals[-1]], [cloth]) > 20
    (end,) = follow([cloth], np.stack(goals), still, FACES, towards(np.stack(goals)))
    assert not crossings([end], [cloth])
    assert np.median(np.linalg.norm(end - goals[-1], axis=1)) < 0.02


def test_it_leaves_a_body_that_comes() -> None:
    cloth = sheet(0.0)
    goals = np.stack([cloth.vertices.numpy()] * 9)
    rising = bodies(9, lift=0.05)
    (end,) = follow([cloth], goals, rising, FACES, towards(goals))
    body = BodyContact(torch.from_numpy(rising[-1]), FACES)
    assert not crossings([end], [cloth])
    assert body.penetrating(torch.from_numpy(goals[-1])).any() and not body.penetrating(torch.from_numpy(end)).any()
    ends = end[cloth.faces[:, :2].numpy()]
    rest = goals[0][cloth.faces[:, :2].numpy()]
    longer = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / np.linalg.norm(rest[:, 0] - rest[:, 1], axis=1)
    assert np.quantile(longer, 0.95) < 1.25
