"""Layers as an onion: a narrow tube that goes over a wide one."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from recon.bodies import load_body
from recon.bodies.rig import JOINT_NAMES
from recon.cloth.intersections import Crossings
from recon.cloth.stack import Stack
from recon.draping.dress import Dressed, way_to
from recon.draping.nest import Shells
from recon.draping.space import Space
from recon.types import BodyPose, Mesh


def pillar() -> Mesh:
    shape = trimesh.creation.capsule(height=0.8, radius=0.06)
    x = np.asarray(shape.vertices) - np.asarray(shape.bounds).mean(0)
    return Mesh(torch.tensor(x, dtype=torch.float32), torch.tensor(np.asarray(shape.faces)))


def tube(radius: float, low: float, high: float, ripples: float = 0.0) -> Mesh:
    """An open tube about the z axis, in folds along it."""
    a, z = np.meshgrid(np.linspace(0, 2 * np.pi, 48, endpoint=False), np.linspace(low, high, 20), indexing="ij")
    r = radius + ripples * np.cos(5 * a + 0.3)
    x = np.stack([r * np.cos(a), r * np.sin(a), z], 2).reshape(-1, 3)
    i, j = (n.ravel() for n in np.meshgrid(np.arange(48), np.arange(19), indexing="ij"))
    p, q = 20 * i + j, 20 * ((i + 1) % 48) + j
    faces = np.concatenate([np.stack([p, q, q + 1], 1), np.stack([p, q + 1, p + 1], 1)])
    return Mesh(torch.tensor(x), torch.tensor(faces))


def radius(mesh: Mesh) -> torch.Tensor:
    return mesh.vertices[:, :2].norm(dim=1)


def crossings(layers: list[Mesh]) -> int:
    stack = Stack.of(layers)
    return len(Crossings(stack.faces, len(stack.x))(stack.x))


def nested(layers: list[Mesh]) -> list[Mesh]:
    """Outermost first: each around those after it."""
    shells, done = Shells(pillar()), list[np.ndarray]()
    for mesh in reversed(layers):
        done.append(shells.around(mesh.vertices.numpy(), done))
    return [m.with_vertices(torch.from_numpy(x)) for m, x in zip(layers, reversed(done))]


def test_a_narrow_tube_ends_around_a_wide_one_in_folds() -> None:
    layers = [tube(0.1, -0.3, 0.3), tube(0.08, -0.2, 0.2), tube(0.14, -0.4, 0.1, 0.02)]
    assert float(radius(layers[0]).max()) < float(radius(layers[2]).min())
    outer, middle, inner = nested(layers)
    assert not crossings([outer, middle, inner])
    assert torch.equal(inner.vertices, layers[2].vertices)
    assert float(radius(middle).min()) > float(radius(inner).max())
    assert float(radius(outer).min()) > float(radius(middle).max())
    # Shells lie close, so that cloth is stretched no more than it must be.
    assert float(radius(outer).max()) < float(radius(inner).max()) + 0.05


def test_folds_stay_where_they_are_around_the_body_and_become_shallow() -> None:
    folded = tube(0.1, -0.2, 0.2, 0.02)
    outer, _ = nested([folded, tube(0.1, -0.3, 0.3)])
    turn = torch.linalg.cross(folded.vertices, outer.vertices)[:, 2] / (radius(folded) * radius(outer))
    assert float(turn.abs().max()) < 0.03
    level, before = (radius(m).unflatten(0, (48, 20))[:, 10] for m in (outer, folded))
    assert float(torch.corrcoef(torch.stack([level, before]))[0, 1]) > 0.7
    assert 0.0005 < float(level.max() - level.min()) < 0.01


def test_what_others_do_not_cover_pushes_nothing_out() -> None:
    skirt = tube(0.1, -0.4, 0.0)
    wide = skirt.vertices.clone()
    wide[:, :2] *= 1 + 4 * (-wide[:, 2:] - 0.2).clamp_min(0)
    outer, _ = nested([tube(0.09, -0.05, 0.3), Mesh(wide, skirt.faces)])
    assert float(radius(outer).max()) < 0.13
    apart, _ = nested([tube(0.09, 0.2, 0.3), Mesh(wide, skirt.faces)])
    assert torch.equal(apart.vertices, tube(0.09, 0.2, 0.3).vertices)


def test_space_goes_with_the_body_and_takes_neighbours_alike() -> None:
    body = load_body()
    pose = body.neutral()
    joints = pose.pose.clone()
    joints[0, JOINT_NAMES.index("l_shoulder"), 2] = -0.8
    joints[0, 0, 1] = 1.0
    pose = BodyPose(pose.shape, joints, torch.tensor([[0.3, 0.1, -0.2]]))
    posed = body.pose(way_to(pose, 10))
    x = posed.mesh.vertices.double().numpy()
    skin = x[0] + 0.003 * np.random.default_rng(0).normal(size=x[0].shape)
    space, at = Space(body, x[0], posed.transforms.double().numpy()), skin
    for k in range(1, 11):
        at = space(k, at)
    away = np.linalg.norm(at - x[-1], axis=1)
    assert np.quantile(away, 0.95) < 0.02 and np.linalg.norm(x[-1] - x[0], axis=1).max() > 0.3
    rigid = np.abs(at - x[-1] - (skin - x[0])).max(1)[body.region_mask("head").numpy()]
    assert len(rigid) and np.median(rigid) < 0.01


def test_a_way_goes_on_and_ways_are_joined() -> None:
    turns = np.arange(2)[:, None, None, None] * np.ones((2, 24, 4, 4))
    way = Dressed([np.zeros((2, 4, 3))], np.stack([np.zeros((5, 3)), np.ones((5, 3))]), turns)
    on = way.then([np.ones((4, 3))], 4)
    assert np.allclose(on.garments[0][:, 0, 0], [0, 0, 0.25, 0.5, 0.75, 1])
    assert on.bodies.shape == (6, 5, 3) and (on.bodies[1:] == 1).all() and (on.transforms[1:] == 1).all()
    late = on.later(3)
    assert late.garments[0].shape == (9, 4, 3) and (late.bodies[:4] == 0).all() and (late.transforms[:4] == 0).all()
