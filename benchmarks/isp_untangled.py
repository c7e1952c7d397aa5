"""Layered outfits drawn apart: what `recon drape` makes of networks' layers, tested exactly.

    python benchmarks/isp_untangled.py                 # docs/results/isp-untangled.json and .md: half an hour of a core
    python benchmarks/isp_untangled.py --two 4 --five 1

Outfits and bodies are those of isp_layers: garments that no training drew, on bodies of the population; of each outfit
one body in a pose of the held-out clip (where it is at hand) and one in a random one, limbs turned out of the body.
Two layers (the first and a top) and five (the first and four tops of any width, none cut to fit over another).

Interrupted, the same command goes on; ``--anew`` begins from the start, which other code or weights ask for.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from isp_layers import CLIP, FIRST, ROOT, TOPS, seed_of, unseen_bodies, unseen_garments

from recon.bodies import Body, load_body
from recon.cloth.intersections import Crossings
from recon.cloth.stack import Stack
from recon.draping.apart import draw_apart
from recon.draping.isp import IspDraper, load_isp_draper
from recon.draping.layering import Layering, load_layering
from recon.files.atomic import write_whole
from recon.types import BodyPose

RESOLUTION = 80
POSES = ("clip" if CLIP.is_file() else "random", "random")


def cases(two: int, five: int) -> Iterator[tuple[str, int, int, int]]:
    """First layer, outfit, body of the outfit (0, 1) and number of layers."""
    for layers, groups in ((2, two), (5, five)):
        for group in range(groups):
            for kind in FIRST:
                for k in range(len(POSES) if layers == 2 else 1):
                    yield kind, group, k, layers


def row(
    kind: str, group: int, k: int, layers: int, body: Body, draper: IspDraper, layering: Layering
) -> dict[str, object]:
    """One outfit on one body: how it was drawn apart, and what is left."""
    seed = seed_of(kind, group)
    tops = unseen_garments("top", TOPS, RESOLUTION, seed)
    garments = (unseen_garments(kind, 1, RESOLUTION, seed) + tops)[:layers]
    with torch.no_grad():
        place = BodyPose(*(t[k : k + 1] for t in vars(unseen_bodies(2, body, seed)).values()))
        posed = body.pose(place)
        drapes = layering(garments, [draper.drape(g, posed) for g in garments], posed.mesh)
    began = time.perf_counter()
    apart = draw_apart(garments, [m.with_vertices(m.vertices[0]) for m in drapes], body, place, draper.skinning)
    seconds = time.perf_counter() - began
    stack = Stack.of(apart.layers)  # as they are written, and tested anew
    test = Crossings(stack.faces, len(stack.x))
    return {
        "first": kind,
        "outfit": group,
        "layers": [g.variant for g in garments],
        "body": k,
        "pose": POSES[k],
        "pairs_before": apart.before,
        "by": "simulation" if apart.dressed else "untangling",
        "pairs": len(test.pairs(test(stack.x))),
        "inside": apart.done.inside,
        "strain": round(apart.done.strain, 4),
        "seconds": round(seconds, 1),
    }


def share(rows: list[dict], what: str) -> str:
    """In how many rows a number is zero."""
    return f"{sum(not r[what] for r in rows)} of {len(rows)}"


def page(rows: list[dict]) -> str:
    """The rows as Markdown."""
    load = f"load at the end {os.getloadavg()[0]:.1f} (above its cores seconds are too long)"
    lines = [
        "# Layered outfits drawn apart",
        "",
        f"`python benchmarks/isp_untangled.py` on {platform.machine()}, {load}.",
    ]
    told = (__doc__ or "").strip().splitlines()
    lines += ["", *told[told.index("") :][4:7], ""]
    lines += [
        "*pairs*: of faces that pass through each other or themselves, all layers together, tested exactly; *inside*:"
    ]
    lines += [
        "vertices and face centres in the body, creases of elbows and knees opened; *by*: untangling of the networks'"
    ]
    lines += [
        "drapes, or simulation from the T pose where that failed; *strain*: mean change of the edges by untangling.",
        "",
    ]
    for count in sorted({len(r["layers"]) for r in rows}):
        mine = [r for r in rows if len(r["layers"]) == count]
        lines += [f"**{count} layers: nothing crosses in {share(mine, 'pairs')}, nothing is in the body in "
                  f"{share(mine, 'inside')}.**", ""]  # fmt: skip
    lines += ["| layers, innermost first | pose | pairs before | by | pairs | inside | strain | s |", "|---" * 8 + "|"]
    for r in rows:
        cells = (", ".join(r["layers"]), r["pose"], r["pairs_before"], r["by"], r["pairs"], r["inside"])
        lines.append(f"| {' | '.join(map(str, cells))} | {r['strain']:.4f} | {r['seconds']:.0f} |")
    return "\n".join([*lines, "", "Aim: nothing crosses in 99 %.", ""])


def main() -> None:
    """Run what is missing; the results are written after each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--two", type=int, default=8, help="outfits of each first layer, two bodies each")
    parser.add_argument("--five", type=int, default=3, help="of which so many with all five layers, on one body")
    parser.add_argument("--anew", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "isp-untangled.json")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows = [] if args.anew or not args.out.is_file() else json.loads(args.out.read_text())
    body = load_body()
    draper, layering = load_isp_draper(body), load_layering()
    done = {(r["first"], r["outfit"], r["body"], len(r["layers"])) for r in rows}
    for case in cases(args.two, args.five):
        if case in done:
            continue
        rows.append(row(*case, body, draper, layering))
        print(json.dumps(rows[-1]), flush=True)
        write_whole(args.out, json.dumps(rows, indent=1) + "\n")
        write_whole(args.out.with_suffix(".md"), page(rows))


if __name__ == "__main__":
    main()
