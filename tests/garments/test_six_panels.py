"""A shirt of six panels through the same code: cut, stored, learned, decoded and sewn (ISP appendix C)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.eval_isp import label_accuracy, seam_gap
from pipelines.fit_code import CodeFit, Sewable, find_code
from pipelines.fit_evidence import PatternEvidence
from pipelines.train_isp import TrainIsp, learn, store
from recon.bodies import load_body
from recon.cloth.energies import Cloth
from recon.files.pattern_reading import read_svg
from recon.files.patterns import cut_pieces, write_svg
from recon.garments import patterns
from recon.garments.dataset import Item, read_items, write_items
from recon.garments.isp import load_isp
from recon.garments.outlines import panel_loops, with_length, with_sleeves
from recon.garments.patterns_body import Measures
from recon.garments.patterns_place import BodyRelief
from recon.garments.sewing import is_manifold, sewn_to
from recon.metrics import boundary_loops, compare_meshes, panel_iou
from recon.types import UserError

PANELS = patterns.PANEL_NAMES["shirt6"]
SMALL = {"width": 96, "pattern_depth": 2, "surface_depth": 3, "code": 4}
QUICK = {"batch": 2, "surface_points": 16, "border_points": 8, "pattern_points": 800, "rate": 1e-2}


@pytest.fixture(scope="module")
def items():
    """Two shirts, sewn and placed around the body, but not simulated: that would take a while."""
    measures = Measures.from_body(load_body())
    relief = BodyRelief.of(measures)
    found = []
    for variant in ("tshirt6", "shirt6"):
        parameters = patterns.sample(variant, 1, measures)
        garment = patterns.weld(patterns.cut(variant, parameters, 0.022), measures, relief)
        found.append(Item(garment, parameters, 1, (), 1.0))
    return found


@pytest.fixture(scope="module")
def training(items, tmp_path_factory):
    out = tmp_path_factory.mktemp("six")
    config = TrainIsp("shirt6", out=out, steps=330, threads=1, evaluate=0, **SMALL, **QUICK)
    return *learn([item.garment for item in items], config, [item.parameters for item in items]), config


@pytest.fixture(scope="module")
def decoder(training):
    return training[0]


def test_sleeves_and_trunk_share_the_plane_and_no_cloth(items):
    garment = items[0].garment
    middles = garment.panel_points[garment.panel_faces].mean(1)
    for name in PANELS[2:]:
        mine = middles[garment.panel_of_face == PANELS.index(name)]
        assert (mine[:, 0] > 0).all() == name.endswith("left") and garment.side_of_face.max() == 1
    area = sum(abs(float(np.linalg.det((p[1:] - p[0]).numpy()))) for p in garment.panel_points[garment.panel_faces])
    assert float(Cloth.from_garment(garment).masses.sum()) == pytest.approx(area / 2 * 0.47e-3 * 426, rel=1e-3)


def test_where_four_panels_meet_there_is_one_vertex(items):
    garment = items[0].garment
    count = torch.bincount(garment.vertex_of_point)
    assert int((count == 4).sum()) == 4  # two armpits, two shoulder tips
    assert int(count.max()) == 4
    partner = sewn_to(garment.vertex_of_point.numpy())
    assert (garment.vertex_of_point[partner] == garment.vertex_of_point).all()
    assert ((partner == np.arange(len(partner))) == (count[garment.vertex_of_point] == 1).numpy()).all()


def test_files_keep_the_panels(items, tmp_path):
    write_items(tmp_path / "six.npz", "shirt6", items)
    for item, again in zip(items, read_items(tmp_path / "six.npz"), strict=True):
        assert again.garment.panel_names == PANELS
        assert torch.equal(again.garment.panel_of_face, item.garment.panel_of_face)


def test_the_pattern_has_six_pieces(items):
    pieces = [cut_pieces(items[0].garment, k) for k in range(6)]
    assert [p[0].name for p in pieces] == [name.replace("_", " ") for name in PANELS]
    assert all(len(p) == 1 for p in pieces)
    seams = [run for p in pieces for run in p[0].runs if run.label > 0]
    assert len(seams) == 2 * (len(patterns.SEAM_NAMES["shirt6"]) - 1)


def test_the_pattern_comes_back_from_its_file_and_is_edited(items, tmp_path):
    write_svg(items[1].garment, tmp_path / "six.svg")
    panels, own = read_svg(tmp_path / "six.svg", PANELS), panel_loops(items[1].garment)
    assert [len(loops) for loops in panels] == [1] * 6
    for loops, truth in zip(panels, own, strict=True):
        assert np.abs(loops[0].min(0) - truth[0].min(0)).max() < 1e-5 > np.abs(loops[0].max(0) - truth[0].max(0)).max()
    text = (tmp_path / "six.svg").read_text()
    (tmp_path / "five.svg").write_text(text.replace("cut-sleeve-back-left", "gone"))
    with pytest.raises(UserError, match="no path called cut-sleeve-back-left...; wanted the outline of all 6 panels"):
        read_svg(tmp_path / "five.svg", PANELS)
    known = items[1].parameters
    shorter = with_sleeves(with_length(panels, 0.8, "shirt6", known), 0.6, known)
    for k, name in enumerate(PANELS):
        part = 1 if name.startswith("sleeve") else 0  # sleeves get shorter along x, the trunk along y
        change = np.ptp(panels[k][0], axis=0) - np.ptp(shorter[k][0], axis=0)
        assert change[1 - part] > 0.05 and abs(change[part]) < 1e-9


def test_a_learned_shirt_is_sewn_from_six_panels(decoder, items):
    generator = torch.Generator().manual_seed(0)
    for code, item in zip(decoder.codes, items, strict=True):
        garment, truth = decoder.decode(code, 128), item.garment
        assert garment.panel_names == PANELS and set(garment.panel_of_face.tolist()) == set(range(6))
        assert is_manifold(garment.mesh.faces.numpy())
        assert boundary_loops(garment.mesh.faces) == 4  # neck, hem, two cuffs
        assert panel_iou(garment, truth) > 0.9
        assert compare_meshes(garment.mesh, truth.mesh, generator, 2000)["surface_mm"] < 8
        assert label_accuracy(decoder, code, truth) > 0.85
        assert set(garment.border_labels[garment.border_labels > 0].tolist()) == set(range(1, 13))


def test_its_gradient_is_that_of_finite_differences(decoder):
    code = decoder.codes[0]
    way = torch.randn(4, generator=torch.Generator().manual_seed(0))
    like = decoder.decode(code, 64)
    weight = torch.randn(len(like.mesh.vertices), 3, generator=torch.Generator().manual_seed(1))

    def value(z):
        return (decoder.decode_like(z, like).mesh.vertices * weight).sum()

    z = code.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(z), z)
    with torch.no_grad():
        change = float(value(code + 1e-3 * way) - value(code - 1e-3 * way)) / 2e-3
    assert float(gradient @ way) == pytest.approx(change, rel=0.02)


def test_gaps_are_those_of_the_panels_that_a_seam_joins(decoder, items):
    garment = items[0].garment
    joined = {
        frozenset(garment.panel_of_point[garment.border_labels == label].tolist())
        for label in range(1, len(garment.seam_names))
    }
    sewable = Sewable(decoder, CodeFit(strain=0.0, gap=1.0))
    sewable.renew(garment)
    assert len(joined) == 7 and {frozenset(pair) for pair in sewable.seam_panels.tolist()} >= joined
    with torch.no_grad():
        apart = float(sewable(decoder.codes[0])) / 100 * decoder.nets.shape.half
    assert apart < 0.006 and float(seam_gap(decoder, decoder.decode(decoder.codes[0], 64)).mean()) < 0.05


def test_its_code_is_found_from_its_panels(decoder, items):
    evidence = PatternEvidence.of(decoder, items[1].garment)
    assert evidence.distance.shape[1] == 6 and evidence.starts()[0] == 1
    found = find_code(decoder, evidence, decoder.codes[[0]], CodeFit(starts=1, rounds=3, steps=8))
    with torch.no_grad():
        before, after = (panel_iou(decoder.decode(z, 64), items[1].garment) for z in (decoder.codes[0], found.latent))
    assert 1 - after < 0.8 * (1 - before)


def test_weights_bring_it_back(training):
    decoder, done, config = training
    store(decoder, config, done, {})
    again = load_isp("shirt6", config.out)
    places = torch.rand(50, 2, generator=torch.Generator().manual_seed(0))
    one, other = (d.surface(decoder.codes[0], places) for d in (decoder, again))
    assert again.nets.shape.panel_names == PANELS and one.shape == (50, 6, 3)
    torch.testing.assert_close(one, other, atol=5e-3, rtol=0)
