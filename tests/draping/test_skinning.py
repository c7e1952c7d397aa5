"""Draping by skinning: identity at rest, no tearing between legs, symmetry, agreement of lattice and exact binding."""

from __future__ import annotations

import pytest
import torch

from recon.bodies import load_body
from recon.draping.binding import METHODS, NEAREST, WIDTH
from recon.draping.skinning import SkinningDraper
from recon.types import BodyPose, Garment, Mesh

BODY = load_body()
DRAPER = SkinningDraper(BODY)


def tube(low: float, high: float, around: int = 48, along: int = 30) -> Garment:
    """An open tube about the legs: a skirt."""
    angle = torch.arange(around) * (2 * torch.pi / around)
    a, y = torch.meshgrid(angle, torch.linspace(low, high, along), indexing="ij")
    vertices = torch.stack([0.25 * a.cos(), y, 0.2 * a.sin() + 0.02], -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(around), torch.arange(along - 1), indexing="ij")
    p, q = (i * along + j).reshape(-1), ((i + 1) % around * along + j).reshape(-1)
    faces = torch.cat([torch.stack([p, p + 1, q], 1), torch.stack([q, p + 1, q + 1], 1)])
    blank = torch.zeros(len(vertices), dtype=torch.long)
    flat = torch.stack([a.reshape(-1) * 0.22, y.reshape(-1)], 1)
    return Garment(
        "skirt", Mesh(vertices, faces), flat, faces, torch.zeros(len(faces), dtype=torch.long), blank, blank - 1
    )


def walking() -> BodyPose:
    place = BODY.neutral()
    pose = place.pose.clone()
    pose[0, 1, 0], pose[0, 2, 0] = -0.5, 0.4
    return BodyPose(place.shape, pose, place.translation)


def edge_stretch(rest: torch.Tensor, posed: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return (posed[edges[:, 0]] - posed[edges[:, 1]]).norm(dim=1) / (rest[edges[:, 0]] - rest[edges[:, 1]]).norm(dim=1)


def test_neutral_body_leaves_the_garment_where_it_was():
    skirt = tube(0.4, 1.0)
    out = DRAPER.drape(skirt, BODY.pose(BODY.neutral(2)))
    assert out.vertices.shape == (2, len(skirt.mesh.vertices), 3)
    torch.testing.assert_close(out.vertices[1], skirt.mesh.vertices, atol=1e-5, rtol=0)


def test_skirt_does_not_tear_between_the_legs():
    skirt = tube(0.4, 1.0)
    most = {}
    for method in METHODS:
        draper = SkinningDraper(BODY, method, lattice=False)
        posed = draper.drape(skirt, BODY.pose(walking())).vertices[0]
        most[method] = edge_stretch(skirt.mesh.vertices, posed, skirt.mesh.faces).max().item()
    assert most["rbf"] < 2.2 and most["rbf"] < 0.7 * most["gaps"] < 0.5 * most["nearest"], most
    assert most["gaps"] < 0.5 * min(most["nearest"], most["k_nearest"]), most


def test_participation_agrees_with_the_full_sum():
    generator = torch.Generator().manual_seed(0)
    at = torch.randint(BODY.n_vertices, (300,), generator=generator)
    away = torch.randn(300, 3, generator=generator) * torch.tensor([0.003, 0.03, 0.1]).repeat(100)[:, None]
    points, field = BODY.template[at] + away, DRAPER.field
    distance = torch.cdist(points, field.vertices)
    m = distance.min(1, keepdim=True).values
    share = torch.exp(-((distance - m) ** 2) / (WIDTH * m.clamp_min(NEAREST) ** 2))  # GAPS Eq. 5-7, all of them
    full = share @ field.features / share.sum(1, keepdim=True)
    off = (METHODS["gaps"](field, points, None) - full).abs()
    assert off[:, :24].max() < 0.15 and off[:, :24].sum(1).mean() < 0.02
    assert off[:, 24:].max() < 0.003


def test_tight_cloth_keeps_the_weights_of_the_skin():
    skin = BODY.region_mask("torso", "legs")
    faces = BODY.faces[skin[BODY.faces].all(1)]
    used, faces = faces.unique(return_inverse=True)
    weights, _ = SkinningDraper(BODY, lattice=False).bind(BODY.template[used], faces)
    assert (weights - BODY.weights[used]).abs().sum(1).mean() < 0.02


def test_left_and_right_mirror():
    points = tube(0.4, 1.0).mesh.vertices
    mirrored = points * torch.tensor([-1.0, 1.0, 1.0])
    swap = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20, 23, 22]
    exact = SkinningDraper(BODY, lattice=False)
    torch.testing.assert_close(exact.bind(points)[0], exact.bind(mirrored)[0][:, swap], atol=0.02, rtol=0)


def test_lattice_agrees_with_the_exact_binding_when_posed():
    skirt = tube(0.5, 1.0)
    exact = SkinningDraper(BODY, lattice=False).drape(skirt, BODY.pose(walking())).vertices
    quick = DRAPER.drape(skirt, BODY.pose(walking())).vertices
    apart = (exact - quick).norm(dim=-1)
    assert apart.mean() < 0.002 and apart.max() < 0.01


def test_taller_bodies_wear_longer_garments():
    skirt = tube(0.4, 1.0)
    shape = BODY.shape_from(height=1.85)
    out = DRAPER.drape(skirt, BODY.pose(BodyPose(shape, torch.zeros(1, 24, 3), torch.zeros(1, 3)))).vertices[0]
    extent = out[:, 1].max() - out[:, 1].min()
    assert 0.6 < extent < 0.75


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_rows_that_sum_to_one(method):
    skirt = tube(0.5, 1.0, 16, 8)
    weights, directions = SkinningDraper(BODY, method, lattice=False).bind(skirt.mesh.vertices, skirt.mesh.faces)
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)))
    assert directions.shape == (len(weights), 3, BODY.n_shape)


def test_gradients_match_finite_differences():
    points = tube(0.5, 0.9, 8, 4).mesh.vertices.double() + 0.007
    field = torch.randn(points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    place = walking()

    def value(x: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
        pose = place.pose + angle * torch.nn.functional.one_hot(torch.tensor(3), 72).reshape(1, 24, 3)
        posed = BODY.pose(BodyPose(place.shape, pose.float(), place.translation))
        return (DRAPER.drape_vertices(Mesh(x.float(), torch.zeros(0, 3)), posed)[0].double() * field).sum()

    x, angle = points.clone().requires_grad_(), torch.zeros((), dtype=torch.float64, requires_grad=True)
    gx, ga = torch.autograd.grad(value(x, angle), (x, angle))
    h = 1e-3
    step = torch.randn(points.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along = (value(points + h * step, angle) - value(points - h * step, angle)) / (2 * h)
    assert abs(along - (gx * step).sum()) < 0.03 * abs(along) + 0.02
    turned = (value(points, angle + h) - value(points, angle - h)) / (2 * h)
    assert abs(turned - ga) < 0.02 * abs(turned) + 1e-3


def test_unknown_method_is_named():
    with pytest.raises(ValueError, match="wanted one of rbf"):
        SkinningDraper(BODY, "magic")
