"""The body model measured: posing 1 and 16 bodies of random shape and pose, forward and with gradients.

    python benchmarks/body.py                       # the embedded body; JSON to docs/results/body.json and the screen
    python benchmarks/body.py --threads 2 --rounds 50
    python benchmarks/body.py --body smpl --path FILE

Milliseconds of wall time (median, quartiles, best) and of processor time over all threads (median), which says more on
a machine that has other work. Backward is of a weighted sum of all vertices, to shape, pose and translation.
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

from recon.bodies import Body, load_body
from recon.bodies.pose_prior import pose_prior, sample_poses
from recon.types import BodyPose

ROOT = Path(__file__).resolve().parent.parent
BATCHES = (1, 16)
TARGET_MS = {1: 15.0, 16: 60.0}
"""Forward on two cores."""


def measured(rounds: int, work: Callable[[], object]) -> dict[str, object]:
    """Milliseconds of ``work()``, five rounds of warming up apart."""
    wall, processor = [], []
    for i in range(rounds + 5):
        start, spent = time.perf_counter(), time.process_time()
        work()
        if i >= 5:
            wall.append(1e3 * (time.perf_counter() - start))
            processor.append(1e3 * (time.process_time() - spent))
    low, middle, high = statistics.quantiles(wall, n=4)
    return {
        "wall_ms": round(middle, 2),
        "quartiles_ms": [round(low, 2), round(high, 2)],
        "best_ms": round(min(wall), 2),
        "processor_ms": round(statistics.median(processor), 2),
    }


def random_bodies(body: Body, count: int, generator: torch.Generator) -> BodyPose:
    """Bodies of random shape, pose and place that ask for gradients."""
    shape = torch.randn(count, body.n_shape, generator=generator)
    pose = sample_poses(count, generator)
    place = torch.randn(count, 3, generator=generator)
    return BodyPose(*(v.requires_grad_() for v in (shape, pose, place)))


def at_batch(body: Body, count: int, rounds: int) -> dict:
    """Times for ``count`` bodies at once."""
    generator = torch.Generator().manual_seed(count)
    bodies = random_bodies(body, count, generator)
    wanted = (bodies.shape, bodies.pose, bodies.translation)
    weight = torch.randn(count, len(body.weights), 3, generator=generator)

    def forward() -> None:
        with torch.no_grad():
            body.pose(bodies)

    def both() -> None:
        torch.autograd.grad((body.pose(bodies).mesh.vertices * weight).sum(), wanted)

    def fitting() -> None:
        loss = body.landmarks(body.pose(bodies)).square().sum() + pose_prior(bodies.pose).sum()
        torch.autograd.grad(loss, wanted)

    found: dict[str, object] = {
        "forward": measured(rounds, forward),
        "forward_backward": measured(rounds, both),
        "landmarks_and_prior_forward_backward": measured(rounds, fitting),
    }
    target = TARGET_MS.get(count)
    if target is not None:
        found["forward_target_ms"] = target
    return found


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--body", default="anny")
    parser.add_argument("--path", type=Path, help="the user's own SMPL, SMPL-H or SMPL-X file")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--threads", type=int, default=0, help="torch's threads; 0 = as they come")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "body.json")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    start = time.perf_counter()
    body = load_body(options.body, options.path)
    loaded = time.perf_counter() - start
    found = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}",
        "threads": torch.get_num_threads(),
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
        "rounds": options.rounds,
        "body": options.body,
        "vertices": len(body.weights),
        "shape_coefficients": body.n_shape,
        "height_m": round(float(body.rest(body.neutral().shape).vertices[0, :, 1].max()), 4),
        "load_s": round(loaded, 3),
        "card": getattr(body, "card", {}),
        "batches": {str(count): at_batch(body, count, options.rounds) for count in BATCHES},
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
