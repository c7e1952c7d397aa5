"""Implicit sewing patterns: training on made garments, decoding, and Eq. 6."""

import json

import numpy as np
import pytest
import torch

from recon.garments.isp import load_isp
from recon.garments.isp_net import FilmNet
from recon.garments.latents import LatentPrior, editing_direction, nearest, of_variants, spread
from recon.garments.sewing import is_manifold
from recon.metrics import boundary_loops, compare_meshes, panel_iou
from recon.types import UserError


def test_folding_a_code_changes_nothing():
    torch.manual_seed(0)
    net = FilmNet(5, width=32, depth=5, code=4)
    x, z = torch.rand(3, 50, 2) * 2 - 1, torch.randn(3, 4)
    together = net(x, z)
    for k in range(3):
        alone = net.run_folded(net.fold(z[k]), x[k])
        torch.testing.assert_close(alone, together[k], atol=1e-5, rtol=1e-5)


def test_long_inputs_run_in_chunks():
    net = FilmNet(2, width=16, depth=3, code=4)
    layers, x = net.fold(torch.randn(4)), torch.rand(9001, 2)
    torch.testing.assert_close(net.run_folded(layers, x)[8000:], net.run_folded(layers, x[8000:]))


def test_training_learns_the_made_garments(training, tubes):
    decoder, state, _ = training
    assert state.step == 260 and len(decoder.codes) == len(tubes)
    generator = torch.Generator().manual_seed(0)
    for k, truth in enumerate(tubes[:3]):
        found = decoder.decode(decoder.codes[k], 128)
        assert panel_iou(found, truth) > 0.93
        assert compare_meshes(found.mesh, truth.mesh, generator, 2000)["surface_mm"] < 8
        assert found.variant == truth.variant


@pytest.mark.parametrize("resolution", [48, 100, 128])
def test_decoded_garments_are_sewn_open_manifolds(decoder, tubes, resolution):
    for k, truth in enumerate(tubes):
        g = decoder.decode(decoder.codes[k], resolution)
        assert is_manifold(g.mesh.faces.numpy())
        assert boundary_loops(g.mesh.faces) == boundary_loops(truth.mesh.faces)
        assert g.mesh.vertices.isfinite().all()
        assert (g.vertex_of_point[g.panel_faces] == g.mesh.faces).all()
        assert len(g.panel_faces) == len(g.panel_of_face) and len(g.border_labels) == len(g.panel_points)
        seam = g.border_labels > 0
        assert (torch.bincount(g.vertex_of_point)[g.vertex_of_point[seam]] == 2).all()


def test_border_points_lie_on_the_zero_level(decoder):
    z = decoder.codes[0]
    g = decoder.decode(z, 96)
    panel = torch.zeros(len(g.panel_points), dtype=torch.long)
    panel[g.panel_faces[g.panel_of_face == 1]] = 1
    border = g.border_labels >= 0
    distance, _ = decoder.pattern(z, g.panel_points[border])
    own = distance[torch.arange(len(distance)), panel[border]].abs()
    assert own.quantile(0.95) < 5e-4


