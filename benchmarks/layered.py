"""Recovery of layered garments (ISP Eq. 11, 18-23) against known truth: jacket over top over trousers or skirt.

    python benchmarks/layered.py --cases 20     # to docs/results/layered.json, .md and .jpg; goes on where it stopped

Unseen test garments are put on unseen bodies in unseen poses by simulation (``truth.make_truth``) and rendered to ONE
label mask, written and read as a user's PNG; landmarks as in ``benchmarks/photo.py``. The fit is that of ``recon
photo`` after perception. IoU is label-wise, of what is seen. Distances are exact, point to surface, in millimetres,
once the pelvis is where the true one is: *whole* garment (both ways averaged) and *covered*, from those of its true
points that outer garments hide from the camera. *Beneath*: share of an outer layer's area that lies under the layer it
should cover, where that can be told; the order is right if it is less than half for every pair of layers.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from dataclasses import replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from truth import SIZE, TRUSTED, Found, Truth, fit_truth, make_truth

from pipelines.palette import SKIN, layer_colour
from pipelines.photo import PhotoFit, load_models
from recon.cloth.beneath import Beneath
from recon.files.atomic import write_whole
from recon.files.masks import read_masks
from recon.metrics import beneath_pct, compare_meshes, sample_surface, surface_distance
from recon.perceive.photo import ordered
from recon.render.hits import first_hit
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Camera, Mesh

ROOT = Path(__file__).resolve().parent.parent
OUTFITS = (("trousers", "top", "jacket"), ("skirt", "top", "jacket"))
"""As a user may name them; the pipeline finds the order."""
POINTS = 10000
HIDDEN = 0.005
"""A point is hidden where the camera sees something nearer by more than this [m]."""
AIMS = "Aims: label-wise IoU of at least 0.93, hidden layers within 20 mm in median, always the right order."


def from_one_mask(truth: Truth, path: Path) -> Truth:
    """The same photo, its masks written to one label PNG and read back as ``--masks FILE --labels ...`` does."""
    names = list(truth.photo.garments)
    image = np.zeros(SIZE, np.uint8)
    for number, mask in enumerate(truth.photo.garments.values(), 1):
        image[mask.numpy()] = number
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)
    labels = [f"{number}={name}" for number, name in enumerate(names, 1)]
    return replace(truth, photo=replace(truth.photo, garments=read_masks([str(path)], labels, names, SIZE)))


def covered(truth: Truth, name: str) -> Tensor:
    """(N, 3) points of a true garment that outer garments hide from the camera."""
    names = list(truth.meshes)
    outer = [truth.meshes[n] for n in names[: names.index(name)]]
    points = sample_surface(truth.meshes[name], POINTS, torch.Generator().manual_seed(0))[0]
    if not outer:
        return points[:0]
    depth = first_hit(outer, truth.camera, SIZE).depth
    column, row = truth.camera.project(points).long().unbind(1)
    inside = (row >= 0) & (row < SIZE[0]) & (column >= 0) & (column < SIZE[1])
    at = depth[row.clamp(0, SIZE[0] - 1), column.clamp(0, SIZE[1] - 1)]
    own = (points @ truth.camera.R.T + truth.camera.t)[:, 2]
    return points[inside & (at < own - HIDDEN)]


def beneath(meshes: dict[str, Mesh]) -> dict[str, float]:
    """``outer/inner`` -> share of the outer layer's area that lies beneath the inner one [%]."""
    names = list(meshes)
    under = {n: Beneath.of(meshes[n].vertices, meshes[n].faces) for n in names}
    pairs = [(outer, inner) for k, outer in enumerate(names) for inner in names[k + 1 :]]
    return {f"{outer}/{inner}": beneath_pct(meshes[outer], under[inner]) for outer, inner in pairs}


def measure(truth: Truth, found: Found) -> dict:
    """The figures of one outfit."""
    garments = {}
    for name, true in truth.meshes.items():
        mesh = found.meshes[name]
        hidden = covered(truth, name)
        garments[name] = {
            "iou": round(found.iou[name], 4),
            "whole_mm": round(compare_meshes(mesh, true, torch.Generator().manual_seed(0))["surface_mm"], 2),
            "covered_pct": round(100 * len(hidden) / POINTS, 1),
            "covered_mm": round(1e3 * float(surface_distance(hidden, mesh)[0].mean()), 2) if len(hidden) else None,
        }
    shares = beneath(found.meshes)
    return {
        "garments": garments,
        "beneath_pct": {k: round(v, 2) for k, v in shares.items()},
        "truth_beneath_pct": {k: round(v, 2) for k, v in beneath(truth.meshes).items()},
        "right_order": list(found.meshes) == list(truth.meshes) and max(shares.values()) < 50,
    }


