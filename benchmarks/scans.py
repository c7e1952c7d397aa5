"""recon scan on scans of known truth: outfits that no decoder saw on random bodies, with noise and holes.

    python benchmarks/scans.py --cases 20              # to docs/results/scans.json and scans.md: minutes a case
    python benchmarks/scans.py --decoder udf --draper drapenet --weights out/weights --out out/scans-udf
    python benchmarks/scans.py --cases 8 --body        # the body stage alone; prints one JSON object a case

Poses take turns: A, T, standing, and random within the joints' limits; the person faces anywhere. Distances in mm:
``code`` and ``refined`` are vertices of truth and fit to the other's surface (medians; the code's as skinned, before
refinement), ``body`` the true body's skin to the fitted one's, ``body_vertex`` between the same vertices.

Interrupted, the same command goes on: finished cases are kept under out/benchmarks/scans, and so are the finished
stages of the one under way. Other settings, weights or versions have another folder there.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import torch
from made_scans import OUTFITS, POSES, MadeScan, make_scan

import recon
from pipelines.fit_body import to_body
from pipelines.fit_scan_body import ScanBodyFit, fit_scan_body
from pipelines.measure import by_code, geometry
from pipelines.models import load_models
from pipelines.run import Run
from pipelines.scan import ScanFit, fit_labelled
from recon.cloth.contact import BodyContact
from recon.files.atomic import write_whole
from recon.files.state import canonical, digest
from recon.files.weights import read_manifest
from recon.metrics import surface_distance
from recon.types import Mesh

ROOT = Path(__file__).resolve().parent.parent


def to_truth(truth: Mesh, found: Mesh) -> torch.Tensor:
    """(V,) distances of the truth's vertices to the found surface [mm]."""
    return 1e3 * surface_distance(truth.vertices, found)[0]


def body_figures(made: MadeScan, values: dict, body) -> dict:
    """How far the body is from the true one [mm], and by regions."""
    with torch.no_grad():
        found = Mesh(body.pose(to_body(values)).mesh.vertices[0], body.faces)
    away = 1e3 * (found.vertices - made.body_mesh.vertices).norm(dim=1)
    skin = to_truth(Mesh(made.body_mesh.vertices[::4], body.faces), found)
    parts = {name: round(float(away[body.regions == k].mean()), 1) for k, name in enumerate(body.region_names)}
    return {"body": float(skin.median()), "body_vertex": float(away.median()), "regions": parts}


def kept_case(number: int, config: ScanFit, kept: Path) -> dict:
    """A case's figures: read where it is finished, else made."""
    row = kept / f"case-{number:02d}.json"
    if not row.is_file():
        write_whole(row, json.dumps(run_case(number, config, False, kept), indent=1) + "\n")
    return json.loads(row.read_text())


def folder_of(config: ScanFit) -> Path:
    """Where the cases of these settings are kept."""
    drapers = {"isp": "drape-isp-", "drapenet": "drapenet"}
    uses = tuple({f"{config.decoder}-", drapers.get(config.draper, f"{config.decoder}-")})
    used = {name: card for name, card in read_manifest(config.weights).items() if name.startswith(uses)}
    key = digest(canonical(replace(config, out=Path())), canonical(used), recon.__version__)
    return ROOT / "out" / "benchmarks" / "scans" / key[:12]


def run_case(number: int, config: ScanFit, body_only: bool, kept: Path) -> dict:
    """Make and fit one scan; stages are kept in ``kept``, and their seconds count whenever they were spent."""
    outfit, pose = OUTFITS[number % len(OUTFITS)], POSES[number % len(POSES)]
    models = load_models(outfit, config)
    made = make_scan(outfit, number, pose, models.body, models.skinning)
    row: dict = {"case": number, "outfit": "+".join(outfit), "pose": pose}
    if body_only:
        begin = time.perf_counter()
        values = fit_scan_body(made.scan, models.body, ScanBodyFit())
        return row | {"seconds": time.perf_counter() - begin, **body_figures(made, values, models.body)}
    run = Run(kept / f"case-{number:02d}", {"case": number})
    values, layers, meshes = fit_labelled(made.scan, models, config, run)
    row |= {"seconds": sum(run.seconds.values()), **body_figures(made, values, models.body), "garments": {}}
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
        for layer in layers:
            truth, coded = made.garments[layer.name], by_code(layer, posed, models)
            row["garments"][layer.name] = {
                "code": both_ways(truth, coded),
                "refined": both_ways(truth, meshes[layer.name]),
                **geometry(layer, meshes[layer.name], contact),
            }
    return row


def both_ways(truth: Mesh, found: Mesh) -> float:
    """Median distance of either's vertices to the other's surface [mm]."""
    return float(torch.cat([to_truth(truth, found), to_truth(found, truth)]).median())


def page(rows: list[dict]) -> str:
    """The rows as Markdown."""
    load = f"load of the machine at the end {os.getloadavg()[0]:.1f} (above its cores seconds are too long)"
    lines = ["# Scans of known truth", "", f"`python benchmarks/scans.py` on {platform.machine()}, {load};"]
    lines += [f"distances in mm; {len(rows)} scans, the seconds on the clock.", ""]
    told = (__doc__ or "").strip().splitlines()
    lines += told[told.index("") :][5:]
    head = ("case", "pose", "garment", "code", "refined", "inside body", "self-crossings", "body", "body vertex", "s")
    lines += ["", f"| {' | '.join(head)} |"]
    lines += ["|---" * 10 + "|"]
    for r in rows:
        for name, g in r["garments"].items():
            inside = g["penetrating_vertices"] + g["penetrating_faces"]
            cells = f"{g['code']:.1f} | {g['refined']:.1f} | {inside} | {g['self_intersections']}"
            ends = f"{r['body']:.1f} | {r['body_vertex']:.1f} | {r['seconds']:.0f}"
            lines.append(f"| {r['case']} | {r['pose']} | {name} | {cells} | {ends} |")
    found = [g for r in rows for g in r["garments"].values()]
    middle = f"{median(g['code'] for g in found):.1f} | {median(g['refined'] for g in found):.1f}"
    bodies = f"{median(r['body'] for r in rows):.1f} | {median(r['body_vertex'] for r in rows):.1f}"
    lines.append(f"| median | | | {middle} | | | {bodies} | {median(r['seconds'] for r in rows):.0f} |")
    lines += ["", "Aims: code ≤ 12, refined ≤ 4, body ≤ 15, nothing inside the body, 300 s on two cores.", ""]
    return "\n".join(lines)


def main() -> None:
    """Run the cases; the results are written after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--body", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--decoder", default="isp")
    parser.add_argument("--draper", default="skinning")
    parser.add_argument("--weights", type=Path, help="folder of weights; default: those that ship")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    config = ScanFit(scan=Path("made"), decoder=args.decoder, draper=args.draper, weights=args.weights)
    kept, rows = folder_of(config), []
    for number in range(args.first, args.first + args.cases):
        rows.append(run_case(number, config, True, kept) if args.body else kept_case(number, config, kept))
        print(json.dumps(rows[-1]), flush=True)
        if not args.body:
            write_whole(args.out / "scans.json", json.dumps(rows, indent=1) + "\n")
            write_whole(args.out / "scans.md", page(rows))


if __name__ == "__main__":
    main()
