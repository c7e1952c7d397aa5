"""The photo pipeline measured: the bundled photos, photos beside the repository, and outfits of known truth.

    python benchmarks/photo.py                 # everything; to docs/results/photo.json and photo.md
    python benchmarks/photo.py --only demo     # one job; names are those of JOBS, or 'truth'

Each photo runs as a user would run it (``recon photo`` in a process of its own), so that its peak memory and time are
its own. Outfits of known truth are test garments that no decoder has seen, graded to unseen bodies, carried into
unseen poses by simulation and rendered to masks; landmarks are the body's own points with 1 % noise in the picture
and none in space, and weigh as such (``TRUSTED``). Perception is not part of those.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("GARMENT_RECON_SHARED", ROOT.parent / "shared"))


@dataclass(frozen=True)
class Job:
    """One photo and what the person wears."""

    photo: Path
    garments: str


BUNDLED = ROOT / "examples" / "photos"
JOBS = {
    "demo": Job(BUNDLED / "man-hoodie-trousers.jpg", "top,trousers"),
    "open-jacket": Job(BUNDLED / "woman-open-jacket-jeans.jpg", "jacket,top,trousers"),
    "sweater": Job(BUNDLED / "man-sweater-jeans.jpg", "top,trousers"),
    "blazer": Job(BUNDLED / "woman-open-blazer-trousers.jpg", "jacket,top,trousers"),
    "shorts": Job(BUNDLED / "man-tshirt-shorts-small.png", "tshirt,shorts"),
    "ryota": Job(SHARED / "photos" / "pifu_ryota.png", "top,trousers"),
    "dress": Job(SHARED / "photos" / "human_ai-body.jpg", "dress"),
    "skirt": Job(SHARED / "photos" / "human_person-linda.jpg", "top,skirt"),
    "suit": Job(SHARED / "photos" / "human_person-vlado1.jpg", "jacket,trousers"),
}


def run_photo(name: str, job: Job, out: Path) -> dict:
    """Run ``recon photo`` afresh; its figures, wall seconds and peak memory, or the line it ended with."""
    folder = out / name
    shutil.rmtree(folder, ignore_errors=True)
    command = [
        sys.executable,
        "-m",
        "pipelines.cli",
        "photo",
        str(job.photo),
        "--garments",
        job.garments,
        "--out",
        str(folder),
    ]
    begin = time.perf_counter()
    with tempfile.TemporaryFile("w+") as log:
        child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=log)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        log.seek(0)
        said = log.read()
    row = {"photo": job.photo.name, "wanted": job.garments, "wall_seconds": round(time.perf_counter() - begin, 1)}
    row["peak_memory_gb"] = round(usage.ru_maxrss / 2**20, 2)
    if child.returncode:
        return {**row, "error": said.strip().splitlines()[-1] if said.strip() else f"exit code {child.returncode}"}
    figures = json.loads((folder / "result.json").read_text())
    return {**row, **{k: figures[k] for k in ("garments", "body", "seconds", "confidence", "notes")}}


def keep_picture(name: str, out: Path) -> None:
    """One picture of a result, overlay and turntable side by side, in docs/results."""
    parts = [cv2.imread(str(out / name / f)) for f in ("overlay.png", "turntable.png")]
    if any(part is None for part in parts):
        return
    same = [cv2.resize(p, (round(p.shape[1] * 420 / p.shape[0]), 420), interpolation=cv2.INTER_AREA) for p in parts]
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85]
    cv2.imwrite(str(ROOT / "docs" / "results" / f"photo-{name}.jpg"), cv2.hconcat(same), quality)


def table(rows: dict[str, dict]) -> list[str]:
    """Markdown rows, one per garment."""
    head = (
        "| photo | garment | IoU | IoU, code only | inside body (v/f) | self-intersections | stretch p95 | total s "
        "| peak GB |"
    )
    lines = [head, "|" + "---|" * 9]
    for name, row in rows.items():
        if "error" in row:
            lines.append(
                f"| {name} | {row['wanted']} | {row['error']} | | | | "
                f"| {row['wall_seconds']} | {row['peak_memory_gb']} |"
            )
            continue
        for garment, g in row["garments"].items():
            inside = f"{g['penetrating_vertices']}/{g['penetrating_faces']}"
            lines.append(
                f"| {name} | {garment} | {g['iou']:.3f} | {g['iou_code_only']:.3f} | {inside} "
                f"| {g['self_intersections']} | {g['stretch_p95']:.3f} "
                f"| {row['seconds']['total']:.0f} | {row['peak_memory_gb']} |"
            )
    return lines


def write_page(found: dict) -> None:
    """docs/results/photo.md from the JSON."""
    lines = [
        "# The photo pipeline, measured",
        "",
        f"`python benchmarks/photo.py` on {found['machine']}, {found['cores']} cores.",
        "",
    ]
    lines += [
        "IoU counts pixels outside hair, hands and things held in front, against the mask that perception found.",
        "",
    ]
    lines += table(found["photos"])
    for name in found["photos"]:
        if (ROOT / "docs" / "results" / f"photo-{name}.jpg").exists():
            lines += ["", f"## {name}", "", f"![{name}](photo-{name}.jpg)"]
    if "truth" in found:
        lines += [
            "",
            "## Outfits of known truth",
            "",
            "Unseen test garments, simulated on unseen bodies and poses, fitted from their masks and landmarks with",
            "1 % noise in the photo and in space; surface distances both ways, the pelvis moved onto the true one.",
            "",
            "| kind | cases | IoU, median | Chamfer to truth, median mm |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {k} | {v['cases']} | {v['iou']:.3f} | {v['chamfer_mm']:.1f} |"
            for k, v in found["truth"]["kinds"].items()
        ]
    (ROOT / "docs" / "results" / "photo.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Run the jobs and write JSON, tables and pictures."""
    import platform

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[*JOBS, "truth"])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "benchmark")
    parser.add_argument("--cases", type=int, default=10, help="outfits of known truth")
    args = parser.parse_args()
    about = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "date": time.strftime("%Y-%m-%d"),
    }
    for name in args.only:
        if name == "truth":
            from truth import run_truth

            for figures in run_truth(args.cases, args.out):
                keep(about | {"truth": figures})
        elif not JOBS[name].photo.exists():
            print(f"{name}: {JOBS[name].photo.name} is not here, skipped")
            continue
        else:
            new = {"photos": {name: run_photo(name, JOBS[name], args.out)}}
            keep_picture(name, args.out)
            print(json.dumps(new))
            keep(about | new)


def keep(new: dict) -> None:
    """Add to docs/results/photo.json, whatever else was measured meanwhile, and write the page."""
    store = ROOT / "docs" / "results" / "photo.json"
    found = json.loads(store.read_text()) if store.exists() else {}
    photos = found.get("photos", {}) | new.get("photos", {})
    found = found | new | {"photos": {name: photos[name] for name in JOBS if name in photos}}
    store.write_text(json.dumps(found, indent=1) + "\n")
    write_page(found)


if __name__ == "__main__":
    main()
