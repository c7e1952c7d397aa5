"""The space of distance fields: one-to-one, smooth, and what all but touches is apart in it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from pipelines import train_udf as t
from pipelines.udf_samples import Sampling, spread_mesh
from recon.garments.dataset import Item
from recon.garments.mesh_udf import Meshing, mesh_udf
from recon.garments.panels import border_loops
from recon.garments.sewing import is_manifold
from recon.garments.udf import Sided, UdfDecoder, load_udf
from recon.garments.udf_field import MeshField
from recon.garments.udf_grid import Box
from recon.garments.udf_net import UdfNets
from recon.garments.udf_space import STEEPEST, gathered, spread
from recon.metrics import boundary_loops, sample_surface
from recon.types import Mesh
from tests.garments.exact_udf import SHAPE, SidedTube, TubeDecoder
from tests.garments.fields import integral
from tests.garments.synthetic import family

APART = 0.03


def line(end: float = 0.4, count: int = 4001) -> torch.Tensor:
    """(count, 3) places along x."""
    x = torch.linspace(-end, end, count, dtype=torch.float64)
    return torch.stack([x, torch.full_like(x, 0.3), torch.full_like(x, -0.1)], 1)


def test_the_map_is_undone():
    points = line()
    torch.testing.assert_close(gathered(spread(points, APART), APART), points, atol=1e-12, rtol=0)
    torch.testing.assert_close(spread(gathered(points, APART), APART), points, atol=1e-12, rtol=0)
    assert spread(points, 0.0) is points and gathered(points, 0.0) is points


def test_sides_are_moved_apart_and_nothing_else():
    moved = spread(line(), APART)
    assert torch.equal(moved[:, 1:], line()[:, 1:]) and (moved[1:, 0] > moved[:-1, 0]).all()
    assert abs(float(moved[0, 0]) + 0.4 + APART) < 1e-12 and abs(float(moved[-1, 0]) - 0.4 - APART) < 1e-12
    legs = spread(torch.tensor([[-0.001, 0.2, 0.0], [0.001, 0.2, 0.0]]), APART)[:, 0]
    assert legs[1] - legs[0] > 0.016


@pytest.mark.parametrize("there", [spread, gathered])
def test_derivatives_are_those_of_differences_and_continuous(there):
    """In the middle plane as well, where a grid's vertices may lie."""
    points = line(0.1, 40001).requires_grad_()
    (slope,) = torch.autograd.grad(there(points, APART)[:, 0].sum(), points)
    h = 1e-7
    step = torch.tensor([h, 0, 0], dtype=torch.float64)
    with torch.no_grad():
        ends = [there(points + s * step, APART)[:, 0] for s in (1, -1)]
    wanted = (ends[0] - ends[1]) / (2 * h)
    torch.testing.assert_close(slope[:, 0], wanted, rtol=2e-3, atol=1e-6)
    middle = 1 / STEEPEST if there is spread else STEEPEST
    assert abs(float(slope[20000, 0]) / middle - 1) < 1e-9
    assert (slope[1:, 0] / slope[:-1, 0]).log().abs().max() < 0.05  # from one 5 µm to the next


def tubes(gap: float) -> Mesh:
    """Two legs, upright and open, ``gap`` [m] apart in the middle plane."""
    turn = torch.linspace(0, 2 * torch.pi, 49)[:-1]
    rings = torch.stack([torch.stack([0.08 * turn.cos(), torch.full_like(turn, y), 0.08 * turn.sin()], 1)
                         for y in torch.linspace(0.1, 0.4, 24).tolist()])  # fmt: skip
    a = (torch.arange(23)[:, None] * 48 + torch.arange(48)).flatten()
    b = (torch.arange(23)[:, None] * 48 + (torch.arange(48) + 1) % 48).flatten()
    faces = torch.cat([torch.stack([a, a + 48, b], 1), torch.stack([b, a + 48, b + 48], 1)])
    points = rings.flatten(0, 1)
    away = torch.tensor([0.08 + gap / 2, 0.0, 0.0])
    return Mesh(torch.cat([points - away, points + away]), torch.cat([faces, faces + len(points)]))


def test_fields_no_finer_than_the_gap_keep_the_legs_apart():
    """2 mm between the legs and a field that says nothing below 2.5 mm, as learned ones do: apart, they stay two."""
    truth = tubes(0.002)

    def loops(mesh: Mesh) -> int:
        exact = MeshField(mesh)

        def blunt(x: torch.Tensor) -> torch.Tensor:
            return (exact(x).square() + 0.0025**2).sqrt() - 0.0025

        found = mesh_udf(blunt, Box.around(mesh.vertices), Meshing(96, floor=0.002))
        return len(border_loops(found.faces.numpy())) if is_manifold(found.faces.numpy()) else -1

    assert loops(spread_mesh(truth, APART)) == boundary_loops(truth.faces) == 4
    assert loops(truth) != 4


