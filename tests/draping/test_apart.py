"""Layers that pass through nothing: untangled where that works, dressed by simulation where it doesn't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.cloth.beneath import Beneath, vertex_normals
from recon.cloth.intersections import Crossings
from recon.cloth.stack import Stack
from recon.cloth.untangle import untangle
from recon.draping import apart
from recon.draping.dress import Dressing
from recon.draping.skinning import SkinningDraper
from recon.garments import load_decoder
from recon.types import Mesh


@pytest.fixture(scope="module")
def worn():
    """Body, its pose, skinning, a skirt and its drape."""
    body, decoder = load_body(), load_decoder("skirt")
    pose = body.neutral()
    joints = pose.pose.clone()
    joints[0, 1, 0] = -0.4
    pose = replace(pose, pose=joints)
    skinning = SkinningDraper(body)
    with torch.no_grad():
        skirt = decoder.decode(decoder.codes[3], 28)
        drape = skinning.drape(skirt, body.pose(pose))
    return body, pose, skinning, skirt, drape.with_vertices(drape.vertices[0])


def test_what_can_be_untangled_is_not_dressed_anew(worn) -> None:
    body, pose, skinning, skirt, drape = worn
    found = apart.draw_apart([skirt], [drape], body, pose, skinning)
    assert found.done.clean and not found.dressed
    assert float((found.layers[0].vertices - drape.vertices).norm(dim=1).mean()) < 0.01


def test_what_cannot_is_dressed_by_simulation(worn, monkeypatch) -> None:
    body, pose, skinning, skirt, drape = worn
    said, asked = list[str](), []

    def stubborn(layers, worn_on=None, settings=None):
        asked.append(layers)
        done = untangle(layers, worn_on, settings)
        return replace(done, left=np.ones((3, 2), int)) if len(asked) == 1 else done

    monkeypatch.setattr(apart, "untangle", stubborn)
    found = apart.draw_apart([skirt], [drape], body, pose, skinning, said.append)
    assert found.dressed and found.done.clean and len(said) == 1
    assert float((asked[1][0].vertices - drape.vertices).norm(dim=1).mean()) > 1e-3
    edges = skirt.mesh.faces[:, :2]
    long, rest = (Mesh(x, skirt.mesh.faces).vertices[edges] for x in (found.layers[0].vertices, skirt.mesh.vertices))
    ratio = (long[:, 0] - long[:, 1]).norm(dim=1) / (rest[:, 0] - rest[:, 1]).norm(dim=1)
    assert 0.8 < float(ratio.quantile(0.05)) and float(ratio.quantile(0.95)) < 1.2


def test_a_simulation_that_ends_no_better_is_not_taken(worn, monkeypatch) -> None:
    body, pose, skinning, skirt, drape = worn
    tangled = replace(untangle([drape]), left=np.ones((3, 2), int))
    monkeypatch.setattr(apart, "untangle", lambda *a: tangled)
    found = apart.draw_apart([skirt.mesh], [drape], body, pose, skinning)
    assert not found.dressed and len(found.done.left) == 3


@pytest.fixture(scope="module")
def narrow_over_wide(worn):
    """A tank top over a wide jacket, coarse."""
    decoder = load_decoder("top")
    width = [p["waist_x"] for p in decoder.parameters]
    kinds = np.array(decoder.variants)
    wide = max(np.flatnonzero(kinds == "jacket"), key=lambda k: width[k])
    narrow = min(np.flatnonzero(kinds == "tank"), key=lambda k: width[k])
    with torch.no_grad():
        return [decoder.decode(decoder.codes[k], 32) for k in (narrow, wide)]


def test_what_is_tangled_in_the_t_pose_begins_around_what_is_beneath(worn, narrow_over_wide, monkeypatch) -> None:
    body, pose, skinning, *_ = worn
    starts, follow = list[object](), apart.followed

    def stubborn(way, garments, body, start=None):
        starts.append(start)
        return None if start is None else follow(way, garments, body, start)

    monkeypatch.setattr(apart, "followed", stubborn)
    monkeypatch.setattr(apart, "FINELY", Dressing(frames=12, steps=5, creases=True))
    monkeypatch.setattr(apart, "DRAWING_IN", 8)
    ends = apart._simulated(narrow_over_wide, body, pose, skinning)
    assert starts[0] is None and starts[1] is not None and len(starts) == 2
    meshes = [Mesh(torch.from_numpy(x), g.mesh.faces) for x, g in zip(ends, narrow_over_wide, strict=True)]
    stack = Stack.of(meshes)
    assert not len(Crossings(stack.faces, len(stack.x))(stack.x))
    over, under = meshes
    lack, _ = Beneath.of(under.vertices, under.faces).lack(over.vertices, vertex_normals(*vars(over).values()), 0.0)
    assert float((lack > 1e-3).double().mean()) < 0.02
