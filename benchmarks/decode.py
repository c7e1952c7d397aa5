"""How long decoding takes: forward, backward, and re-evaluation with fixed topology, per resolution.

Run: ``python benchmarks/decode.py --out decode.json``. States machine, threads and versions; reports median and spread.
ISP reports 25 / 77 / 261 ms for shirts at 128 / 256 / 512 on a V100 (forward, Table 1).
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from recon.garments import COMMON, load_decoder

RESOLUTIONS = (128, 256, 512)


def spread(run: Callable[[int], object], rounds: int) -> dict[str, float]:
    """Median, quartiles and least time [ms] of ``run(round)``; the first, warming call is not counted."""
    run(0)
    times = []
    for k in range(rounds):
        start = time.perf_counter()
        run(k)
        times.append((time.perf_counter() - start) * 1e3)
    low, middle, high = statistics.quantiles(times, n=4)
    return {
        "median_ms": round(middle, 1),
        "q1_ms": round(low, 1),
        "q3_ms": round(high, 1),
        "min_ms": round(min(times), 1),
    }


def measure(kind: str, resolution: int, rounds: int) -> dict[str, object]:
    """All figures of one decoder at one resolution, over its learned codes."""
    decoder = load_decoder(kind)
    codes = decoder.codes[:: max(1, len(decoder.codes) // rounds)]

    def code(k: int, grad: bool) -> torch.Tensor:
        return codes[k % len(codes)].clone().requires_grad_(grad)

    def forward(k: int) -> None:
        with torch.no_grad():
            decoder.decode(code(k, False), resolution)

    def both(k: int) -> None:
        decoder.decode(code(k, True), resolution).mesh.vertices.square().sum().backward()

    fixed = decoder.decode(codes[0], resolution)

    def like(k: int) -> None:
        with torch.no_grad():
            decoder.decode_like(codes[0], fixed)

    def like_both(k: int) -> None:
        z = codes[0].clone().requires_grad_()
        decoder.decode_like(z, fixed).mesh.vertices.square().sum().backward()

    return {
        "kind": kind,
        "resolution": resolution,
        "vertices": len(fixed.mesh.vertices),
        "forward": spread(forward, rounds),
        "forward_and_backward": spread(both, rounds),
        "same_topology_forward": spread(like, rounds),
        "same_topology_forward_and_backward": spread(like_both, rounds),
    }


def main() -> None:
    """Measure all kinds and write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--kinds", nargs="*", default=list(COMMON))
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/decode.json"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    rows = [measure(kind, r, options.rounds) for kind in options.kinds for r in RESOLUTIONS]
    result = {
        "machine": f"{platform.machine()}, {platform.processor() or platform.system()}",
        "threads": options.threads,
        "torch": torch.__version__,
        "rounds": options.rounds,
        "rows": rows,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1))
    for row in rows:
        print(row["kind"], row["resolution"], row["vertices"], row["forward"], row["forward_and_backward"])


if __name__ == "__main__":
    main()