def test_spread_meshes_are_the_same_surface():
    """Edges stay straight when their ends move: quartered, what they cut off is less than a millimetre."""
    truth = tubes(0.002)
    moved = spread_mesh(truth, APART)
    assert spread_mesh(truth, 0.0) is truth and len(moved.faces) == 4 * len(truth.faces)
    assert boundary_loops(moved.faces) == 4
    middles = gathered(moved.vertices[moved.faces].mean(1), APART)
    assert MeshField(truth)(middles).max() < 1e-3


class SpreadTube(SidedTube):
    """A tube that crosses the middle plane, asked in the space where its sides are apart."""

    sided = Sided(torch.eye(2), 0.004)

    def sides(self, points):
        """(N, 3) spread [m] -> (N, 2) [m]."""
        return super().sides(gathered(points, APART))


class SpreadDecoder(TubeDecoder):
    """Skirts of exact size, known in the spread space."""

    def __init__(self):
        super().__init__()
        self.nets = UdfNets(replace(SHAPE, apart=APART))

    def field(self, latent, half=False):
        return SpreadTube(latent)


@pytest.mark.parametrize("entry", [0, 1])
def test_decoded_vertices_come_back_and_carry_the_codes_gradient(entry):
    """Freshly meshed and with its topology kept, against meshing anew at codes beside it."""
    decoder, z = SpreadDecoder(), torch.tensor([0.3, -0.2])
    free = z.clone().requires_grad_()
    fresh = decoder.decode(free, 96)
    faces = fresh.mesh.faces.numpy()
    assert is_manifold(faces) and len(border_loops(faces)) == 2
    assert SidedTube(z).sides(fresh.mesh.vertices)[:, 0].abs().max() < 1e-3
    kept = decoder.decode_like(free, decoder.decode(z + 0.02, 96))
    assert SidedTube(z).sides(kept.mesh.vertices)[:, 0].abs().max() < 1e-3
    step = 0.1 * torch.eye(2)[entry]
    ends = [TubeDecoder().decode(z + s * step, 128).mesh for s in (1, -1)]
    wanted = (integral(ends[0].vertices, ends[0].faces) - integral(ends[1].vertices, ends[1].faces)) / 0.2
    for mesh in (fresh.mesh, kept.mesh):
        (gradient,) = torch.autograd.grad(integral(mesh.vertices, mesh.faces), free)
        assert abs(float(gradient[entry] / wanted) - 1) < 0.05


def test_lower_garments_learn_and_encode_apart_and_cards_bring_the_map_back(tmp_path):
    """Weights without the number were learned without the map."""
    tube = family(1)[0]
    config = t.TrainUdf("lower", out=tmp_path, steps=1, threads=1, batch=1, places=64, encoded=1, width=16,
                        sampling=Sampling(places=200, clouds=1), evaluate=0)  # fmt: skip
    decoder, state = t.learn([Item(tube, {}, 1, (), 1.0)], config)
    assert decoder.nets.shape.apart == 0.03
    assert decoder.nets.shape.high[0] - tube.mesh.vertices[:, 0].max() > 0.05  # the margin, and the map
    t.store(decoder, config, state, {})
    again = load_udf("skirt", tmp_path)
    assert again.nets.shape.apart == 0.03
    cards = json.loads((tmp_path / "manifest.json").read_text())
    del cards["udf-lower"]["shape"]["apart"]
    (tmp_path / "manifest.json").write_text(json.dumps(cards))
    old = load_udf("skirt", tmp_path)
    assert old.nets.shape.apart == 0.0
    points = sample_surface(tube.mesh, 1000, torch.Generator().manual_seed(0))[0]
    assert torch.equal(old.encode(again.spread(points)), again.encode(points))
    assert t.learn([Item(tube, {}, 1, (), 1.0)], replace(config, family="upper"))[0].nets.shape.apart == 0.0


def test_a_training_goes_on_from_the_codes_of_the_same_garments(tmp_path):
    """Networks know garments by these codes; of other garments they begin anew."""
    tubes = [Item(g, {"bottom": 0.1 * k}, 1, (), 1.0) for k, g in enumerate(family(3))]
    config = t.TrainUdf("lower", out=tmp_path / "first", steps=1, threads=1, batch=1, places=64, encoded=1, width=16,
                        sampling=Sampling(places=200, clouds=1), evaluate=0)  # fmt: skip
    decoder, state = t.learn(tubes, config)
    stored = UdfDecoder(decoder.nets, decoder.all_codes + 1, decoder.known)
    on = replace(config, begin=t.store(stored, config, state, {}).parent, out=tmp_path / "second")
    aims = torch.zeros_like(decoder.all_codes)
    assert (t.begun_codes(on, decoder.known, aims) - decoder.all_codes - 1).abs().max() < 2e-3  # stored in half
    assert t.begun_codes(config, decoder.known, aims) is aims
    assert t.begun_codes(on, decoder.known[::-1], aims) is aims
    assert (t.learn(tubes, on)[0].all_codes - decoder.all_codes - 1).abs().max() < 0.1
