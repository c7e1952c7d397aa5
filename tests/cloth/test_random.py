"""No NaN from ten thousand random meshes on random poses: slivers, points, repeated corners and fans among them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.cloth.energies import Cloth, bending, stvk
from recon.cloth.frames import FramePhysics, FrameWeights
from recon.cloth.inextensible import OneRings, inextensibility
from recon.types import BodyPose, Mesh

TRIALS, MESHES, POSES = 10, 100, 10


def random_piece(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A little mesh of any kind: in a plane, along a line, in one point, with corners repeated, edges of many faces."""
    count = int(rng.integers(3, 10))
    x = rng.uniform(0, 0.1, (count, 3))
    flat = int(rng.integers(0, 4))
    x[:, rng.permutation(3)[:flat]] = rng.uniform(0, 0.1)  # 3 leaves a point, 2 a line along an axis, 1 a plane
    if rng.random() < 0.2:
        x[rng.integers(count)] = x[rng.integers(count)]
    return x, rng.integers(0, count, (int(rng.integers(1, 12)), 3))


def random_pieces(rng: np.random.Generator) -> Mesh:
    """``MESHES`` of them in one mesh, around the body's trunk."""
    vertices, faces, first = [], [], 0
    for _ in range(MESHES):
        x, f = random_piece(rng)
        vertices.append(x + rng.uniform([-0.4, 0.4, -0.3], [0.4, 1.4, 0.3]))
        faces.append(f + first)
        first += len(x)
    return Mesh(torch.as_tensor(np.concatenate(vertices)), torch.as_tensor(np.concatenate(faces)))


@pytest.mark.parametrize("seed", range(TRIALS))
def test_energies_and_gradients_of_anything_are_numbers(seed: int) -> None:
    rng, body = np.random.default_rng(seed), load_body()
    template = random_pieces(rng)
    cloth, rings = Cloth.from_mesh(template), OneRings.of(template.vertices, template.faces)
    generator = torch.Generator().manual_seed(seed)
    pose = torch.randn(POSES, 24, 3, generator=generator)
    shape = torch.randn(POSES, body.n_shape, generator=generator)
    with torch.no_grad():
        posed = body.pose(BodyPose(shape, pose, torch.zeros(POSES, 3)))
    spread = torch.tensor([0.0, 1e-12, 1e-3, 0.1, 10.0])[torch.arange(POSES) % 5, None, None]
    x = template.vertices + spread * torch.randn(POSES, *template.vertices.shape, generator=generator)
    x[0] = x[0, :1]  # everything in one point
    x.requires_grad_()
    weights = FrameWeights(collision=1e4, margin=0.006, inextensibility=1e-4, steep=0.007)
    rest = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
    energy, terms = FramePhysics(cloth, rings, rest, weights, POSES)(x, posed.mesh.vertices, epoch=50)
    twins = torch.stack([stvk(cloth, one) + bending(cloth, one) + inextensibility(rings, one) for one in x])
    for value in (energy, twins):
        assert bool(torch.isfinite(value).all())
        (gradient,) = torch.autograd.grad(value.sum(), x, retain_graph=True)
        assert bool(torch.isfinite(gradient).all())
    assert all(bool(torch.isfinite(v).all()) for v in terms.values())