def test_faces_look_outward(decoder):
    g = decoder.decode(decoder.codes[0], 64)
    a, b, c = g.mesh.vertices[g.mesh.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    out = (a * torch.tensor([1.0, 0, 1])).mul(normal).sum(1) > 0
    assert out.float().mean() > 0.97


def test_gradient_of_eq_6_against_finite_differences(decoder):
    """Inner vertices move with A_Φ alone, border vertices also with their panel point."""
    torch.manual_seed(1)
    z, way = decoder.codes[2], torch.randn(decoder.codes.shape[1])
    way, h = way / way.norm(), 2e-3
    g = decoder.decode(z, 64)
    step = torch.zeros((), requires_grad=True)
    probes = torch.randn(2, *g.mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    on_border = torch.zeros(len(g.mesh.vertices), dtype=torch.bool)
    on_border[g.vertex_of_point[g.border_labels >= 0]] = True
    with torch.no_grad():
        ahead, behind = (decoder.decode_like(z + s * h * way, g).mesh.vertices for s in (1, -1))
        slope = (ahead - behind) / (2 * h)
    for decoded in (decoder.decode(z + step * way, 64), decoder.decode_like(z + step * way, g)):
        for part in (on_border, ~on_border):
            for probe in probes:
                weight = probe * part[:, None]
                (found,) = torch.autograd.grad((decoded.mesh.vertices * weight).sum(), step, retain_graph=True)
                wanted = (slope * weight).sum()
                assert abs(found - wanted) < 0.02 * (slope * weight).norm() + 1e-4 * abs(wanted)


def test_a_hem_that_moves_pulls_its_vertices_along(decoder, tubes):
    """The second term of Eq. 6 is there: without it border vertices would not follow the panel's outline."""
    z = decoder.codes[0].clone().requires_grad_()
    g = decoder.decode(z, 64)
    low = g.mesh.vertices[:, 1].argsort()[:20]
    (pull,) = torch.autograd.grad(g.mesh.vertices[low, 1].mean(), z)
    down = z.detach() - 0.3 * pull / pull.norm()
    with torch.no_grad():
        lower = decoder.decode(down, 64).mesh.vertices[:, 1].sort().values[:20].mean()
    moved = float(lower - g.mesh.vertices[low, 1].mean().detach())
    assert moved < 0 and abs(moved + 0.3 * float(pull.norm())) < 0.4 * abs(moved)


def test_decode_like_keeps_topology_and_agrees(decoder):
    g = decoder.decode(decoder.codes[0], 64)
    again = decoder.decode_like(decoder.codes[0], g)
    torch.testing.assert_close(again.mesh.vertices, g.mesh.vertices, atol=2e-4, rtol=0)
    other = decoder.decode(decoder.codes[1], 64)
    fresh = decoder.decode_like(decoder.codes[0], g)  # not the last garment decoded
    torch.testing.assert_close(fresh.mesh.vertices, g.mesh.vertices, atol=2e-4, rtol=0)
    assert len(other.mesh.vertices) != len(g.mesh.vertices)
    assert fresh.mesh.faces is g.mesh.faces


def test_the_same_code_decodes_to_the_same_garment(decoder):
    a, b = (decoder.decode(decoder.codes[1], 96) for _ in range(2))
    assert torch.equal(a.mesh.vertices, b.mesh.vertices) and torch.equal(a.mesh.faces, b.mesh.faces)


def test_a_senseless_code_is_a_user_error(decoder):
    with torch.no_grad():
        far = torch.full_like(decoder.codes[0], 1e4)
    try:
        g = decoder.decode(far, 32)
    except UserError as error:
        assert "\n" not in str(error)
    else:
        assert is_manifold(g.mesh.faces.numpy())


def test_weights_bring_the_decoder_back(training, tubes):
    from pipelines.train_isp import store

    decoder, state, config = training
    path = store(decoder, config, state, {"seen": {}})
    again = load_isp("skirt", path.parent)
    card = json.loads((path.parent / "manifest.json").read_text())["isp-skirt"]
    assert card["steps"] == 260 and card["seed"] == 0 and again.seam_names == decoder.seam_names
    a, b = (d.decode(d.codes[0], 64) for d in (decoder, again))
    assert abs(len(a.mesh.vertices) - len(b.mesh.vertices)) < 0.02 * len(a.mesh.vertices)
    generator = torch.Generator().manual_seed(0)
    assert compare_meshes(a.mesh, b.mesh, generator, 1000)["surface_mm"] < 1.0
    with pytest.raises(UserError, match="isp-hat"):
        load_isp("hat", path.parent)


def test_training_resumes_from_its_checkpoint(tmp_path, tubes):
    from dataclasses import replace

    from pipelines import train_isp as t

    config = t.TrainIsp(kind="skirt", out=tmp_path, steps=3, threads=1, batch=2, width=16, code=4, evaluate=0)
    shape = replace(t.frame(tubes, 4), width=16)
    samples = t.collect(tubes[:2], shape, np.random.default_rng(0))
    training = t.start(samples, shape, config)
    generator = torch.Generator().manual_seed(0)
    training.run(t.Budget(1, 3), lambda share: t.batch_loss(training.module, samples, config, generator))
    assert training.step == 3 and not training.checkpoint.exists()
    training.save()
    other = t.start(samples, shape, replace(config, steps=5))
    other.resume()
    assert other.step == 3 and torch.equal(other.module.codes, training.module.codes)
    with pytest.raises(UserError, match="other settings"):
        t.start(samples, shape, replace(config, seed=4)).resume()


def test_the_prior_knows_typical_codes():
    g = torch.Generator().manual_seed(0)
    codes = torch.randn(200, 6, generator=g) * torch.tensor([3.0, 1, 1, 1, 1, 0.1]) + 2
    prior = LatentPrior.of(codes)
    assert abs(float(prior.energy(codes).mean()) - 1) < 0.25
    assert prior.energy(prior.mean) == 0
    assert prior.energy(prior.mean + 20) > 20
    drawn = prior.sample(500, g)
    torch.testing.assert_close(drawn.mean(0), prior.mean, atol=0.5, rtol=0)


def test_codes_are_retrieved_by_spread_variant_and_distance():
    codes = torch.tensor([[0.0, 0], [0.1, 0], [5, 0], [0, 5], [5, 5]])
    assert set(spread(codes, 3).tolist()) >= {3} or set(spread(codes, 3).tolist()) >= {2}
    assert len(set(spread(codes, 9).tolist())) == 5
    assert of_variants(["tank", "shirt", "tank"], ["tank"]).tolist() == [0, 2]
    assert of_variants(["tank"], ["hat"]).tolist() == [0]
    assert nearest(codes, torch.tensor([4.9, 4.9]), 2)[0] == 4
    way = editing_direction(codes, codes[:, 0] * 2)
    assert way[0] > 0.4 and abs(way[1]) < 0.3
