"""ISP's tables on our own garments: decoding, fitting unseen garments, interpolation, Eq. 6, layering.

    python benchmarks/isp.py                     # to docs/results/isp.json and isp.md; goes on where it stopped
    python benchmarks/isp.py --quick             # within a minute on 2 cores; one JSON object last

Unseen garments are the test split of ``examples/garments``; codes are found from their flat pattern, mesh, 300 points
or frontal silhouette. ``floor_mm``: the data's own error, the same pattern draped again, cut into triangles 2 % larger.
Distances are exact, point to surface, both ways averaged; ``chd`` is the paper's form, which has a floor of its own.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import torch
from isp_measures import (
    KINDS,
    RESOLUTIONS,
    SOURCES,
    code_of,
    decode_ms,
    figures,
    fits,
    floor,
    gradient_error,
    interpolations,
    room,
    seen,
)

from pipelines.fit_code import CodeFit
from recon.files.atomic import write_whole
from recon.garments.dataset import load_items
from recon.garments.isp import load_isp
from recon.garments.patterns_drape import FittingRoom
from recon.types import UserError

ROOT = Path(__file__).resolve().parent.parent


def quick() -> dict:
    """One unseen garment of each kind, from its pattern; the keys of the full run."""
    search = CodeFit(starts=1, rounds=3, steps=12)
    where = room()
    row: dict = {"surface_mm": {}, "floor_mm": {}, "normal_consistency_pct": {}, "openings_kept": {}}
    for kind in KINDS:
        decoder, item = load_isp(kind), load_items(kind, "test")[0]
        found = figures(decoder, code_of(decoder, item.garment, "pattern", None, search), item.garment)
        row["surface_mm"][kind] = round(found["surface_mm"], 3)
        row["floor_mm"][kind] = round(floor(item, where)["surface_mm"], 3)
        row["normal_consistency_pct"][kind] = round(100 * found["normals"], 2)
        row["openings_kept"][kind] = found["openings"]
    row["decode_ms"] = {str(r): decode_ms("trousers", r, 3) for r in RESOLUTIONS}
    row["fd_error_pct"] = max(gradient_error("top", 1).values())
    return row | layered(True)


def layered(short: bool) -> dict:
    """``drape_ms`` and ``layer_intersection_pct``; nothing where the networks' weights are not there."""
    from isp_layers import measure

    try:
        found = measure(short)
    except UserError:
        return {}
    return {key: found[key] for key in ("drape_ms", "layer_intersection_pct")}


class Kept:
    """Rows on disk, so that a killed run goes on."""

    def __init__(self, path: Path):
        self.path = path
        self.rows: dict[str, list[dict]] = json.loads(path.read_text()) if path.is_file() else {}

    def get(self, name: str, make: Callable[[], Iterable[dict]]) -> list[dict]:
        """The rows of one table, measured where they are not there yet."""
        if name not in self.rows:
            self.rows[name] = list(make())
            write_whole(self.path, json.dumps(self.rows, indent=1))
            print(name, flush=True)
        return self.rows[name]


def alone(measure: Callable[..., dict], *arguments) -> list[dict]:
    """A table of one row."""
    return [measure(*arguments)]


def times(kind: str) -> dict[str, float]:
    """Decoding times by resolution [ms]."""
    return {str(r): decode_ms(kind, r, 9) for r in RESOLUTIONS}


def floors(kind: str, count: int, where: FittingRoom) -> Iterable[dict]:
    """The data's own error for each of the unseen garments."""
    return (floor(item, where) for item in load_items(kind, "test")[:count])


def full(options: argparse.Namespace) -> dict[str, list[dict]]:
    """All tables, row by row; the long ones last."""
    kept, where = Kept(options.rows), None
    for kind in KINDS:
        kept.get(f"gradient {kind}", partial(alone, gradient_error, kind))
        kept.get(f"time {kind}", partial(alone, times, kind))
        kept.get(f"interpolation {kind}", partial(alone, interpolations, kind, options.pairs))
        kept.get(f"pattern {kind}", partial(fits, kind, "pattern", options.unseen, CodeFit()))
        kept.get(f"seen {kind}", partial(seen, kind, options.seen))
    for kind in KINDS:
        if f"floor {kind}" not in kept.rows:
            where = where or room()
            kept.get(f"floor {kind}", partial(floors, kind, options.unseen, where))
    for source in SOURCES[1:]:
        for kind in KINDS:
            kept.get(f"{source} {kind}", partial(fits, kind, source, options.others, CodeFit()))
    return kept.rows


def mean(rows: list[dict], key: str) -> float:
    """Of one figure over rows."""
    return statistics.mean(row[key] for row in rows)


