"""What L_normal and L_consist are worth (ISP Table 4, Figs. 17-18): the same short training without each.

    python benchmarks/isp_ablation.py --steps 400 --garments 16      # to docs/results/isp-ablation.json and .md

Each training starts from the same seed and takes as many steps on the same garments; figures are of the first of these,
decoded from their own learned codes: what a loss term is worth for fitting, not for unseen garments.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from statistics import mean

import torch

from pipelines.eval_isp import seam_gap
from pipelines.train_isp import TrainIsp, learn
from recon.files.atomic import write_whole
from recon.garments.dataset import load_items
from recon.garments.sewing import is_manifold
from recon.metrics import areas_and_middles, compare_meshes, largest_stretch, surface_distance
from recon.types import Garment

ROOT = Path(__file__).resolve().parent.parent
RUNS = {"both terms": {}, "without L_normal": {"normal": 0.0}, "without L_consist": {"consist": 0.0}}
FIGURES = {
    "chd": ("CHD (1e-4)", 1e4),
    "surface_mm": ("mm", 1.0),
    "normals": ("NC %", 100.0),
    "turned": ("faces turned over %", 100.0),
    "gap_mm": ("seam gap mm", 1.0),
    "stretch_p95": ("stretch p95", 1.0),
}
"""Key of a row -> head of its column and factor."""


def measure(found: Garment, truth: Garment, gap_mm: float) -> dict[str, float]:
    """Figures of one decoded garment."""
    row = compare_meshes(found.mesh, truth.mesh, torch.Generator().manual_seed(0), 5000)
    assert is_manifold(found.mesh.faces.numpy())
    return {
        **{k: row[k] for k in ("chd", "surface_mm", "normals")},
        "turned": turned_over(found, truth),
        "gap_mm": gap_mm,
        "stretch_p95": float(largest_stretch(found).quantile(0.95)),
    }


def turned_over(found: Garment, truth: Garment) -> float:
    """Share of the area whose faces look the other way than the truth's closest ones (Fig. 17's inverted faces)."""
    area, middle, normal = areas_and_middles(found.mesh)
    other = areas_and_middles(truth.mesh)[2][surface_distance(middle, truth.mesh)[1]]
    return float(area[(normal * other).sum(1) < 0].sum() / area.sum())


def trained(name: str, options: argparse.Namespace) -> dict:
    """Train without a term and measure."""
    items = load_items(options.kind, "train")[: options.garments]
    config = TrainIsp(
        options.kind,
        out=options.work / name.replace(" ", "-"),
        steps=options.steps,
        threads=options.threads,
        **RUNS[name],
    )
    decoder, done = learn([item.garment for item in items], config)
    rows = []
    with torch.no_grad():
        for code, item in list(zip(decoder.codes, items, strict=True))[: options.measured]:
            garment = decoder.decode(code, 128)
            rows.append(measure(garment, item.garment, 1e3 * float(seam_gap(decoder, garment).mean())))
    return {"seconds": round(done.seconds), **{k: round(mean(row[k] for row in rows), 6) for k in FIGURES}}


def page(found: dict) -> str:
    """docs/results/isp-ablation.md."""
    head = ["training", *(title for title, _ in FIGURES.values())]
    lines = [head, ["---"] * len(head)]
    for name, row in found["rows"].items():
        lines.append([name, *(f"{factor * row[key]:.2f}" for key, (_, factor) in FIGURES.items())])
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"""# Implicit sewing patterns: what the loss terms are worth

`python benchmarks/isp_ablation.py` on {found["machine"]}, torch {torch.__version__}.

ISP's Table 4 at a small scale, a short budget: {found["steps"]} steps each (the shipped networks learned for thousands)
on {found["garments"]} garments of kind {found["kind"]}, same seed; figures of {found["measured"]} of them from their
learned codes, at 128. L_normal: normals, and differences along the surface. L_consist: seams, and their gaps. *Seam
gap*: before the two sides are welded.

{table}
"""


def main() -> None:
    """Train what is not there yet; write JSON and page."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", default="skirt")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--garments", type=int, default=16)
    parser.add_argument("--measured", type=int, default=6)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "ablation")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    options = parser.parse_args()
    store = options.out / "isp-ablation.json"
    about = {k: getattr(options, k) for k in ("kind", "steps", "garments", "measured")}
    found = json.loads(store.read_text()) if store.exists() else {}
    if {k: found.get(k) for k in about} != about:
        found = {**about, "rows": {}}
    found["machine"] = f"{platform.machine()}, {options.threads} threads"
    for name in RUNS:
        if name not in found["rows"]:
            found["rows"][name] = trained(name, options)
            print(name, found["rows"][name], flush=True)
        write_whole(store, json.dumps(found, indent=1) + "\n")
        write_whole(store.with_suffix(".md"), page(found))


if __name__ == "__main__":
    main()
