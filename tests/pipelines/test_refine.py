"""The refine stage on a made photo, at settings that take seconds: it runs through, and keeps what it promises."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pipelines.evidence import level
from pipelines.fit_body import to_body, to_camera
from pipelines.fit_garment import Layer, Models
from pipelines.refine import Refined, Refinement, Silhouettes, drawn_apart, push_out, refine
from recon.bodies import load_body
from recon.cloth.contact import BodyContact
from recon.draping.dress import Dressing
from recon.draping.skinning import SkinningDraper
from recon.garments import patterns
from recon.garments.patterns_body import Measures
from recon.garments.patterns_drape import FittingRoom
from recon.render.labels import LabelRenderer
from tests.pipelines.made import SIZE, made_photo, made_values

BODY = load_body()
PHOTO = made_photo(BODY)
MODELS = Models(BODY, SkinningDraper(BODY), {}, {}, LabelRenderer)
QUICK = Refinement(dressing=Dressing(frames=3, steps=5), settle=3, rounds=1, steps=3, long_side=64)


@pytest.fixture(scope="module")
def values() -> dict[str, torch.Tensor]:
    """Body and camera of the made photo."""
    return made_values(BODY)


@pytest.fixture(scope="module")
def layers() -> list[Layer]:
    """A coarse T-shirt and shorts, cut and draped as those of the data set are."""
    room = FittingRoom(Measures.from_body(BODY))
    cut = {v: patterns.cut(v, patterns.sample(v, 0, room.measures), 0.03) for v in ("tshirt", "shorts")}
    return [Layer("top", room.drape(cut["tshirt"])), Layer("trousers", room.drape(cut["shorts"]))]


@pytest.fixture(scope="module")
def refined(values, layers) -> Refined:
    return refine(values, layers, PHOTO, MODELS, QUICK)


def test_nothing_ends_inside_the_body(values, layers, refined: Refined) -> None:
    contact = BodyContact(BODY.pose(to_body(values)).mesh.vertices[0], BODY.faces)
    assert list(refined.meshes) == ["top", "trousers"]
    for layer in layers:
        mesh = refined.meshes[layer.name]
        assert mesh.vertices.dtype == torch.float32 and torch.isfinite(mesh.vertices).all()
        assert not contact.penetrating(torch.cat([mesh.vertices, mesh.vertices[mesh.faces].mean(1)])).any()


def test_panels_are_graded_and_nothing_else_changes(layers, refined: Refined) -> None:
    for before, after in zip(layers, refined.layers, strict=True):
        a, b = before.garment, after.garment
        assert after.name == before.name
        assert torch.equal(refined.meshes[after.name].faces, a.mesh.faces)
        assert torch.isfinite(b.panel_points).all() and (b.panel_points - a.panel_points).abs().max() > 1e-3
        for name in ("panel_faces", "panel_of_face", "vertex_of_point", "border_labels"):
            assert torch.equal(getattr(b, name), getattr(a, name)), name
        assert torch.equal(b.mesh.vertices, a.mesh.vertices) and torch.equal(b.mesh.faces, a.mesh.faces)


def test_twice_the_same(values, layers, refined: Refined) -> None:
    again = refine(values, layers, PHOTO, MODELS, QUICK)
    for name, mesh in refined.meshes.items():
        assert torch.equal(again.meshes[name].vertices, mesh.vertices)
    for a, b in zip(again.layers, refined.layers):
        assert torch.equal(a.garment.panel_points, b.garment.panel_points)


def test_evidence_gradient_is_finite_differences(values, layers, refined: Refined) -> None:
    """Along smooth moves, and far from the body: where surfaces cross, images have no gradient."""
    at = level(PHOTO, 288)
    camera, place = at.camera(to_camera(values, SIZE)), to_body(values)
    away = BODY.pose(replace(place, translation=place.translation + torch.tensor([0.0, 0.0, -200.0])))
    part = refined.meshes["top"].vertices.double().numpy()
    evidence = Silhouettes(away, [refined.meshes["top"].faces], at.pick(("top",)), camera, MODELS, 60.0)
    value, gradient = evidence([part])
    assert 0 < value < 60 and gradient.shape == part.shape
    for step in ((part - part.mean(0)) * [1, 0, 0] / 0.3, np.zeros_like(part) + [0, 1, 0]):
        sizes = (0.004, 0.006)  # several: a grid of samples makes steps
        along = [(evidence([part + h * step])[0] - evidence([part - h * step])[0]) / (2 * h) for h in sizes]
        assert (gradient * step).sum() == pytest.approx(np.mean(along), rel=0.12, abs=3.0)


def test_evidence_pulls_cloth_back_over_its_mask(values, layers, refined: Refined) -> None:
    at = level(PHOTO, 64).pick(("trousers",))
    mesh = refined.meshes["trousers"]
    posed, camera = BODY.pose(to_body(values)), at.camera(to_camera(values, SIZE))
    evidence = Silhouettes(posed, [mesh.faces], at, camera, MODELS, 60.0)
    aside = mesh.vertices.double().numpy() + [0.05, 0.0, 0.0]
    assert evidence([aside])[1][:, 0].sum() > 1.0
    double = Silhouettes(posed, [mesh.faces], at, camera, MODELS, 120.0)
    assert double([aside])[0] == pytest.approx(2 * evidence([aside])[0], rel=1e-5)


def test_push_out_ends_with_the_margin_and_moves_nothing_else(layers) -> None:
    contact = BodyContact(BODY.pose(BODY.neutral()).mesh.vertices[0], BODY.faces)
    mesh = layers[1].garment.mesh
    dented = torch.arange(len(mesh.vertices)) % 7 == 0
    x, middle = mesh.vertices.clone(), mesh.vertices.mean(0)
    x[dented] = middle + (x[dented] - middle) * torch.tensor([0.93, 1.0, 0.93])
    assert contact.penetrating(x).any()
    out = push_out(x, mesh.faces, contact, QUICK.margin)
    assert contact.signed_distance(torch.cat([out, out[mesh.faces].mean(1)])).min() >= QUICK.margin
    far = contact.signed_distance(mesh.vertices) > 0.03
    far[mesh.faces[dented[mesh.faces].any(1)].unique()] = False
    assert far.any() and torch.equal(out[far], x[far])
    assert torch.equal(push_out(out, mesh.faces, contact, QUICK.margin), out)


def test_layers_that_stay_tangled_are_led_to_their_places(values, layers, refined: Refined, monkeypatch) -> None:
    contact = BodyContact(BODY.pose(to_body(values)).mesh.vertices[0], BODY.faces)
    faces = [layer.garment.mesh.faces for layer in layers]
    good = [refined.meshes[layer.name].vertices.double().numpy() for layer in layers]
    tangled = [good[0], good[1] + np.array([0.0, 0.1, 0.0])]
    monkeypatch.setattr("pipelines.refine.untangle", lambda meshes, *rest: Came([m.vertices.numpy() for m in meshes]))
    asked = []

    def led() -> list[np.ndarray]:
        asked.append(1)
        return good

    for parts in (good, tangled):
        found = drawn_apart(parts, faces, contact, QUICK, led)
        assert all(np.allclose(m.vertices.numpy(), x, atol=1e-6) for m, x in zip(found, good, strict=True))
    assert len(asked) == 1
    assert len(drawn_apart(tangled, faces, contact, replace(QUICK, untangling=0), led)) == 2 and len(asked) == 1


@dataclass
class Came:
    """Layers as they came."""

    vertices: list[np.ndarray]
