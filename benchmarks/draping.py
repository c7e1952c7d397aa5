"""Draping by skinning measured: time of binding and draping, agreement of the lattice, stretch between the legs.

    python benchmarks/draping.py                    # JSON to docs/results/draping.json and to the screen
    python benchmarks/draping.py --threads 2 --rounds 30

The garment is a made tube of 5,000 vertices about the hips and legs of the embedded body, a skirt to mid-calf; the pose
a long step (hips -0.5 and 0.4 rad). Times as in ``body.py``: wall and processor milliseconds.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from recon.bodies import Body, load_body
from recon.draping.binding import METHODS
from recon.draping.skinning import SkinningDraper
from recon.types import BodyPose, Mesh

ROOT = Path(__file__).resolve().parent.parent


def tube(around: int = 100, along: int = 50) -> Mesh:
    """An open tube about hips and legs, 0.35 m to 1.0 m above the ground."""
    angle = torch.arange(around) * (2 * torch.pi / around)
    a, y = torch.meshgrid(angle, torch.linspace(0.35, 1.0, along), indexing="ij")
    vertices = torch.stack([0.25 * a.cos(), y, 0.18 * a.sin() + 0.01], -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(around), torch.arange(along - 1), indexing="ij")
    p, q = (i * along + j).reshape(-1), ((i + 1) % around * along + j).reshape(-1)
    return Mesh(vertices, torch.cat([torch.stack([p, p + 1, q], 1), torch.stack([q, p + 1, q + 1], 1)]))


def stepping(body: Body, count: int) -> BodyPose:
    """``count`` bodies of different shapes in a long step."""
    place = body.neutral(count)
    pose = place.pose.clone()
    pose[:, 1, 0], pose[:, 2, 0] = -0.5, 0.4
    shape = torch.randn(count, body.n_shape, generator=torch.Generator().manual_seed(0))
    shape[0] = 0
    return BodyPose(shape, pose, place.translation)


def measured(rounds: int, work: Callable[[], object]) -> dict[str, float]:
    """Milliseconds of ``work()``, three rounds of warming up apart."""
    wall, processor = [], []
    for i in range(rounds + 3):
        start, spent = time.perf_counter(), time.process_time()
        work()
        if i >= 3:
            wall.append(1e3 * (time.perf_counter() - start))
            processor.append(1e3 * (time.process_time() - spent))
    return {
        "wall_ms": round(statistics.median(wall), 2),
        "best_ms": round(min(wall), 2),
        "processor_ms": round(statistics.median(processor), 2),
    }


def stretches(rest: Mesh, draped: Tensor) -> dict[str, float]:
    """Length of edges after draping, relative to rest."""
    edges = torch.cat([rest.faces[:, [0, 1]], rest.faces[:, [1, 2]], rest.faces[:, [2, 0]]])
    a, b = edges.unbind(1)
    ratio = (draped[a] - draped[b]).norm(dim=1) / (rest.vertices[a] - rest.vertices[b]).norm(dim=1)
    return {"p95": round(float(ratio.quantile(0.95)), 3), "max": round(float(ratio.max()), 3)}


def measure(rounds: int) -> dict:
    """All figures."""
    body, skirt = load_body(), tube()
    start = time.process_time()
    quick = SkinningDraper(body)
    quick.bind(skirt.vertices[:1])
    sampled = time.process_time() - start
    one, many = body.pose(stepping(body, 1)), body.pose(stepping(body, 16))
    methods = {name: SkinningDraper(body, name, lattice=False) for name in METHODS}
    draped = {name: draper.drape_vertices(skirt, one)[0] for name, draper in methods.items()}
    apart = 1e3 * (quick.drape_vertices(skirt, one)[0] - draped["rbf"]).norm(dim=1)
    return {
        "vertices": len(skirt.vertices),
        "lattice_sampling_s_processor": round(sampled, 2),
        "lattice_read_without_settling": measured(rounds, lambda: quick.bind(skirt.vertices)),
        "lattice_bind": measured(rounds, lambda: quick.bind(skirt.vertices, skirt.faces)),
        "exact_bind": measured(rounds, lambda: methods["rbf"].bind(skirt.vertices, skirt.faces)),
        "drape_16_bodies_lattice": measured(rounds, lambda: quick.drape_vertices(skirt, many)),
        "lattice_against_exact_mm": {"mean": round(float(apart.mean()), 2), "max": round(float(apart.max()), 2)},
        "edge_stretch": {name: stretches(skirt, x) for name, x in draped.items()},
    }


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=0, help="torch's threads; 0 = as they come")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "draping.json")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    found = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}",
        "threads": torch.get_num_threads(),
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
        "rounds": options.rounds,
        **measure(options.rounds),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
