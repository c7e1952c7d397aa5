"""Garments of distance fields in the fits: gradients through the decoding, physics, figures, and what is left out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pipelines.codes import Decoding
from pipelines.fit_body import to_body
from pipelines.fit_garment import GarmentFit, Layer, Models, fit_garment, scene_images
from pipelines.models import load_models
from pipelines.photo import PhotoFit
from pipelines.refine import Refined, Refinement, refine
from pipelines.results import write_results
from recon.bodies import load_body
from recon.cloth.contact import BodyContact
from recon.descend import Descent
from recon.draping import load_draper
from recon.draping.dress import Dressing
from recon.draping.skinning import SkinningDraper
from recon.files.meshes import read_garment
from recon.garments.mesh_udf import Frame
from recon.render.labels import LabelRenderer
from recon.types import Garment, Photo, UserError
from tests.garments.exact_udf import MIDDLE, SLOPE, TubeDecoder
from tests.garments.fields import integral
from tests.pipelines.made import SIZE, made_camera, made_photo, made_values

BODY = load_body()
DECODER = TubeDecoder()
MODELS = Models(BODY, SkinningDraper(BODY), {"skirt": DECODER}, {"skirt": ("skirt",)}, LabelRenderer)
TRUE = torch.tensor([0.7, 0.6])
QUICK = Refinement(dressing=Dressing(frames=3, steps=5), settle=3, rounds=1, steps=3, long_side=64, untangling=20)


@pytest.fixture(scope="module")
def values() -> dict[str, torch.Tensor]:
    """Body and camera of the made photo."""
    return made_values(BODY)


@pytest.fixture(scope="module")
def photo(values) -> Photo:
    """The made photo with the mask of a skirt of known code."""
    plain, posed = made_photo(BODY), BODY.pose(to_body(values))
    garment = DECODER.decode(TRUE, 64)
    worn = MODELS.draper.drape(garment, posed).vertices[0]
    seen = scene_images(posed, [(worn, garment.mesh.faces)], made_camera(), SIZE, MODELS)[0] > 0.5
    return replace(plain, person=torch.maximum(plain.person, seen.float()), garments={"skirt": seen})


@pytest.fixture(scope="module")
def refined(values, photo) -> Refined:
    return refine(values, [Layer("skirt", DECODER.decode(TRUE, 40))], photo, MODELS, QUICK)


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("entry", [0, 1])
def test_gradients_through_the_decoding_are_finite_differences(entry: int, kept: bool) -> None:
    """Freshly meshed and with its topology kept, against meshing anew: the first entry moves the surface, the second
    the borders alone."""
    z = torch.tensor([0.2, -0.3])
    decoding = Decoding(DECODER, 64, refresh=5)
    if kept:
        decoding(z + 0.02)
    free = z.clone().requires_grad_()
    found = decoding(free)
    (gradient,) = torch.autograd.grad(integral(found.mesh.vertices, found.mesh.faces), free)
    step = 0.1 * torch.eye(2)[entry]
    ends = [DECODER.decode(z + s * step, 96).mesh for s in (1, -1)]
    wanted = (integral(*_parts(ends[0])) - integral(*_parts(ends[1]))) / 0.2
    assert float(gradient[entry] / wanted) == pytest.approx(1, abs=0.05)


def _parts(mesh):
    return mesh.vertices, mesh.faces


@pytest.mark.parametrize("change", [0.24, -0.24])
def test_a_kept_topology_follows_the_code(change: float) -> None:
    """By as much as a few steps of a descent move it: six millimetres wider, and each hem twelve longer."""
    decoding, code = Decoding(DECODER, 48, refresh=5), torch.tensor([0.12, change])
    first, second = decoding(torch.zeros(2)), decoding(code)
    assert torch.equal(first.mesh.faces, second.mesh.faces)
    assert DECODER.field(code)(second.mesh.vertices).quantile(0.99) < 1e-3
    anew = DECODER.decode(code, 48).mesh
    for found, wanted in zip(_sizes(second.mesh), _sizes(anew), strict=True):
        assert abs(found - wanted) < 1.5e-3
    free = code.clone().requires_grad_()
    lengthened = _sizes(decoding(free).mesh)[1]
    (gradient,) = torch.autograd.grad(lengthened, free)
    assert float(gradient[1]) == pytest.approx(2 * SLOPE, rel=0.1)


def _sizes(mesh):
    """Median radius, and median height of the upper border over that of the lower one [m]."""
    x = mesh.vertices
    rim = x[Frame.of(mesh).border, 1]
    return x[:, [0, 2]].norm(dim=1).median(), rim[rim > MIDDLE].median() - rim[rim < MIDDLE].median()


def test_the_code_of_a_silhouette_is_found(values, photo) -> None:
    quick = GarmentFit(
        levels=((80, 24),), resolution=32, final_resolution=32, retrieval_resolution=24, retrieval_round=9, starts=1,
        mahalanobis=0.0, neighbourhood=0.0, latent_rate=0.15, descent=Descent(patience=24),
    )  # fmt: skip
    _, layer = fit_garment("skirt", values, [], photo, MODELS, quick)
    assert layer.garment.latent is not None and not layer.garment.has_panels
    best = (DECODER.codes - TRUE).norm(dim=1).min()
    assert (layer.garment.latent - TRUE).norm() < 0.5 * best


def test_refined_without_panels(values, refined: Refined) -> None:
    layer, mesh = refined.layers[0], refined.meshes["skirt"]
    contact = BodyContact(BODY.pose(to_body(values)).mesh.vertices[0], BODY.faces)
    assert not contact.penetrating(torch.cat([mesh.vertices, mesh.vertices[mesh.faces].mean(1)])).any()
    rest, cut = layer.garment.mesh.vertices, layer.garment.unstrained
    assert cut is not None and (cut - rest).abs().max() > 1e-3  # graded to a larger body
    assert layer.coded is not None and layer.coded.shape == rest.shape


def test_results_without_patterns_say_why(values, photo, refined: Refined, tmp_path: Path) -> None:
    config = PhotoFit(photo=Path("made.png"), garments=("skirt",), out=tmp_path, decoder="udf")
    fitted = values, refined.layers, refined.meshes
    result = write_results(config, photo, MODELS, fitted, {"refine": 1.0})
    assert not (tmp_path / "patterns").exists()
    said = json.loads((tmp_path / "result.json").read_text())
    assert said["decoder"] == "udf" and any("no sewing pattern" in note for note in said["notes"])
    figures = said["garments"]["skirt"]
    assert 0.9 < figures["stretch_p95"] < 2 and figures == result.figures["garments"]["skirt"]
    coded, body = result.layers[0].coded, result.body.vertices
    assert coded is not None and (coded.mean(0) - body.mean(0)).norm() < 0.3  # in the same world as all else
    page = (tmp_path / "report.html").read_text()
    assert "No sewing patterns" in page and "patterns/" not in page and "<h2>Sewing patterns" not in page
    text = (tmp_path / "skirt.obj").read_text()
    assert "vt " not in text and "panel" not in text
    back = read_garment(tmp_path / "skirt.obj")
    assert isinstance(back, Garment) and back.kind == "skirt" and not back.has_panels


def test_drapenet_drapes_what_has_no_panels(values) -> None:
    posed = BODY.pose(to_body(values))
    free = TRUE.clone().requires_grad_()
    garment = Decoding(DECODER, 32, refresh=1)(free)
    draped = load_draper("drapenet", BODY).drape(garment, posed).vertices
    assert draped.shape == (1, len(garment.mesh.vertices), 3)
    (gradient,) = torch.autograd.grad(draped[..., 0].square().sum(), free)
    assert gradient[0] > 0  # a wider skirt is wider on the body, too
    with pytest.raises(UserError, match="without panels"):
        load_draper("isp", BODY).drape(garment, posed)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"draper": "iron"}, "found 'iron', wanted one of skinning"),
        ({"decoder": "nurbs"}, "found 'nurbs', wanted one of isp, udf"),
        ({"garments": ("hat",)}, "found hat"),
    ],
)
def test_unknown_models_are_refused(changes, says) -> None:
    config = replace(PhotoFit(photo=Path("a.png"), garments=("skirt",)), **changes)
    with pytest.raises(UserError, match=says):
        load_models(config.garments, config)


def test_panels_are_wanted_by_the_draper_that_needs_them(monkeypatch) -> None:
    monkeypatch.setattr("recon.garments.load_decoder", lambda *a, **k: DECODER)
    config = PhotoFit(photo=Path("a.png"), garments=("skirt",), decoder="udf", draper="isp")
    with pytest.raises(UserError, match="have no panels; wanted drapenet"):
        load_models(config.garments, config)
    assert load_models(config.garments, replace(config, draper="drapenet")).decoders["skirt"] is DECODER
