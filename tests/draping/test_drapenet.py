"""DrapeNet's networks: Eq. 6 piece by piece, codes of any mesh, the solver, and what the draper does with them."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest
import torch

from recon.bodies import load_body
from recon.cloth.beneath import Beneath
from recon.draping.drapenet import (
    DrapeNetDraper,
    DrapeNets,
    DrapeShape,
    Known,
    group_of,
    load_drapenet,
    under_top,
    widened,
)
from recon.draping.ending import rounds_for
from recon.draping.mlp import waves
from recon.draping.rest_code import RestCode
from recon.files.weights import write_weights
from recon.garments.dataset import load_garments
from recon.metrics import beneath_pct
from recon.types import BodyPose, Garment, Mesh, UserError

BODY = load_body()
TOPS, TROUSERS = load_garments("top", "test"), load_garments("trousers", "test")


@pytest.fixture(scope="module")
def nets() -> DrapeNets:
    torch.manual_seed(0)
    nets = DrapeNets(DrapeShape(BODY.n_shape, code=6, width=24, depth=2, terms=5))
    nets.code.know([g.mesh for g in (*TOPS[:8], *TROUSERS[:4])], torch.Generator().manual_seed(0))
    return nets


def posed(batch: int = 2):
    generator = torch.Generator().manual_seed(1)
    pose = 0.2 * torch.randn(batch, 24, 3, generator=generator)
    shape = 0.5 * torch.randn(batch, BODY.n_shape, generator=generator)
    return BODY.pose(BodyPose(shape, pose, torch.randn(batch, 3, generator=generator)))


def test_shapes_and_any_mesh(nets):
    draper, body = DrapeNetDraper(nets, BODY), posed()
    for garment in (TOPS[0], TROUSERS[0]):
        out = draper.drape(garment, body)
        assert out.vertices.shape == (2, len(garment.mesh.vertices), 3) and out.vertices.isfinite().all()
        assert out.faces is garment.mesh.faces


def test_part_of_a_garment_is_known_as_another(nets):
    draper, whole = DrapeNetDraper(nets, BODY), TOPS[0]
    half = Garment.bare("top", Mesh(whole.mesh.vertices, whole.mesh.faces[: len(whole.mesh.faces) // 2]))
    first, part = draper.known(whole), draper.known(half)
    assert draper.known(half) is part and not torch.allclose(first.code, part.code)
    assert draper.drape(half, posed()).vertices.isfinite().all()
    asked = Garment.bare("top", Mesh(whole.mesh.vertices.clone().requires_grad_(), whole.mesh.faces))
    with torch.no_grad():
        draper.known(asked)
    ending = draper.known(asked).ending  # what was remembered without a gradient is not given out for one
    assert ending is not None and ending.edges.lengths.requires_grad


def test_weights_sum_to_one_and_field_is_of_points_alone(nets):
    x = TOPS[0].mesh.vertices
    weights, directions = nets.field(x)
    assert torch.allclose(weights.sum(1), torch.ones(len(x)), atol=1e-5) and (weights >= 0).all()
    some, other = nets.field(x[5:9])
    assert torch.allclose(some, weights[5:9], atol=1e-5) and torch.allclose(other, directions[5:9], atol=1e-6)


def test_displacement_is_linear_in_the_embedding(nets):
    """dx_ref = B M: the sum over the terms, vertex by vertex."""
    body, net = posed(), nets.drape["top"]
    ready = nets.prepare(TOPS[0].mesh, "top")
    moved, embedding = net(ready.matrix, body), net.embedding(body)
    by_hand = sum(embedding[:, k, None, None] * ready.matrix[k] for k in range(5))
    assert torch.allclose(moved, by_hand, atol=1e-6)
    halves = [nets.prepare(Mesh(TOPS[0].mesh.vertices, f), "top") for f in TOPS[0].mesh.faces.split(1000)]
    assert halves[0].matrix.shape == ready.matrix.shape


@pytest.mark.parametrize("kind", ["top", "trousers"])
def test_the_quick_way_agrees_with_each_vertex_in_full(kind):
    """Shipped networks, a mesh of 30,000 vertices: the product's way through halves and nodes, and the exact one."""
    draper, body = load_drapenet(BODY), posed(3)
    garment = load_garments(kind, "test")[1].mesh
    pick = torch.arange(30_000) % len(garment.vertices)
    noise = 1e-3 * torch.randn(30_000, 3, generator=torch.Generator().manual_seed(0))
    for mesh in (garment, Mesh(garment.vertices[pick] + noise, garment.faces)):
        drapes = []
        for exact in (False, True):
            draper.nets.exact = exact
            ready = draper.nets.prepare(mesh, group_of(kind), code=draper.nets.code(garment))
            drapes.append(ready.place(ready.moved(draper.nets, group_of(kind), body), body))
            assert (ready.nodes is not None) == (len(mesh.vertices) == 30_000 and not exact)
        off = (drapes[0] - drapes[1]).norm(dim=-1)
        assert off.mean() < 4e-4 and off.flatten().quantile(0.99) < 3e-3 and off.max() < 0.02


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.parametrize("batch", [1, 3])
def test_folded_into_the_networks_bodies_drape_as_garments_made_ready(settled, batch):
    """Shipped networks with the solver: what the last layers say for given bodies, and the products of Eq. 6."""
    draper, body = load_drapenet(BODY), posed(batch)
    nets, mesh = draper.nets, TROUSERS[1].mesh
    bound = draper.skinning.bind(mesh.vertices, mesh.faces) if settled else None
    known = Known(bound, nets.code(mesh), nets.code(TOPS[1].mesh))
    quick = nets.draped(mesh, "bottom", body, known)
    nets.exact = True
    full = nets.draped(mesh, "bottom", body, known)
    assert quick.shape == (batch, len(mesh.vertices), 3)
    off = (quick - full).norm(dim=-1)
    assert off.mean() < 4e-4 and off.max() < 5e-3
    alone = nets.draped(mesh, "bottom", body, replace(known, above=None))
    assert (full - alone).norm(dim=-1).mean() > 2 * off.mean()


