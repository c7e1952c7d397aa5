"""Random tangles of draped garments for ``benchmarks/gaps.py``: two to five layers, up to a tenth of the area."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon.bodies import load_body
from recon.cloth.intersections import Crossings
from recon.cloth.untangle import untangle
from recon.garments.dataset import load_garments
from recon.types import Garment, Mesh

ORDER = ("jacket", "dress", "top", "skirt", "trousers")
"""Outermost first; of each at most one is worn, so there are up to five layers."""
MOST = 0.10
"""Share of the area that may be tangled at first."""


@dataclass(frozen=True)
class Wardrobe:
    """Test garments, each at rest on the neutral body."""

    garments: dict[str, list[Garment]]
    body: Mesh

    @classmethod
    def load(cls) -> Wardrobe:
        """The data set's unseen garments."""
        tops = load_garments("top", "test")
        body = load_body()
        kinds = {kind: list(load_garments(kind, "test")) for kind in ("dress", "skirt", "trousers")}
        jackets = [g for g in tops if g.variant == "jacket"]
        others = [g for g in tops if g.variant != "jacket"]
        rest = body.rest(body.neutral().shape).vertices[0]
        return cls({"jacket": jackets, "top": others, **kinds}, Mesh(rest, body.faces))


def puffed(mesh: Mesh, distance: float) -> Mesh:
    """The mesh moved along its normals by ``distance`` [m]."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(mesh.vertices).index_add(0, mesh.faces.flatten(), normal.repeat_interleave(3, 0))
    return mesh.with_vertices(mesh.vertices + distance * torch.nn.functional.normalize(total, dim=1))


def tangled_share(layers: list[Mesh]) -> float:
    """Share of the area whose faces pass through others."""
    starts = np.cumsum([0, *[len(m.vertices) for m in layers]])
    x = np.concatenate([m.vertices.double().numpy() for m in layers])
    f = np.concatenate([m.faces.numpy() + at for m, at in zip(layers, starts)])
    search = Crossings(f, len(x))
    area = np.linalg.norm(np.cross(x[f[:, 1]] - x[f[:, 0]], x[f[:, 2]] - x[f[:, 0]]), axis=1)
    return float(area[np.unique(search.pairs(search(x)))].sum() / area.sum())


def layers_of(wardrobe: Wardrobe, rng: np.random.Generator) -> list[Mesh]:
    """Two to five layers put over each other without knowing of each other, whatever their sizes."""
    count = int(rng.integers(2, 6))
    names = sorted(rng.choice(ORDER, count, replace=False), key=ORDER.index)
    return [wardrobe.garments[name][rng.integers(len(wardrobe.garments[name]))].mesh for name in names]


def unfitting(wardrobe: Wardrobe, rng: np.random.Generator) -> list[Mesh]:
    """Layers of any sizes, puffed out until at most ``MOST`` is tangled: wide ones may have to go under narrow ones."""
    worn = layers_of(wardrobe, rng)
    for step in range(12):
        layers = [puffed(m, 0.0015 * step * (len(worn) - 1 - k)) for k, m in enumerate(worn)]
        if tangled_share(layers) <= MOST:
            break
    return layers


def displaced(wardrobe: Wardrobe, rng: np.random.Generator) -> list[Mesh]:
    """Layers that fit over each other, each displaced by smooth noise until just under ``MOST`` is tangled."""
    while True:
        worn = unfitting(wardrobe, rng)
        done = untangle(worn, wardrobe.body)
        if done.clean:
            break
    fitting = [m.with_vertices(torch.from_numpy(x).float()) for m, x in zip(worn, done.vertices, strict=True)]
    fields = [smooth_noise(m.vertices, rng) for m in fitting]
    layers = fitting
    for size in np.geomspace(3e-4, 0.03, 24):
        moved = [m.with_vertices(m.vertices + size * noise) for m, noise in zip(fitting, fields, strict=True)]
        if tangled_share(moved) > MOST:
            break
        layers = moved
    return layers


def smooth_noise(x: torch.Tensor, rng: np.random.Generator, waves: int = 24) -> torch.Tensor:
    """(V, 3) displacements of unit size with wavelengths from 20 to 60 cm."""
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    frequency = 2 * np.pi / rng.uniform(0.2, 0.6, waves)
    phase = x.double().numpy() @ (direction * frequency[:, None]).T + rng.uniform(0, 2 * np.pi, waves)
    field = np.sin(phase) @ rng.normal(size=(waves, 3)) / np.sqrt(waves / 2)
    return torch.from_numpy(field).float()


FAMILIES = {"displaced": displaced, "unfitting": unfitting}


def run_tangles(cases: int, seed: int = 0, family: str = "displaced", kept: Path | None = None) -> Iterator[dict]:
    """Untangle ``cases`` random tangles of one of ``FAMILIES``; one row each.

    ``kept``: file of rows that were measured already, one a line; new ones are added.
    """
    done = [json.loads(line) for line in kept.read_text().splitlines()] if kept and kept.exists() else []
    yield from done[:cases]
    wardrobe = Wardrobe.load()
    for number in range(len(done), cases):
        row = {"family": family, "case": number}
        row |= measured(FAMILIES[family](wardrobe, np.random.default_rng([seed, number])), wardrobe.body)
        if kept:
            with kept.open("a") as file:
                file.write(json.dumps(row) + "\n")
        yield row


def measured(layers: list[Mesh], body: Mesh) -> dict:
    """One tangle untangled: what was left, what it took, how far and how much longer cloth is."""
    begin, busy = time.perf_counter(), time.process_time()
    done = untangle(layers, body)
    seconds, busy = time.perf_counter() - begin, time.process_time() - busy
    before = np.concatenate([m.vertices.double().numpy() for m in layers])
    moved = np.linalg.norm(np.concatenate(done.vertices) - before, axis=1)
    pairs = len(layers) * (len(layers) - 1) / 2
    return {
        "layers": len(layers),
        "tangled_share": round(tangled_share(layers), 4),
        "pairs_before": done.crossings,
        "pairs_left": len(done.left),
        "inside": done.inside,
        "judged_clean": judged_clean(done.vertices, layers),
        "rounds": done.rounds,
        "seconds": round(seconds, 2),
        "seconds_per_pair": round(seconds / pairs, 2),
        "cpu_seconds_per_pair": round(busy / pairs, 2),
        "strain_pct": round(float(np.mean([edge_strain(m, x) for m, x in zip(layers, done.vertices)])), 3),
        "moved_mean_mm": round(float(moved.mean()) * 1e3, 3),
        "moved_max_mm": round(float(moved.max()) * 1e3, 2),
        "notes": list(done.notes),
    }


def edge_strain(before: Mesh, after: np.ndarray) -> float:
    """Mean change of the lengths of a mesh's edges [%]."""
    f, x = before.faces.numpy(), before.vertices.double().numpy()
    ends = np.unique(np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), 1), axis=0)
    old, new = (np.linalg.norm(v[ends[:, 0]] - v[ends[:, 1]], axis=1) for v in (x, after))
    return 100 * float(np.abs(new / old - 1).mean())


def judged_clean(vertices: list[np.ndarray], layers: list[Mesh]) -> bool | None:
    """What another library (ipctk) says; None where it is not installed."""
    try:
        import ipctk
    except ImportError:
        return None
    starts = np.cumsum([0, *[len(x) for x in vertices]])
    f = np.concatenate([m.faces.numpy() + at for m, at in zip(layers, starts)])
    v = np.concatenate(vertices)
    return not ipctk.has_intersections(ipctk.CollisionMesh(v, ipctk.edges(f), f), v)
