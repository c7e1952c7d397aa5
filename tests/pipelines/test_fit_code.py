"""Codes found from evidence: a garment's own mesh, pattern and silhouette lead back to it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.decode import Decode, decode
from pipelines.fit_code import CodeFit, Sewable, find_code
from pipelines.fit_evidence import (
    CANDIDATES,
    Bank,
    PatternEvidence,
    SilhouetteEvidence,
    SurfaceEvidence,
    border_points,
    evidence_of,
    front_camera,
)
from recon.files.meshes import write_ply
from recon.garments import load_decoder
from recon.garments.dataset import load_garments
from recon.garments.latents import LatentPrior, nearest, spread
from recon.metrics import panel_iou, sample_surface, surface_distance
from recon.types import UserError

SHORT = CodeFit(starts=1, rounds=2, steps=6)


@pytest.fixture(scope="module")
def decoder():
    return load_decoder("skirt")


@pytest.fixture(scope="module")
def unseen():
    return load_garments("skirt", "test")[2]


@pytest.fixture(scope="module")
def pair(decoder):
    """A learned code's garment, and a learned code not far away."""
    with torch.no_grad():
        garment = decoder.decode(decoder.codes[3], 48)
    return garment, int(nearest(decoder.codes, decoder.codes[3], 15)[14])


def test_a_pattern_leads_to_its_code(decoder, pair):
    truth, start = pair
    evidence = PatternEvidence.of(decoder, truth)
    found = find_code(decoder, evidence, decoder.codes[[start]], CodeFit(starts=1, rounds=2, steps=10))
    with torch.no_grad():
        before, after = (panel_iou(decoder.decode(z, 48), truth) for z in (decoder.codes[start], found.latent))
    assert 1 - after < 0.6 * (1 - before)
    assert float(LatentPrior.of(decoder.codes).energy(found.latent)) < 3


@pytest.mark.parametrize("sparse", [False, True])
def test_a_surface_leads_closer(decoder, pair, sparse):
    truth, start = pair
    points = sample_surface(truth.mesh, 200, torch.Generator().manual_seed(1))[0]
    evidence = SurfaceEvidence(decoder, points if sparse else truth.mesh, 40, 500)
    found = find_code(decoder, evidence, decoder.codes[[start]], SHORT)

    def off(z):
        with torch.no_grad():
            return float(surface_distance(points, decoder.decode(z, 48).mesh)[0].mean())

    assert off(found.latent) < 0.7 * off(decoder.codes[start])


@pytest.fixture(scope="module")
def bank(decoder):
    return Bank(decoder, 24)


@pytest.mark.parametrize("source", ["mesh", "points", "silhouette"])
def test_starts_are_the_closest_learned_garments(decoder, pair, bank, source):
    """Also one that the first round does not look at: the second looks at its neighbours."""
    truth = pair[0]
    evidence: SurfaceEvidence | SilhouetteEvidence
    if source == "silhouette":
        drawn = SilhouetteEvidence(decoder, torch.eye(96, 72), front_camera((96, 72)), 96, 40)
        drawn.take(truth)
        evidence = SilhouetteEvidence(decoder, drawn.image(truth.mesh.vertices), drawn.camera, 96, 40)
    else:
        evidence = SurfaceEvidence(decoder, truth.mesh if source == "mesh" else truth.mesh.vertices, 40, 200)
    first = spread(decoder.codes, bank.count).tolist()
    found = evidence.starts(bank)
    assert len(set(found)) == CANDIDATES
    assert evidence._score(bank[found[0]]) > max(evidence._score(bank[k]) for k in first)


def test_starts_with_other_openings_come_last(decoder, pair, bank):
    evidence = SurfaceEvidence(decoder, pair[0].mesh, 40, 200)
    same = evidence._score(pair[0])
    evidence.loops = 3
    assert evidence._score(pair[0]) == pytest.approx(same - 0.1)


def test_gradients_of_surface_evidence(decoder, unseen):
    evidence = SurfaceEvidence(decoder, unseen.mesh, 40, count=4000)
    code = decoder.codes[5].clone()
    evidence.renew(code)
    z = code.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(evidence(z), z)
    along = gradient / gradient.norm()
    with torch.no_grad():
        change = [float(evidence(code + h * along)) for h in (5e-3, -5e-3)]
    assert (change[0] - change[1]) / 1e-2 == pytest.approx(float(gradient.norm()), rel=0.1)


def test_a_silhouette_leads_closer(decoder, pair):
    truth, start = pair
    camera = front_camera((96, 72))
    drawn = SilhouetteEvidence(decoder, torch.eye(96, 72), camera, 96, 40)
    drawn.take(truth)
    evidence = SilhouetteEvidence(decoder, drawn.image(truth.mesh.vertices), camera, 96, 40)
    before = evidence.figures(decoder.codes[start])["iou"]
    found = find_code(decoder, evidence, decoder.codes[[start]], SHORT)
    assert 1 - evidence.figures(found.latent)["iou"] < 0.8 * (1 - before)


def test_cloth_that_tears_or_stretches_costs(decoder):
    settings = CodeFit(gap=0.01, strain=0.02)
    sewable = Sewable(decoder, settings)
    with torch.no_grad():
        sewable.renew(decoder.decode(decoder.codes[3], 48))
        learned = float(sewable(decoder.codes[3]))
        far = float(sewable(decoder.codes[3] + 3 * torch.randn(32, generator=torch.Generator().manual_seed(0))))
    assert learned < 0.01 and far > 5 * learned


def test_border_points_lie_on_the_border(unseen):
    points = border_points(unseen.mesh.vertices, unseen.mesh.faces)
    assert float(surface_distance(points, unseen.mesh)[0].max()) < 1e-6
    assert len(points) > 100


def test_the_command_finds_a_code(tmp_path, unseen, monkeypatch):
    monkeypatch.setattr("pipelines.fit_evidence.retrieved", lambda codes, *rest: torch.tensor([0]))
    write_ply(unseen.mesh, tmp_path / "scan.ply")
    seen = []
    said = decode(
        Decode(
            ("skirt",),
            tmp_path / "a.obj",
            48,
            code=tmp_path / "a.json",
            fit=tmp_path / "scan.ply",
            search=CodeFit(starts=1, rounds=1, steps=2),
        ),
        tick=lambda step, energy: seen.append(energy),
    )
    assert (tmp_path / "a.json").exists() and said["off_mm"] < 30 and said["open_borders"] == 2


@pytest.mark.parametrize(
    ("name", "says"),
    [("no.ply", "no such file"), ("few.npy", "at least 30"), ("mm.npy", "in metres"), ("black.png", "silhouette")],
)
def test_bad_evidence_is_told_in_one_line(tmp_path, decoder, name, says):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "few.npy", rng.random((5, 3)))
    np.save(tmp_path / "mm.npy", 800 * rng.random((50, 3)))
    import cv2

    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((50, 40), np.uint8))
    with pytest.raises(UserError, match=says):
        evidence_of(decoder, tmp_path / name)


def test_evidence_is_never_written_over(tmp_path, unseen):
    path = tmp_path / "scan.ply"
    write_ply(unseen.mesh, path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="is the evidence"):
        decode(Decode(("skirt",), path, 48, fit=path))
    assert path.read_bytes() == before