def test_asked_for_gradients_networks_are_asked_in_full(nets):
    draper = DrapeNetDraper(nets, BODY)
    mesh, net = TOPS[0].mesh, nets.displacements("top")
    code = draper.nets.code(mesh).requires_grad_()
    ready = draper.nets.prepare(mesh, "top", code=code)
    ready.moved(draper.nets, "top", posed()).sum().backward()
    assert code.grad is not None and code.grad.abs().sum() > 0
    assert torch.equal(ready.matrix, net.matrix(mesh.vertices, code))


def test_widened_networks_drape_as_before(nets):
    wide, body = widened(nets, 9), posed()
    assert wide.shape.terms == 9
    before, after = (n.prepare(TOPS[0].mesh, "top").moved(n, "top", body) for n in (nets, wide))
    assert torch.allclose(before, after, atol=1e-6)


def test_where_and_whither_a_person_stands_and_turns_about_up_does_not_matter(nets):
    pose = 0.2 * torch.randn(1, 24, 3, generator=torch.Generator().manual_seed(2))
    pose[:, 0] = 0
    turned = pose.clone()
    turned[:, 0, 1] = 1.3
    shape = torch.zeros(1, BODY.n_shape)
    one = BODY.pose(BodyPose(shape, pose, torch.zeros(1, 3)))
    other = BODY.pose(BodyPose(shape, turned, torch.ones(1, 3)))
    net = nets.displacements("top")
    assert torch.allclose(net.embedding(one), net.embedding(other), atol=1e-5)


def test_codes_tell_garments_apart_and_know_meshes_by_their_surface(nets):
    codes = torch.stack([nets.code(g.mesh) for g in TOPS])
    assert codes.isfinite().all() and codes.abs().max() <= 3
    assert torch.cdist(codes, codes).fill_diagonal_(1).min() > 1e-2
    mesh = TOPS[0].mesh
    middle = mesh.vertices[mesh.faces].mean(1)
    n = len(mesh.vertices) + torch.arange(len(mesh.faces))
    finer = torch.cat([torch.stack([mesh.faces[:, k], mesh.faces[:, (k + 1) % 3], n], 1) for k in range(3)])
    assert torch.allclose(nets.code(Mesh(torch.cat([mesh.vertices, middle]), finer)), codes[0], atol=1e-3)


def test_codes_of_few_garments():
    code = RestCode(points=16, size=8)
    code.know([g.mesh for g in TOPS[:3]], torch.Generator().manual_seed(0))
    assert code(TOPS[0].mesh).shape == (8,) and code.components[3:].abs().max() == 0


def test_the_solver_moves_the_bottom_and_knows_both_codes(nets):
    draper, body = DrapeNetDraper(nets, BODY), posed()
    upper, lower = draper.outfit(TOPS[0], TROUSERS[0], body)
    by_itself = draper.drape(TOPS[0], body).vertices
    assert (upper.vertices - by_itself).norm(dim=-1).median() < 1e-3  # only its last rounds know of the bottom
    alone = draper.drape(TROUSERS[0], body).vertices
    assert (lower.vertices - alone).abs().max() > 1e-5
    _, other = draper.outfit(TOPS[3], TROUSERS[0], body)
    assert (lower.vertices - other.vertices).abs().max() > 1e-6


