"""Unsigned distance garments in figures: encoding, decoding, holes, distances, gradients (DrapeNet §4.2, §8.3).

    python benchmarks/udf.py            # to docs/results/udf.json and udf.md
    python benchmarks/udf.py --quick    # some minutes; one JSON object last

The paper: encoding about 25 ms, decoding about 2 s at 256³ on a V100, with its network of 512 units.
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

from pipelines.eval_udf import POINTS, evaluate
from recon.files.weights import read_manifest
from recon.garments import load_decoder
from recon.garments.dataset import load_garments, load_items
from recon.garments.mesh_udf import Frame, Meshing, mesh_udf
from recon.garments.panels import border_loops
from recon.garments.sewing import is_manifold
from recon.garments.udf import FAMILIES, UdfDecoder, load_udf
from recon.garments.udf_field import MeshField
from recon.garments.udf_grid import Box
from recon.metrics import boundary_loops, sample_surface

ROOT = Path(__file__).resolve().parent.parent
KINDS = tuple(kind for kinds in FAMILIES.values() for kind in kinds)
STEP = 0.01
"""Finite difference between two codes, as a share of the way from one to the other."""


def seconds(run: Callable[[], object], rounds: int) -> float:
    """Median time of a call; a first, warming one is not counted."""
    run()
    times = []
    for _ in range(rounds):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def exact_holes(resolution: int, per_kind: int) -> dict[str, object]:
    """MeshUDF on exact fields of test garments: how many come out manifold, with the right number of borders."""
    good, failed = 0, []
    for kind in KINDS:
        for number, garment in enumerate(load_garments(kind, "test")[:per_kind]):
            truth = garment.mesh
            mesh = mesh_udf(MeshField(truth), Box.around(truth.vertices), Meshing(resolution))
            faces = mesh.faces.numpy()
            if is_manifold(faces) and len(border_loops(faces)) == boundary_loops(truth.faces):
                good += 1
            else:
                failed.append(f"{kind}:{number}")
    return {"share": round(good / (good + len(failed)), 4), "garments": good + len(failed), "failed": failed}


def decode_times(decoder: UdfDecoder, resolutions: tuple[int, ...], rounds: int) -> dict[str, object]:
    """Seconds per resolution; a dense evaluation of the same box; the sewing patterns' time beside it."""
    code = decoder.codes[0]
    isp = load_decoder(decoder.kind)
    rows: dict[str, object] = {}
    with torch.no_grad():
        for resolution in resolutions:
            own = seconds(lambda r=resolution: decoder.decode(code, r), rounds)
            other = seconds(lambda r=resolution: isp.decode(isp.codes[0], r), rounds)
            rows[str(resolution)] = {
                "udf_s": round(own, 3),
                "dense_s": round(dense_seconds(decoder, resolution), 2),
                "isp_s": round(other, 4),
                "udf_over_isp": round(own / other, 1),
            }
    return rows


def dense_seconds(decoder: UdfDecoder, resolution: int) -> float:
    """Distances and gradients at all corners of the family's box, from a part of them."""
    shape = decoder.nets.shape
    cell = 2 * shape.half / resolution
    count = 1.0
    for low, high in zip(shape.low, shape.high, strict=True):
        count *= (high - low) / cell + 1
    some = torch.rand(32768, 3) * 2 * shape.half + torch.tensor(shape.low)
    field = decoder.field(decoder.codes[0], half=True)
    return seconds(lambda: field.slope(some), 2) * count / len(some)


def gradient_error(decoder: UdfDecoder, resolution: int = 96) -> dict[str, float]:
    """How far the vertices' gradient is from finite differences [%], inside and on borders, along a way to another
    code."""
    z = decoder.codes[0]
    way = decoder.codes[1] - z
    g = decoder.decode(z, resolution)
    for _ in range(2):
        g = decoder.decode_like(z, g)
    step = torch.zeros((), requires_grad=True)
    moved = decoder.decode_like(z + step * way, g).mesh.vertices
    with torch.no_grad():
        ahead, behind = (decoder.decode_like(z + s * STEP * way, g).mesh.vertices for s in (1, -1))
    slope = (ahead - behind) / (2 * STEP)
    rim = torch.zeros(len(slope), 1)
    rim[Frame.of(g.mesh).border] = 1
    errors = {}
    for name, part in (("inside", 1 - rim), ("border", rim)):
        (found,) = torch.autograd.grad((moved * slope * part).sum(), step, retain_graph=True)
        errors[name] = round(100 * abs(float(found / (slope * part).square().sum()) - 1), 2)
    return errors


def without_sides(decoder: UdfDecoder) -> UdfDecoder:
    """The same decoder, meshed by votes, as one whose training found no sides."""
    return UdfDecoder(decoder.nets, decoder.all_codes, decoder.known, decoder.kind)


def encode_ms(decoder: UdfDecoder, rounds: int) -> float:
    """Milliseconds for 10,000 points, neighbourhoods included."""
    mesh = load_garments(decoder.kind, "test")[0].mesh
    points = sample_surface(mesh, POINTS, torch.Generator().manual_seed(0))[0]
    return round(1e3 * seconds(lambda: decoder.encode(points), rounds), 1)


