"""Artist-made garments through ``recon encode``: what was repaired, where they were put, how well they are known.

    GARMENT_RECON_SHARED=... python benchmarks/artists.py      # to docs/results/artists.json and artists.md

The garments may not be passed on: they are looked for under ``garments`` of that folder. They are unlike the data
that the decoders learned from (tight, with straps, strapless, of several layers), in another pose and elsewhere.
Interrupted, the same command goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import torch

from pipelines.encode import Encode, encode
from recon.files.atomic import write_whole
from recon.types import UserError

ROOT = Path(__file__).resolve().parent.parent
FOLDER = Path(os.environ.get("GARMENT_RECON_SHARED", ROOT.parent / "shared")) / "garments"
KINDS = {
    "female_top_01": "top",
    "VNeckTop": "top",
    "Tank_Top_01": "top",
    "short_tail_camo_tee": "top",
    "Asymmetric_Tunic_and_Sash": "top",
    "Coat": "top",
    "Tightjeans": "trousers",
    "ShortJeans": "trousers",
    "miniskirt": "skirt",
    "JeansSkirt": "skirt",
    "TubeDress": "dress",
    "F_Dress_01": "dress",
    "F_Dress_02": "dress",
}
"""Garment -> what a person would call it."""
TOLD = ("kind", "nearest", "known", "distance_mm", "usual_mm", "surface_mm", "turned", "notes")


def encoded(name: str, options: argparse.Namespace) -> dict:
    """One garment with everything guessed; a refusal is a row, too."""
    begin = time.process_time()
    try:
        found = encode(Encode((FOLDER / f"{name}.obj",), weights=options.weights, out=options.work / name))
    except UserError as error:
        return {"refused": str(error).replace(f"{FOLDER}/", "")}
    return {**{key: found[key] for key in TOLD}, "seconds": round(time.process_time() - begin, 1)}


def page(found: dict) -> str:
    """docs/results/artists.md."""
    lines = ["| garment | read as | known | field mm | surface mm | told |", "|---" * 6 + "|"]
    for name, row in found["rows"].items():
        if "refused" in row:
            lines.append(f"| {name} ({KINDS[name]}) | refused | | | | {row['refused']} |")
            continue
        read = f"{row['kind']} ({row['nearest']}){', turned' if row['turned'] else ''}"
        told = "; ".join(note.split("; --")[0] for note in row["notes"])
        figures = f"{row['known']} | {row['distance_mm']:.1f} | {row['surface_mm']:.1f}"
        lines.append(f"| {name} ({KINDS[name]}) | {read} | {figures} | {told} |")
    right = sum(row.get("kind") == KINDS[name] for name, row in found["rows"].items())
    table = "\n".join(lines)
    return f"""# Artist-made garments, encoded

`python benchmarks/artists.py` on {found["machine"]}: `recon encode` with everything guessed
(kind, unit, axis, place). Here: {len(found["rows"])} of {len(KINDS)}, the kind right in {right}.

*Field*: mean distance of the mesh's points by the code's field, for unseen garments of the data set about 2.2 mm;
*surface*: exact mean distance between the meshes, both ways. The decoders know loose clothes of two panels in T pose,
and say what they hardly know.

{table}
"""


def main() -> None:
    """Encode what is not there yet; write JSON and page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="folder of weights; default: those that ship")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "artists")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if not FOLDER.is_dir():
        raise SystemExit(f"{FOLDER}: not there; GARMENT_RECON_SHARED names the folder that holds garments/")
    store = options.out / "artists.json"
    found = json.loads(store.read_text()) if store.exists() else {"rows": {}}
    found["machine"] = f"{platform.machine()}, {options.threads} threads"
    for name in KINDS:
        if name not in found["rows"]:
            found["rows"][name] = encoded(name, options)
            print(name, found["rows"][name], flush=True)
        write_whole(store, json.dumps(found, indent=1) + "\n")
        write_whole(store.with_suffix(".md"), page(found))


if __name__ == "__main__":
    main()
