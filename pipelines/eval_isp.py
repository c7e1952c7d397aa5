"""Measure an implicit sewing pattern decoder on garments that it has and has not seen (ISP §4.2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.fit_code import CodeFit, find_code
from pipelines.fit_evidence import Bank, PatternEvidence, SurfaceEvidence
from pipelines.isp_samples import along, panel_border, signed_distance
from recon.garments.isp import IspDecoder
from recon.garments.sewing import is_manifold, sewn_to
from recon.metrics import boundary_loops, compare_meshes, largest_stretch, panel_iou
from recon.types import Garment, Mesh, UserError

RESOLUTION = 256
"""Grid at which decoded garments are compared."""
FROM_MESH = 4
"""How many unseen garments are also found from their mesh: each takes a hundred decodings."""
BESIDE = 0.003
"""Border labels are asked for within this distance of the border [m]."""


def evaluate(
    decoder: IspDecoder, seen: list[Garment], unseen: list[Garment], seed: int = 0
) -> dict[str, dict[str, float]]:
    """Figures for the card: learned codes against their own garments, and unseen garments whose code is searched.

    ``seen`` are the garments of the first codes. Unseen ones are found twice: from their pattern (distances and labels)
    and from their mesh alone (distances of surfaces and open borders, with Eq. 6's gradient).
    """
    generator = torch.Generator().manual_seed(seed)
    pairs = {"seen": [(decoder.codes[k], g) for k, g in enumerate(seen)]}
    if unseen:
        pairs["unseen_from_pattern"] = [(fit_pattern(decoder, g, seed), g) for g in unseen]
        bank = Bank(decoder)
        pairs["unseen_from_mesh"] = [(fit_surface(decoder, g.mesh, bank, seed), g) for g in unseen[:FROM_MESH]]
    result: dict[str, dict[str, float]] = {}
    for name, group in pairs.items():
        rows = [measure(decoder, z, g, generator) for z, g in group]
        keys = sorted({k for row in rows for k in row})
        result[name] = {k: round(float(np.mean([row[k] for row in rows if k in row])), 6) for k in keys}
        result[name]["garments"] = len(rows)
    return result


def measure(decoder: IspDecoder, latent: Tensor, truth: Garment, generator: torch.Generator) -> dict[str, float]:
    """All figures of one decoded garment against the truth."""
    with torch.no_grad():
        try:
            found = decoder.decode(latent, RESOLUTION)
        except UserError:
            return {"decodes": 0.0}
        row = compare_meshes(found.mesh, truth.mesh, generator, 5000)
        row["decodes"] = 1.0
        row["panel_iou"] = panel_iou(found, truth)
        row["right_loops"] = float(boundary_loops(found.mesh.faces) == boundary_loops(truth.mesh.faces))
        row["stretch_p95"] = float(largest_stretch(found).quantile(0.95))
        row["manifold"] = float(is_manifold(found.mesh.faces.numpy()))
        row["labels"] = label_accuracy(decoder, latent, truth)
        gap = seam_gap(decoder, found)
        if len(gap):
            row["seam_gap_mm"], row["seam_gap_p95_mm"] = float(gap.mean()) * 1e3, float(gap.quantile(0.95)) * 1e3
    return row


def label_accuracy(decoder: IspDecoder, latent: Tensor, truth: Garment, count: int = 1000) -> float:
    """Share of points within ``BESIDE`` of the truth's border, all of it alike, whose label the network finds."""
    rng, right = np.random.default_rng(0), []
    shape = decoder.nets.shape
    for panel in range(decoder.panels):
        border = panel_border(truth, shape, panel)
        even = replace(border, weight=np.linalg.norm(border.end - border.start, axis=1))
        angle = 2 * np.pi * rng.random((count, 1))
        aside = BESIDE / shape.half * rng.random((count, 1)) * np.concatenate([np.cos(angle), np.sin(angle)], 1)
        at = along(even, rng, count)[0] + aside
        label = signed_distance(border, at)[1]
        _, logits = decoder.pattern(latent, decoder.nets.to_panel(torch.as_tensor(at, dtype=latent.dtype)))
        right.append((logits[:, panel].argmax(-1).numpy() == label).mean())
    return float(np.mean(right))


def seam_gap(decoder: IspDecoder, garment: Garment) -> Tensor:
    """(S,) distances [m] between the two sides of each seam point before they are welded."""
    assert garment.latent is not None
    one = torch.arange(len(garment.panel_points))
    other = torch.as_tensor(sewn_to(garment.vertex_of_point.numpy()))
    both = torch.stack([one, other], 1)[other > one]
    lifted = decoder.surface(garment.latent.detach(), garment.panel_points[both].flatten(0, 1))
    own = lifted[torch.arange(len(lifted)), garment.panel_of_point[both].flatten()].unflatten(0, (-1, 2))
    return (own[:, 0] - own[:, 1]).norm(dim=1)


def fit_pattern(decoder: IspDecoder, truth: Garment, seed: int = 0) -> Tensor:
    """The code (z,) whose flat panels match the garment's."""
    evidence = PatternEvidence.of(decoder, truth, seed)
    return find_code(decoder, evidence, decoder.codes[evidence.starts()], CodeFit(seed=seed)).latent


def fit_surface(decoder: IspDecoder, target: Mesh | Tensor, bank: Bank, seed: int = 0) -> Tensor:
    """The code (z,) whose sewn garment is nearest to a mesh or to points (N, 3); nothing of the pattern is used."""
    evidence = SurfaceEvidence(decoder, target, seed=seed)
    return find_code(decoder, evidence, decoder.codes[evidence.starts(bank)], CodeFit(seed=seed)).latent