def summary(rows: dict[str, list[dict]]) -> dict:
    """The keys of ``--quick`` over all rows."""
    out: dict = {"surface_mm": {}, "floor_mm": {}, "normal_consistency_pct": {}, "openings_kept": {}}
    for kind in KINDS:
        found = rows.get(f"pattern {kind}")
        if not found:
            continue
        out["surface_mm"][kind] = round(mean(found, "surface_mm"), 3)
        out["normal_consistency_pct"][kind] = round(100 * mean(found, "normals"), 2)
        out["openings_kept"][kind] = mean(found, "openings")
        if f"floor {kind}" in rows:
            out["floor_mm"][kind] = round(mean(rows[f"floor {kind}"], "surface_mm"), 3)
    timed = [rows[f"time {kind}"][0] for kind in KINDS if f"time {kind}" in rows]
    out["decode_ms"] = {str(r): round(statistics.median(t[str(r)] for t in timed), 1) for r in RESOLUTIONS if timed}
    errors = [rows[f"gradient {kind}"][0] for kind in KINDS if f"gradient {kind}" in rows]
    out["fd_error_pct"] = max((max(e["inside"], e["border"]) for e in errors), default=None)
    return out


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def resolutions_table(rows: dict[str, list[dict]], group: str) -> str:
    """Tables 1-3: learned or unseen garments at each resolution."""
    lines = []
    for kind in KINDS:
        for r in RESOLUTIONS if f"{group} {kind}" in rows else ():
            at = [row[str(r)] for row in rows[f"{group} {kind}"]]
            line = [kind, str(r), str(len(at)), f"{1e4 * mean(at, 'chd'):.2f}", f"{1e4 * mean(at, 'chd_surface'):.2f}"]
            line += [f"{mean(at, 'surface_mm'):.2f}", f"{100 * mean(at, 'normals'):.2f}"]
            timed = rows.get(f"time {kind}")
            lines.append([*line, f"{timed[0][str(r)]:.0f}" if timed else ""])
    head = ["kind", "grid", "garments", "CHD (1e-4)", "CHD to surface", "mm", "NC %", "ms"]
    return table(head, lines)


def sources_table(rows: dict[str, list[dict]]) -> str:
    """Unseen garments at 256, by what their code was found from."""
    lines = []
    for kind in KINDS:
        again = rows.get(f"floor {kind}")
        for source in SOURCES:
            found = rows.get(f"{source} {kind}")
            if not found:
                continue
            line = [kind, source, str(len(found)), f"{mean(found, 'surface_mm'):.2f}"]
            line += [f"{mean(again, 'surface_mm'):.2f}" if again else "", f"{100 * mean(found, 'normals'):.1f}"]
            line += [f"{100 * mean(again, 'normals'):.1f}" if again else ""]
            line += [f"{100 * mean(found, 'panel_iou'):.2f}", f"{100 * mean(found, 'labels'):.1f}"]
            line += [f"{mean(found, 'seam_gap_mm'):.2f}", f"{100 * mean(found, 'openings'):.0f}"]
            lines.append([*line, f"{statistics.median(row['seconds'] for row in found):.0f}"])
    head = [
        "kind",
        "code from",
        "garments",
        "mm",
        "floor mm",
        "NC %",
        "floor NC %",
        "panel IoU %",
        "labels %",
        "gap mm",
        "openings %",
        "s",
    ]
    return table(head, lines)


def others_table(rows: dict[str, list[dict]]) -> str:
    """Interpolation and Eq. 6."""
    lines = []
    for kind in KINDS:
        way, error = rows.get(f"interpolation {kind}"), rows.get(f"gradient {kind}")
        if way and error:
            w, e = way[0], error[0]
            lines.append([kind, *(str(w[k]) for k in ("pairs", "manifold", "right", "changing", "right_changing"))])
            lines[-1] += [f"{e['inside']:.2f}", f"{e['border']:.2f}"]
    head = ["kind", "pairs", "manifold", "right borders", "ends differ", "of these right", "Eq. 6 inside %", "border %"]
    return table(head, lines)


def report(rows: dict[str, list[dict]], note: str, folder: Path) -> None:
    """Write isp.json and isp.md."""
    machine = f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    whole = {"machine": machine, "note": note, "summary": summary(rows), "rows": rows}
    write_whole(folder / "isp.json", json.dumps(whole, indent=1) + "\n")
    text = (ROOT / "benchmarks" / "isp.md.in").read_text()
    for name, made in (
        ("MACHINE", f"{machine}. {note}".strip()),
        ("SOURCES", sources_table(rows)),
        ("UNSEEN", resolutions_table(rows, "pattern")),
        ("SEEN", resolutions_table(rows, "seen")),
        ("OTHERS", others_table(rows)),
    ):
        text = text.replace(f"@{name}@", made)
    write_whole(folder / "isp.md", text)


def main() -> None:
    """Measure and write, or print the quick figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--report", action="store_true", help="only write the report of the rows that are there")
    parser.add_argument("--unseen", type=int, default=20, help="unseen garments a kind, from their pattern")
    parser.add_argument("--others", type=int, default=6, help="the same from mesh, points and silhouette")
    parser.add_argument("--seen", type=int, default=10, help="learned garments a kind")
    parser.add_argument("--pairs", type=int, default=100, help="interpolations a kind")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--note", default="", help="what a reader must know about this run")
    parser.add_argument("--rows", type=Path, default=Path("out/benchmarks/isp-rows.json"))
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.quick:
        print(json.dumps(quick()))
        return
    rows = Kept(options.rows).rows if options.report else full(options)
    report(rows, options.note, options.out)


if __name__ == "__main__":
    main()