def measure(quick: bool, folder: Path | None = None, each: int = 10) -> dict[str, object]:
    """All figures, on ``each`` garments of each kind; of the networks where weights are there (those that ship or
    ``folder``'s).

    ``udf_decode_s`` and ``hole_free_share`` have one entry per resolution, ``fd_error_pct`` inside and on borders.
    """
    exact = {128: 2} if quick else {128: 20, 256: each}  # all test garments where that is cheap
    holes = {str(r): exact_holes(r, count) for r, count in exact.items()}
    result: dict[str, object] = {
        "hole_free_share": {r: found["share"] for r, found in holes.items()},
        "exact_garments": {r: found["garments"] for r, found in holes.items()},
    }
    known = [name for name in FAMILIES if f"udf-{name}" in read_manifest(folder)]
    decoders = {name: load_udf(FAMILIES[name][0], folder) for name in known}
    if not decoders:
        return result | {"networks": "none trained"}
    first = decoders[known[0]]
    times = decode_times(first, (128,) if quick else (64, 128, 256), 1 if quick else 3)
    result["udf_decode_s"] = {r: row["udf_s"] for r, row in times.items() if isinstance(row, dict)}
    result["decode"] = times
    result["encode_ms"] = encode_ms(first, 3)
    result["fd_error_pct"] = {name: gradient_error(decoder) for name, decoder in decoders.items()}
    result["fd_error_by_votes_pct"] = {
        name: gradient_error(without_sides(decoder)) for name, decoder in decoders.items()
    }
    count, resolution = (2, 128) if quick else (each, 256)
    result["reconstruction"] = {
        name: {
            how: evaluate(decoder, _tests(name, count), resolution, steps)
            for how, steps in (("encoded", 0), ("refined", 60))
        }
        for name, decoder in decoders.items()
    }
    return result


def _tests(family: str, count: int) -> list:
    return [item for kind in FAMILIES[family] for item in load_items(kind, "test")[:count]]


def main() -> None:
    """Measure and write one JSON; the last line printed is the same as one object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--each", type=int, default=10, help="garments of each kind")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--weights", type=Path, help="folder of weights; default: those that ship")
    parser.add_argument("--out", type=Path, help="default: docs/results/udf.json, with udf.md; --quick: none")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    machine = {
        "machine": f"{platform.machine()}, {platform.processor() or platform.system()}",
        "threads": options.threads,
        "torch": torch.__version__,
        "seed": 0,
    }
    result = machine | measure(options.quick, options.weights, options.each)
    result["load"] = round(os.getloadavg()[0], 1)
    out = options.out or (None if options.quick else ROOT / "docs" / "results" / "udf.json")
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=1) + "\n")
        out.with_suffix(".md").write_text(page(result))
    print(json.dumps(result))


def page(figures: dict) -> str:
    """The figures as a page."""
    exact = ", ".join(
        f"{100 * share:.1f} % of {figures['exact_garments'][r]} at {r}"
        for r, share in figures["hole_free_share"].items()
    )
    lines = [
        "# Unsigned distance fields, measured",
        "",
        f"`python benchmarks/udf.py` on {figures['machine']}, {figures['threads']} threads, torch {figures['torch']};",
        f"load of the machine at the end: {figures['load']} (above its cores times are too long).",
        "",
        f"MeshUDF on exact fields of test garments: manifold with the right borders {exact}.",
        "",
    ]
    if "reconstruction" not in figures:
        return "\n".join(lines)
    lines += [
        "Unseen test garments, encoded from 10,000 points of their surface, then the code refined on them (60 steps):",
        "",
        "| family | code | garments | surface mm | p95 mm | normals % | field at the truth mm | right borders % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for family, ways in figures["reconstruction"].items():
        for way, r in ways.items():
            numbers = (
                f"{r['surface_mm']:.2f} | {r['surface_p95_mm']:.1f} | {100 * r['normals']:.1f} | {r['field_mm']:.2f}"
            )
            lines.append(f"| {family} | {way} | {r['garments']} | {numbers} | {100 * r['hole_free_share']:.0f} |")
    lines += ["", "| resolution | decode s | dense s | ISP s | UDF : ISP |", "|---|---|---|---|---|"]
    for resolution, t in figures["decode"].items():
        lines.append(f"| {resolution} | {t['udf_s']} | {t['dense_s']} | {t['isp_s']} | {t['udf_over_isp']} |")
    errors, by_votes = (
        "; ".join(f"{k} {e['inside']} % inside, {e['border']} % on borders" for k, e in figures[key].items())
        for key in ("fd_error_pct", "fd_error_by_votes_pct")
    )
    lines += [
        "",
        f"Encoding 10,000 points: {figures['encode_ms']} ms. Vertices' gradients against finite differences: {errors}.",
        f"The same decoders meshed by votes, as where training finds no sides: {by_votes}.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
