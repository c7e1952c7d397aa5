"""Random tangles of draped garments for ``benchmarks/gaps.py``: two to five layers, up to a tenth of the area."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

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


def random_tangle(wardrobe: Wardrobe, rng: np.random.Generator) -> list[Mesh]:
    """Layers put over each other without knowing of each other; puffed out until at most ``MOST`` is tangled."""
    count = int(rng.integers(2, 6))
    names = sorted(rng.choice(ORDER, count, replace=False), key=ORDER.index)
    worn = [wardrobe.garments[name][rng.integers(len(wardrobe.garments[name]))].mesh for name in names]
    for step in range(12):
        layers = [puffed(m, 0.0015 * step * (count - 1 - k)) for k, m in enumerate(worn)]
        if tangled_share(layers) <= MOST:
            break
    return layers


def run_tangles(cases: int, seed: int = 0) -> Iterator[dict]:
    """Untangle ``cases`` random tangles; one row each."""
    wardrobe, rng = Wardrobe.load(), np.random.default_rng(seed)
    for number in range(cases):
        layers = random_tangle(wardrobe, rng)
        share = tangled_share(layers)
        begin = time.perf_counter()
        done = untangle(layers, wardrobe.body)
        seconds = time.perf_counter() - begin
        moved = [
            np.linalg.norm(x - m.vertices.double().numpy(), axis=1) for x, m in zip(done.vertices, layers, strict=True)
        ]
        pairs = len(layers) * (len(layers) - 1) / 2
        yield {
            "case": number,
            "layers": len(layers),
            "tangled_share": round(share, 4),
            "pairs_before": done.crossings,
            "pairs_left": len(done.left),
            "inside": done.inside,
            "rounds": done.rounds,
            "seconds": round(seconds, 2),
            "seconds_per_pair": round(seconds / pairs, 2),
            "moved_mean_mm": round(float(np.concatenate(moved).mean()) * 1e3, 3),
            "moved_max_mm": round(float(np.concatenate(moved).max()) * 1e3, 2),
        }