def test_the_last_rounds_bring_the_top_above_the_bottom(nets):
    draper, body = DrapeNetDraper(nets, BODY), posed()
    wide = TOPS[0].mesh.vertices * torch.tensor([1.05, 1.0, 1.1])
    bottom = Garment.bare("skirt", Mesh(wide, TOPS[0].mesh.faces))
    upper, lower = draper.outfit(TOPS[0], bottom, body)
    beneath = Beneath.of(lower.vertices[0], lower.faces)
    alone = draper.drape(TOPS[0], body)
    before, after = (beneath_pct(m.with_vertices(m.vertices[0]), beneath) for m in (alone, upper))
    assert before > 2 and after < 0.3 * before


def test_gradients_reach_vertices_pose_and_shape(nets):
    generator = torch.Generator().manual_seed(3)
    x = TOPS[0].mesh.vertices[:40].double().requires_grad_()
    faces = torch.arange(39).reshape(13, 3)
    double = DrapeNets(nets.displacements("top").shape).double()
    double.load_state_dict({k: v.double() for k, v in nets.state_dict().items()})
    pose = (0.1 * torch.randn(1, 24, 3, generator=generator)).double().requires_grad_()
    shape = torch.ones(1, BODY.n_shape, dtype=torch.float64, requires_grad=True)

    def total(x, pose, shape):
        body = posed_double(pose, shape)
        ready = double.prepare(Mesh(x, faces), "top")
        return (ready.place(ready.moved(double, "top", body), body) * torch.arange(120).reshape(40, 3)).sum()

    to_x, to_pose, to_shape = torch.autograd.grad(total(x, pose, shape), (x, pose, shape))
    way = torch.randn(24, 3, generator=generator).double()
    slope = (total(x, pose + 1e-6 * way, shape) - total(x, pose - 1e-6 * way, shape)).item() / 2e-6
    assert slope == pytest.approx((to_pose * way).sum().item(), rel=1e-4)
    more = torch.randn(BODY.n_shape, generator=generator).double()
    slope = (total(x, pose, shape + 1e-6 * more) - total(x, pose, shape - 1e-6 * more)).item() / 2e-6
    assert slope == pytest.approx((to_shape * more).sum().item(), rel=1e-4)
    assert to_x.abs().sum() > 0 and not double.code(Mesh(x, faces)).requires_grad


def posed_double(pose, shape):
    parts = ("template", "shape_dirs", "joints", "joint_dirs", "weights")
    body = replace(BODY, **{k: getattr(BODY, k).double() for k in parts})
    return body.pose(BodyPose(shape, pose, torch.zeros(1, 3, dtype=torch.float64)))


def test_layer_loss_asks_the_bottom_to_be_nearer():
    bottom, top = torch.tensor([[0.01, 0.02, 0.03]]), torch.tensor([[0.03, 0.02, 0.03]])
    assert under_top(bottom, top, 0.8).tolist() == pytest.approx([0.004 + 0.006])
    assert under_top(bottom, 2 * bottom, 0.8).item() == 0


def test_waves_have_gradients_and_their_size():
    x = torch.zeros(2, 3, requires_grad=True)
    out = waves(x, 4)
    assert out.shape == (2, 27)
    out.sum().backward()
    assert x.grad is not None and x.grad.isfinite().all()


def test_bare_meshes_are_told_by_how_high_they_reach():
    draper = DrapeNetDraper(DrapeNets(DrapeShape(BODY.n_shape)), BODY)
    assert draper.group(replace(TOPS[0], kind="")) == "top"
    assert draper.group(replace(TROUSERS[0], kind="")) == "bottom"


def test_very_fine_meshes_get_fewer_rounds() -> None:
    flat = torch.zeros(0, 3, dtype=torch.long)
    meshes = (Mesh(torch.zeros(n, 3), flat) for n in (5_000, 50_000, 100_000, 10**6))
    assert [rounds_for(mesh, 48) for mesh in meshes] == [48, 48, 24, 12]


def test_groups_and_files(nets, tmp_path):
    assert group_of("dress") == "top" and group_of("skirt") == "bottom"
    with pytest.raises(UserError, match="hat"):
        group_of("hat")
    with pytest.raises(UserError, match="drapenet"):
        load_drapenet(BODY, tmp_path)
    card = {"shape": asdict(nets.drape["top"].shape), "body": "anny", "parts": {}}
    write_weights("drapenet", dict(nets.state_dict()), card, tmp_path, dtype=torch.float32)
    body, draper = posed(), load_drapenet(BODY, tmp_path)
    expected = DrapeNetDraper(nets, BODY).drape(TOPS[1], body).vertices
    assert torch.allclose(draper.drape(TOPS[1], body).vertices, expected, atol=1e-5)
    write_weights("drapenet", dict(nets.state_dict()), {**card, "body": "smpl"}, tmp_path)
    with pytest.raises(UserError, match="learned for the body smpl"):
        load_drapenet(BODY, tmp_path)
    write_weights("drapenet", {"a": torch.zeros(2)}, card, tmp_path)
    with pytest.raises(UserError, match="describe"):
        load_drapenet(BODY, tmp_path)
