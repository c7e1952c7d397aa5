"""Both decoders side by side, found from the same meshes: ISP's Tables 1-3 with their UDF rows.

Unseen garments are found from their meshes (sewing patterns by distances both ways and open borders, distance fields by
encoding 10,000 points and refining the code on them), learned ones are decoded from their own codes. CHD is ISP's:
sampled, and to the exact surface.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from statistics import fmean

import torch
from isp_measures import KINDS, RESOLUTIONS, against, code_of
from torch import Tensor

from pipelines.eval_udf import POINTS
from pipelines.fit_code import CodeFit
from pipelines.fit_evidence import Bank
from recon.garments.dataset import load_items
from recon.garments.isp import load_isp
from recon.garments.udf import UdfDecoder, load_udf
from recon.metrics import sample_surface
from recon.types import Garment, UserError

REFINING = 60
"""Steps on an encoded code."""
FIGURES = ("chd", "chd_surface", "surface_mm", "normals", "ms")


def fitted(decoder: UdfDecoder, truth: Garment) -> Tensor:
    """The code (z,) of a distance field for a garment's mesh."""
    points = sample_surface(truth.mesh, POINTS, torch.Generator().manual_seed(0))[0]
    return decoder.refine(decoder.encode(points), points, REFINING)


def rows(kind: str, unseen: int, learned: int) -> Iterator[dict]:
    """One row for each garment, decoder and resolution."""
    isp, udf = load_isp(kind), load_udf(kind)
    bank = Bank(isp)
    for group, split, count in (("unseen", "test", unseen), ("learned", "train", learned)):
        for number, item in enumerate(load_items(kind, split)[:count]):
            if group == "unseen":
                codes = {"ISP": code_of(isp, item.garment, "mesh", bank, CodeFit()), "UDF": fitted(udf, item.garment)}
            else:
                codes = {"ISP": isp.codes[number], "UDF": udf.codes[number]}
            for name, decoder in (("UDF", udf), ("ISP", isp)):
                for resolution in RESOLUTIONS:
                    row = {"kind": kind, "group": group, "decoder": name, "resolution": resolution}
                    yield row | decoded(decoder, codes[name], resolution, item.garment)


@torch.no_grad()
def decoded(decoder, code: Tensor, resolution: int, truth: Garment) -> dict[str, float]:
    """Figures of one garment; none where the code describes none."""
    begun = time.perf_counter()
    try:
        found = decoder.decode(code, resolution)
    except UserError:
        return {}
    return {"ms": 1e3 * (time.perf_counter() - begun)} | against(found, truth)


def measure(unseen: int = 3, learned: int = 2) -> list[dict]:
    """Means over the garments of each kind."""
    means = []
    for kind in KINDS:
        found = list(rows(kind, unseen, learned))
        for key in dict.fromkeys((r["group"], r["resolution"], r["decoder"]) for r in found):
            mine = [r for r in found if (r["group"], r["resolution"], r["decoder"]) == key and "ms" in r]
            head = dict(zip(("group", "resolution", "decoder"), key)) | {"kind": kind, "garments": len(mine)}
            means.append(head | {name: fmean(r[name] for r in mine) for name in FIGURES if mine})
        print(kind, flush=True)
    return means


def table(means: list[dict]) -> list[str]:
    """Markdown lines, with what ISP's CHD is of UDF's."""
    head = "| garments | kind | grid | decoder | CHD (1e-4) | CHD to surface | of UDF's | mm | NC % | ms |"
    lines, base = [head, "|---" * 10 + "|"], {}
    for r in means:
        key = (r["kind"], r["group"], r["resolution"])
        base.setdefault(key, r["chd_surface"])  # UDF comes first
        share = "" if r["decoder"] == "UDF" else f"{r['chd_surface'] / base[key]:.2f}"
        values = (f"{1e4 * r['chd']:.2f}", f"{1e4 * r['chd_surface']:.2f}", share, f"{r['surface_mm']:.2f}")
        values += (f"{100 * r['normals']:.1f}", f"{r['ms']:.0f}")
        cells = (f"{r['garments']} {r['group']}", r["kind"], r["resolution"], r["decoder"], *values)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines
