"""The garment data set: its files, its jobs, and one garment from seed to gate."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.dataset import DatasetMake, DatasetPack, jobs, make_dataset, pack_dataset
from recon.bodies import load_body
from recon.garments import KINDS, patterns
from recon.garments.dataset import QUANTUM, VARIANTS, Item, draw, load_garments, load_items, read_items, write_items
from recon.garments.patterns_body import Measures
from recon.garments.patterns_drape import FittingRoom, Verdict
from recon.types import UserError


@pytest.fixture(scope="module")
def room() -> FittingRoom:
    return FittingRoom(Measures.from_body(load_body()))


@pytest.fixture(scope="module")
def items(room: FittingRoom) -> list[Item]:
    """Two placed skirts: garments as they are stored, without the time to drape them."""
    out = []
    for seed in (0, 1):
        sizes = patterns.sample("skirt", seed, room.measures)
        garment = patterns.weld(patterns.cut("skirt", sizes, 0.03), room.measures, room.relief)
        out.append(Item(garment, sizes, 1 + seed, ("stretched",) * seed, 1.01))
    return out


def test_files_give_back_what_was_written(items: list[Item], tmp_path: Path) -> None:
    path = tmp_path / "skirts.npz"
    write_items(path, "skirt", items)
    for before, after in zip(items, read_items(path), strict=True):
        a, b = before.garment, after.garment
        assert (a.mesh.vertices - b.mesh.vertices).abs().max() <= 0.51 * QUANTUM
        assert torch.equal(a.panel_points, b.panel_points)
        for name in ("panel_faces", "panel_of_face", "vertex_of_point", "border_labels"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert torch.equal(a.mesh.faces, b.mesh.faces)
        assert (a.kind, a.variant, a.seam_names) == (b.kind, b.variant, b.seam_names)
        assert after.parameters == pytest.approx(before.parameters, abs=1e-6)
        assert (after.attempts, after.rejected) == (before.attempts, before.rejected)
    again = tmp_path / "again.npz"
    write_items(again, "skirt", read_items(path))
    assert again.read_bytes() == path.read_bytes()
    assert np.load(path, allow_pickle=False)["meta"].dtype == np.uint8


def test_broken_files_are_user_errors(items: list[Item], tmp_path: Path) -> None:
    path = tmp_path / "skirts.npz"
    write_items(path, "skirt", items)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(UserError, match="skirts.npz"):
        read_items(path)
    with pytest.raises(UserError, match="not found"):
        load_garments(tmp_path / "none.npz")
    with pytest.raises(UserError, match="split"):
        load_garments("skirt", "validation")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(UserError, match="no garment file"):
        read_items(tmp_path / "text.npz")


def test_a_garment_from_the_seed_passes_the_gate(room: FittingRoom) -> None:
    item = draw(room, "skirt", "test", 0, seed=1)
    verdict = room.judge(item.garment)
    assert verdict.passed and verdict.as_dict()["crossings"] == 0
    assert verdict.stretch_p95 == pytest.approx(item.stretch_p95)
    again = draw(room, "skirt", "test", 0, seed=1)
    assert torch.equal(again.garment.mesh.vertices, item.garment.mesh.vertices)
    waist = item.garment.mesh.vertices[:, 1].max()
    assert float(waist) == pytest.approx(item.parameters["waist_y"], abs=0.05)


def test_the_gate_says_what_is_wrong(room: FittingRoom, items: list[Item]) -> None:
    g = items[0].garment
    vertices = g.mesh.vertices
    inside = vertices.clone()
    inside[:, 2] *= 0.2
    inside[:, 0] *= 0.2
    assert room.judge(replace(g, mesh=g.mesh.with_vertices(inside))).reason == "in the body"
    wide = (vertices - vertices.mean(0)) * torch.tensor([2.2, 1.0, 2.2]) + vertices.mean(0)
    assert room.judge(replace(g, mesh=g.mesh.with_vertices(wide))).reason == "stretched"
    assert room.judge(replace(g, mesh=g.mesh.with_vertices(vertices * float("nan")))).reason
    assert Verdict(0, 0, 1.01, 3).reason == "self-intersection"
    assert Verdict(0, 0, 1.01, 0).passed and not Verdict(0, 1, 1.01, 0).passed


def test_jobs_are_interleaved_and_tests_come_early(tmp_path: Path) -> None:
    todo = jobs(DatasetMake(out=tmp_path, tops=40, skirts=30, trousers=20, dresses=10, test=4))
    assert len(todo) == 100 + 16 and len({job.path for job in todo}) == len(todo)
    quarter = todo[: len(todo) // 3]
    assert sum(job.split == "test" for job in quarter) == 16
    share = {kind: sum(job.kind == kind and job.split == "train" for job in quarter) for kind in KINDS}
    assert share["top"] > share["skirt"] > share["trousers"] > share["dress"] > 0
    assert set(VARIANTS) == set(KINDS) and all(set(VARIANTS[k]) == set(KINDS[k]) for k in KINDS)
    assert all(sum(shares.values()) == pytest.approx(1) for shares in VARIANTS.values())


def test_a_finished_set_is_not_made_again_and_another_seed_is_refused(items: list[Item], tmp_path: Path) -> None:
    config = DatasetMake(out=tmp_path, tops=0, skirts=2, trousers=0, dresses=0, test=0, seed=4)
    for job, item in zip(jobs(config), items, strict=True):
        write_items(job.path, "skirt", [item])
    assert make_dataset(config)["made"] == 0
    with pytest.raises(UserError, match="seed 4"):
        make_dataset(replace(config, seed=5))
    card = pack_dataset(DatasetPack(tmp_path, tmp_path / "packed"))
    assert card["garments"] == 2 and card["pass_rate"] == pytest.approx(2 / 3, abs=1e-3)
    assert card["licence"] == "CC0-1.0" and json.loads((tmp_path / "packed" / "card.json").read_text()) == card
    assert len(load_items(tmp_path / "packed" / "skirt_train.npz")) == 2
    with pytest.raises(UserError, match="no data set"):
        pack_dataset(DatasetPack(tmp_path / "elsewhere", tmp_path))
