"""DrapeNet's training: what the parts need, what each loss means, and that a few steps help."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from pipelines.drapenet_terms import Covered, nearest, outside, pinned, trunk
from pipelines.train_drapenet import TrainDrapenet, store, train_drapenet
from pipelines.training import Training
from recon.bodies import load_body
from recon.bodies.poses import stroll
from recon.draping.drapenet import DrapeNets, DrapeShape, load_drapenet
from recon.files.weights import read_weights
from recon.garments.dataset import load_garments
from recon.types import Mesh, UserError

BODY = load_body()


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> TrainDrapenet:
    folder = tmp_path_factory.mktemp("motions")
    motion = stroll(1.0)
    np.savez(folder / "stroll.npz", pose=motion.pose, translation=motion.translation, fps=motion.fps)
    quick = {"garments": 4, "vertices": 250, "bodies": 2, "worn": 1, "points": 600, "cleared": 4}
    return TrainDrapenet("field", folder, out=folder.parent / "weights", steps=3, **quick)


def test_parts_build_on_each_other_in_one_file(settings):
    with pytest.raises(UserError, match="field to be learned first"):
        train_drapenet(replace(settings, part="top"))
    train_drapenet(settings)
    with pytest.raises(UserError, match="top and bottom"):
        train_drapenet(replace(settings, part="solver"))
    before = read_weights("drapenet", settings.out).tensors
    for part in ("top", "bottom", "solver"):
        train_drapenet(replace(settings, part=part, terms=100))
    found = read_weights("drapenet", settings.out)
    assert list(found.card["parts"]) == ["field", "top", "bottom", "solver"]
    assert torch.equal(found.tensors["field.net.0.weight"], before["field.net.0.weight"])
    assert not torch.equal(found.tensors["drape.top.maps.0.weight"], before["drape.top.maps.0.weight"])
    assert found.card["shape"]["terms"] == 100
    draper = load_drapenet(BODY, settings.out)
    garment = load_garments("skirt", "test")[0]
    assert draper.drape(garment, BODY.pose(BODY.neutral())).vertices.isfinite().all()


def test_cards_tell_what_a_part_went_on_from(tmp_path):
    nets, config = DrapeNets(DrapeShape(BODY.n_shape)), TrainDrapenet("top", tmp_path, out=tmp_path)
    card = {"shape": asdict(nets.shape), "body": BODY.name, "parts": {"top": {"steps": 7, "minutes": 0.5, "data": "-"}}}
    learner = nets.drape["top"]
    done = Training("t", learner, torch.optim.Adam(learner.parameters()), "", tmp_path, step=9)
    store(nets, card, config, done)
    found = read_weights("drapenet", tmp_path).card["parts"]["top"]
    assert found["steps"] == 9 and found["before"] == {"steps": 7, "minutes": 0.5}


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


def test_what_is_outside_of_a_garment_pays_by_how_far():
    flat = torch.cartesian_prod(torch.linspace(0, 0.3, 13), torch.linspace(0, 0.3, 13))
    x = torch.stack([flat[:, 0], torch.zeros(169), -flat[:, 1]], 1)
    corner = (torch.arange(12)[:, None] * 13 + torch.arange(12)).flatten()
    one, other = (
        torch.stack([corner, corner + 13, corner + 1], 1),
        torch.stack([corner + 1, corner + 13, corner + 14], 1),
    )
    over = Mesh(x[None].clone(), torch.cat([one, other]))
    way = 0.006 * torch.tensor([0.0, 1.0, 0.0])
    a, b = (outside((x + s * way)[None].requires_grad_(), over.faces, over, 0.002) for s in (1.0, -1.0))
    assert a.item() == pytest.approx(0.008, rel=1e-3) and b.item() == 0
