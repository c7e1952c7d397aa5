"""DrapeNet's Fig. 13 at a small scale: distance fields learned with each distance loss, with and without gradients.

    python benchmarks/udf_losses.py      # to docs/results/udf-losses.json, .md and images/udf-losses.png

Six short trainings of equal steps on few garments: they rank the losses early in training, no more. Interrupted, the
same command goes on.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from statistics import mean

import cv2
import numpy as np
import torch

from pipelines.train_udf import TrainUdf, learn
from pipelines.udf_samples import Sampling
from recon.files.atomic import write_whole
from recon.files.meshes import read_mesh, write_obj
from recon.garments.dataset import Item, load_items
from recon.garments.sewing import is_manifold
from recon.garments.udf import FAMILIES, UdfDecoder
from recon.metrics import boundary_loops, compare_meshes, sample_surface
from recon.render.shade import Look, orbit_camera, picture
from recon.types import UserError

ROOT = Path(__file__).resolve().parent.parent
RUNS: dict[str, dict] = {
    f"{loss}{' + gradient' if weight else ''}": {"loss": loss, "gradient": weight}
    for loss in ("bce", "l1", "l2")
    for weight in (0.1, 0.0)
}
HEADS = {
    "field_mm": "field at the truth mm",
    "slope_deg": "its direction 1 cm off, degrees",
    "surface_mm": "surface mm",
    "normals": "normals",
    "whole": "right borders",
}


def direction_error(decoder: UdfDecoder, code: torch.Tensor, points: torch.Tensor, normals: torch.Tensor) -> float:
    """Median angle between the field's gradient a centimetre off the surface and the surface's normal [degrees]."""
    slope = decoder.field(code).slope(decoder.spread(points + 0.01 * normals))[1]
    cosine = torch.nn.functional.cosine_similarity(slope, normals).clamp(-1, 1)
    return float(torch.rad2deg(cosine.acos()).median())


def measured(decoder: UdfDecoder, number: int, item: Item, path: Path) -> dict[str, float]:
    """Figures of one learned garment from its own code; its mesh goes to ``path``."""
    truth, code = item.garment.mesh, decoder.all_codes[number]
    points, normals = sample_surface(truth, 4000, torch.Generator().manual_seed(0))
    with torch.no_grad():
        row = {"field_mm": 1e3 * float(decoder.field(code)(decoder.spread(points)).mean())}
    row["slope_deg"] = direction_error(decoder, code, points, normals)
    try:
        found = decoder.decode(code, 96).mesh
    except UserError:
        return row | {"whole": 0.0}
    write_obj(found, path, "garment")
    figures = compare_meshes(found, truth, torch.Generator().manual_seed(0), 4000)
    whole = is_manifold(found.faces.numpy()) and boundary_loops(found.faces) == boundary_loops(truth.faces)
    return row | {"surface_mm": figures["surface_mm"], "normals": figures["normals"], "whole": float(whole)}


def trained(name: str, items: list[Item], options: argparse.Namespace) -> dict[str, float]:
    """One training, and means over the measured garments."""
    out = options.work / name.replace(" ", "")
    sampling = Sampling(places=6000)
    config = TrainUdf(options.family, out=out, steps=options.steps, threads=options.threads, encoded=0,
                      sampling=sampling, evaluate=0, **RUNS[name])  # fmt: skip
    decoder, done = learn(items, config)
    chosen = np.linspace(0, len(items) - 1, options.measured).astype(int).tolist()
    rows = [measured(decoder, k, items[k], out / f"{k}.obj") for k in chosen]
    means = {
        key: round(mean(row[key] for row in rows if key in row), 4) for key in HEADS if any(key in r for r in rows)
    }
    return {"seconds": round(done.seconds), **means}


def drawn(options: argparse.Namespace, number: int) -> None:
    """The same garment of each training, beside each other."""
    views = []
    for name in RUNS:
        path = options.work / name.replace(" ", "") / f"{number}.obj"
        if path.is_file():
            mesh = read_mesh(path)
            view = picture(
                [mesh], [(0.35, 0.55, 0.8)], orbit_camera([mesh], 0.5, 0.1, (360, 240)), (360, 240), Look(samples=4)
            )
        else:
            view = torch.full((360, 240, 3), 255, dtype=torch.uint8)
        image = view.numpy().copy()
        cv2.putText(image, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
        views.append(image)
    folder = options.out.parent / "images"
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "udf-losses.png"), np.concatenate(views, 1)[..., ::-1])


def page(found: dict) -> str:
    """docs/results/udf-losses.md."""
    lines = ["| loss | " + " | ".join(HEADS.values()) + " |", "|---" * (len(HEADS) + 1) + "|"]
    for name, row in found["rows"].items():
        cells = (f"{row[key]:.3f}" if key in row else "none" for key in HEADS)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    table = "\n".join(lines)
    return f"""# Unsigned distance fields: losses compared

`python benchmarks/udf_losses.py` on {found["machine"]}, torch {torch.__version__}: DrapeNet's Fig. 13 at a small scale.
{found["steps"]} steps each (those that ship learned for thousands) on {found["garments"]} garments of each kind of
family {found["family"]}, same seed, free codes, no encoder; means over {found["measured"]} of them from their codes,
decoded at 96 by votes or, where training found sides, by those.

{table}

![The same garment of each training](../images/udf-losses.png)
"""


def main() -> None:
    """Train what is not there yet; write JSON, picture and page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", default="lower", choices=sorted(FAMILIES))
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--garments", type=int, default=6, help="of each kind")
    parser.add_argument("--measured", type=int, default=4)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "udf-losses")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    options = parser.parse_args()
    store = options.out / "udf-losses.json"
    about = {k: getattr(options, k) for k in ("family", "steps", "garments", "measured")}
    found = json.loads(store.read_text()) if store.exists() else {}
    if {k: found.get(k) for k in about} != about:
        found = {**about, "rows": {}}
    found["machine"] = f"{platform.machine()}, {options.threads} threads"
    items = [i for kind in FAMILIES[options.family] for i in load_items(kind, "train")[: options.garments]]
    for name in RUNS:
        if name not in found["rows"]:
            found["rows"][name] = trained(name, items, options)
            print(name, found["rows"][name], flush=True)
        write_whole(store, json.dumps(found, indent=1) + "\n")
    drawn(options, 0)
    write_whole(store.with_suffix(".md"), page(found))


if __name__ == "__main__":
    main()
