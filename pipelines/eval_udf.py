"""How well encoder and decoder know garments: encoded, decoded, compared with the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from recon.garments.dataset import Item
from recon.garments.sewing import is_manifold
from recon.garments.udf import UdfDecoder
from recon.metrics import boundary_loops, compare_meshes, sample_surface
from recon.types import Mesh, UserError

POINTS = 10000
"""Surface points that a garment is encoded from."""


def evaluate(
    decoder: UdfDecoder, items: Sequence[Item], resolution: int = 256, steps: int = 0, seed: int = 0
) -> dict[str, float]:
    """Means over garments that were encoded (and, with ``steps``, refined) and decoded.

    Returns:
        ``surface_mm``, ``surface_p95_mm``: exact distances between both surfaces, both ways; ``normals``: their
        consistency; ``hole_free_share``: how many have the right number of open borders and are manifold;
        ``failed``: how many codes describe no surface.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = [reconstruct(decoder, item.garment.mesh, resolution, steps, generator) for item in items]
    known = [row for row in rows if row]
    means = {name: float(np.mean([row[name] for row in known])) for name in known[0]} if known else {}
    whole = sum(row.get("hole_free_share", 0.0) for row in rows) / max(len(rows), 1)
    return {k: round(v, 4) for k, v in means.items()} | {
        "hole_free_share": round(whole, 4),
        "failed": len(rows) - len(known),
        "garments": len(rows),
    }


def reconstruct(
    decoder: UdfDecoder, truth: Mesh, resolution: int, steps: int, generator: torch.Generator
) -> dict[str, float]:
    """Figures of one garment; {} where its code describes no surface."""
    points = sample_surface(truth, POINTS, generator)[0]
    code = decoder.encode(points)
    if steps:
        code = decoder.refine(code, points, steps)
    try:
        found = decoder.decode(code, resolution).mesh
    except UserError:
        return {}
    with torch.no_grad():
        field = decoder.field(code)(decoder.spread(points))
    figures = compare_meshes(found, truth, generator, 4000)
    faces = found.faces.numpy()
    return {
        "surface_mm": figures["surface_mm"],
        "surface_p95_mm": figures["surface_p95_mm"],
        "normals": figures["normals"],
        "field_mm": 1e3 * float(field.mean()),
        "hole_free_share": float(is_manifold(faces) and boundary_loops(found.faces) == boundary_loops(truth.faces)),
    }
