"""DrapeNet's training: what the parts need, what each loss means, and that a few steps help."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.train_drapenet import Covered, TrainDrapenet, nearest, pinned, train_drapenet, trunk
from recon.bodies import load_body
from recon.bodies.poses import stroll
from recon.draping.drapenet import load_drapenet
from recon.files.weights import read_weights
from recon.garments.dataset import load_garments
from recon.types import UserError

BODY = load_body()


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> TrainDrapenet:
    folder = tmp_path_factory.mktemp("motions")
    motion = stroll(1.0)
    np.savez(folder / "stroll.npz", pose=motion.pose, translation=motion.translation, fps=motion.fps)
    quick = {"garments": 4, "vertices": 250, "bodies": 2, "worn": 1, "points": 600}
    return TrainDrapenet("field", folder, out=folder.parent / "weights", steps=3, **quick)


def test_parts_build_on_each_other_in_one_file(settings):
    with pytest.raises(UserError, match="field to be learned first"):
        train_drapenet(replace(settings, part="top"))
    train_drapenet(settings)
    with pytest.raises(UserError, match="top and bottom"):
        train_drapenet(replace(settings, part="solver"))
    before = read_weights("drapenet", settings.out).tensors
    for part in ("top", "bottom", "solver"):
        train_drapenet(replace(settings, part=part))
    found = read_weights("drapenet", settings.out)
    assert list(found.card["parts"]) == ["field", "top", "bottom", "solver"]
    assert torch.equal(found.tensors["field.net.0.weight"], before["field.net.0.weight"])
    assert not torch.equal(found.tensors["drape.top.maps.0.weight"], before["drape.top.maps.0.weight"])
    draper = load_drapenet(BODY, settings.out)
    garment = load_garments("skirt", "test")[0]
    assert draper.drape(garment, BODY.pose(BODY.neutral())).vertices.isfinite().all()


def test_mistakes(settings):
    with pytest.raises(UserError, match="--part"):
        train_drapenet(replace(settings, part="middle"))
    with pytest.raises(UserError, match="no motion clips"):
        train_drapenet(replace(settings, part="top", motions=settings.out / "nowhere"))


def test_pin_asks_mostly_the_height():
    up, aside = torch.tensor([[[0.0, 0.1, 0.0]]]), torch.tensor([[[0.1, 0.0, 0.0]]])
    assert pinned(up, 0.1).item() == pytest.approx(0.01)
    assert pinned(aside, 0.1).item() == pytest.approx(0.001)


def test_the_trunk_holds_waists_and_not_cuffs():
    garment = load_garments("trousers", "test")[0]
    held = trunk(garment, BODY)
    x = garment.mesh.vertices
    assert 0 < len(held) < 0.7 * len(x)
    assert x[held, 1].max() > x[:, 1].max() - 0.01
    assert x[held, 1].min() > x[:, 1].median()


def test_covered_points_lie_under_both_garments():
    top = min(load_garments("top", "test"), key=lambda g: float(g.mesh.vertices[:, 1].min()))
    trousers = max(load_garments("trousers", "test"), key=lambda g: float(g.mesh.vertices[:, 1].max()))
    covered = Covered.of(BODY, top.mesh, trousers.mesh)
    rest = BODY.rest(BODY.neutral().shape).vertices[0]
    assert len(covered.points) > 20
    y = rest[covered.points, 1]
    assert y.min() > top.mesh.vertices[:, 1].min() - 0.05 and y.max() < trousers.mesh.vertices[:, 1].max() + 0.05
    away = nearest(rest[covered.points][None], trousers.mesh.vertices[None], covered.bottom)
    direct = torch.cdist(rest[covered.points], trousers.mesh.vertices).min(1).values
    assert torch.allclose(away[0], direct, atol=1e-4)