def row_of(truth: Truth, found: Found, size: tuple[int, int] = (330, 190)) -> NDArray:
    """(h, w, 3) BGR: the label mask; truth and recovery from the front, then without the jacket, then behind."""
    h, w = size
    colours = [layer_colour(k) for k in range(len(truth.meshes))]
    mask = np.full((*SIZE, 3), 255, np.uint8)
    for colour, on in zip(colours, truth.photo.garments.values(), strict=True):
        mask[on.numpy()] = [round(255 * c) for c in colour[::-1]]
    ys, _ = np.nonzero(truth.photo.person.numpy() > 0.5)
    cut = mask[max(0, ys.min() - 10) : ys.max() + 10]
    wide = round(cut.shape[0] * w / h)
    left = max(0, (SIZE[1] - wide) // 2)
    columns = [cv2.resize(cut[:, left : left + wide], (w, h), interpolation=cv2.INTER_AREA)]

    def shown(outfit: Truth | Found, first: int, azimuth: float) -> NDArray:
        whole = [outfit.body, *outfit.meshes.values()]
        view: Camera = orbit_camera(whole, azimuth, 0.0, size)
        parts = [outfit.body, *list(outfit.meshes.values())[first:]]
        look = Look(samples=4, sky_rays=3, lamp_rays=1)
        return picture(parts, [SKIN, *colours[first:]], view, look=look).numpy()[..., ::-1]

    for first, azimuth in ((0, 0.0), (1, 0.0), (0, 3.1)):
        columns += [shown(truth, first, azimuth), shown(found, first, azimuth)]
    return np.hstack(columns)


def run(number: int, out: Path) -> dict:
    """Make, fit, measure and draw one outfit."""
    outfit = OUTFITS[number % len(OUTFITS)]
    config = PhotoFit(photo=Path("made"), garments=outfit, body_fit=TRUSTED, out=out / f"layered-{number}")
    models = load_models(outfit, config)
    truth = from_one_mask(make_truth(tuple(ordered(outfit)), number, models), out / f"layered-{number}.png")
    found = fit_truth(truth, number, models, config)
    cv2.imwrite(str(out / f"layered-{number}.jpg"), row_of(truth, found), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return measure(truth, found)


def summary(rows: list[dict]) -> dict[str, dict[str, float]]:
    """Medians per garment name, and of the hidden layers together (all but the outermost)."""
    flat = [(name, g, k) for row in rows for k, (name, g) in enumerate(row["garments"].items())]
    groups = {name: [g for n, g, _ in flat if n == name] for name in dict.fromkeys(n for n, _, _ in flat)}
    groups["all"] = [g for _, g, _ in flat]
    groups["hidden layers"] = [g for _, g, k in flat if k]
    out = {}
    for name, mine in groups.items():
        hidden = [g["covered_mm"] for g in mine if g["covered_mm"] is not None]
        out[name] = {
            "garments": len(mine),
            "iou": median(g["iou"] for g in mine),
            "worst_iou": min(g["iou"] for g in mine),
            "whole_mm": median(g["whole_mm"] for g in mine),
            "covered_mm": median(hidden) if hidden else None,
        }
    return out


def page(found: dict) -> str:
    """docs/results/layered.md."""
    rows = list(found["rows"].values())
    right = sum(row["right_order"] for row in rows)
    assert __doc__ is not None
    lines = [
        "# Layers from one label mask",
        "",
        f"`python benchmarks/layered.py` on {found['machine']}, {found['cores']} cores.",
        "",
        __doc__.split("\n\n")[2],
        AIMS,
        *(["", found["note"]] if found.get("note") else []),
        "",
        f"Outfits: {len(rows)}; the right order in {right}.",
        "",
        "| layer | garments | IoU, median | IoU, worst | whole mm, median | covered mm, median |",
        "|---|---|---|---|---|---|",
    ]
    for name, g in summary(rows).items():
        hidden = "" if g["covered_mm"] is None else f"{g['covered_mm']:.1f}"
        figures = f"{g['iou']:.3f} | {g['worst_iou']:.3f} | {g['whole_mm']:.1f} | {hidden}"
        lines.append(f"| {name} | {g['garments']} | {figures} |")
    lines += ["", "Beneath, median over outfits, recovered and (truth, as the simulation left it):", ""]
    for pair in dict.fromkeys(k for row in rows for k in row["beneath_pct"]):
        own = median(row["beneath_pct"][pair] for row in rows if pair in row["beneath_pct"])
        true = median(row["truth_beneath_pct"][pair] for row in rows if pair in row["truth_beneath_pct"])
        lines.append(f"- {pair}: {own:.2f} % ({true:.2f} %)")
    caption = "mask; then truth and recovery by turns: from the front, without the jacket, from behind"
    return "\n".join([*lines, "", f"A row an outfit: {caption}.", "", "![Layered outfits](layered.jpg)", ""])


def main() -> None:
    """Run the outfits that were not measured yet; write JSON, page and picture."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "benchmark")
    parser.add_argument("--shown", type=int, default=6, help="outfits in the picture")
    parser.add_argument("--note", help="what a reader must know about this run")
    options = parser.parse_args()
    store = ROOT / "docs" / "results" / "layered.json"
    found = json.loads(store.read_text()) if store.exists() else {"rows": {}}
    found |= {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    found |= {"note": options.note} if options.note is not None else {}
    for number in range(options.cases):
        if str(number) not in found["rows"]:
            found["rows"][str(number)] = run(number, options.out)
            print(number, json.dumps(found["rows"][str(number)]), flush=True)
        write_whole(store, json.dumps(found, indent=1) + "\n")
        write_whole(store.with_suffix(".md"), page(found))
    rows = [cv2.imread(str(options.out / f"layered-{n}.jpg")) for n in range(min(options.shown, options.cases))]
    if rows and all(row is not None for row in rows):
        cv2.imwrite(str(store.with_suffix(".jpg")), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
