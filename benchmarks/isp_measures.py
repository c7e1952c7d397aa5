"""What ``benchmarks/isp.py`` measures: fits of unseen garments, floors, interpolation, gradients, decoding times."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from pipelines.eval_isp import label_accuracy, seam_gap
from pipelines.fit_code import CodeFit, find_code
from pipelines.fit_evidence import Bank, PatternEvidence, SilhouetteEvidence, SurfaceEvidence, front_camera
from recon.bodies import load_body
from recon.garments import patterns
from recon.garments.dataset import Item, load_items
from recon.garments.isp import IspDecoder, load_isp
from recon.garments.patterns_body import Measures
from recon.garments.patterns_drape import FittingRoom
from recon.garments.sewing import is_manifold
from recon.metrics import boundary_loops, compare_meshes, panel_iou, sample_surface
from recon.types import Garment, UserError

RESOLUTIONS = (128, 256, 512)
SOURCES = ("pattern", "mesh", "points", "silhouette")
KINDS = ("top", "skirt", "trousers", "dress")
SAMPLES = 5000
POINTS = 300
"""Points of the sparse clouds."""
MASK = 256
"""Rows of the silhouettes."""
KEPT = (
    "surface_mm",
    "surface_p95_mm",
    "normals",
    "chd",
    "chd_surface",
    "panel_iou",
    "labels",
    "seam_gap_mm",
    "openings",
)


def room() -> FittingRoom:
    """Where patterns are draped on the neutral body."""
    return FittingRoom(Measures.from_body(load_body()))


def floor(item: Item, where: FittingRoom) -> dict[str, float]:
    """The data's own error: the same pattern draped again, cut into triangles 2 % larger."""
    garment = item.garment
    corners = garment.panel_points[garment.panel_faces].double()
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = float((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs().sum() / 2)
    edge = max(patterns.EDGE_LENGTH, (area / (0.866 * patterns.MAX_VERTICES)) ** 0.5)
    again = where.drape(patterns.cut(garment.variant, item.parameters, 1.02 * edge))
    return against(again, garment)


def against(found: Garment, truth: Garment) -> dict[str, float]:
    """Distances and normals of two garments."""
    return compare_meshes(found.mesh, truth.mesh, torch.Generator().manual_seed(0), SAMPLES)


def figures(decoder: IspDecoder, latent: Tensor, truth: Garment, resolution: int = 256) -> dict[str, float]:
    """All figures of one code against the truth."""
    with torch.no_grad():
        found = decoder.decode(latent, resolution)
        row = against(found, truth)
        row["panel_iou"] = panel_iou(found, truth)
        row["openings"] = float(boundary_loops(found.mesh.faces) == boundary_loops(truth.mesh.faces))
        row["labels"] = label_accuracy(decoder, latent, truth)
        row["seam_gap_mm"] = float(seam_gap(decoder, found).mean()) * 1e3
    return {k: row[k] for k in KEPT}


def code_of(decoder: IspDecoder, truth: Garment, source: str, bank: Bank | None, search: CodeFit) -> Tensor:
    """The code (z,) found from a garment's pattern, mesh, sparse points or frontal silhouette."""
    if source == "pattern":
        evidence = PatternEvidence.of(decoder, truth)
        return find_code(decoder, evidence, decoder.codes[evidence.starts()], search).latent
    assert bank is not None
    seen: SurfaceEvidence | SilhouetteEvidence
    if source == "silhouette":
        seen = SilhouetteEvidence(decoder, silhouette(decoder, truth), front_camera((MASK, MASK)))
    elif source == "points":
        points = sample_surface(truth.mesh, POINTS, torch.Generator().manual_seed(0))[0]
        seen = SurfaceEvidence(decoder, points)
    else:
        seen = SurfaceEvidence(decoder, truth.mesh)
    return find_code(decoder, seen, decoder.codes[seen.starts(bank)], search).latent


def silhouette(decoder: IspDecoder, garment: Garment) -> Tensor:
    """(MASK, MASK) coverage of the garment on the neutral body, from the front."""
    drawn = SilhouetteEvidence(decoder, torch.eye(MASK), front_camera((MASK, MASK)), MASK)
    drawn.take(garment)
    return drawn.image(garment.mesh.vertices)


def fits(kind: str, source: str, count: int, search: CodeFit) -> Iterator[dict]:
    """One row for each of the first unseen garments of a kind."""
    decoder = load_isp(kind)
    bank = Bank(decoder) if source != "pattern" else None
    for number, item in enumerate(load_items(kind, "test")[:count]):
        begun = time.perf_counter()
        latent = code_of(decoder, item.garment, source, bank, search)
        spent = time.perf_counter() - begun
        row = {"kind": kind, "source": source, "garment": number, "variant": item.garment.variant}
        row |= figures(decoder, latent, item.garment) | {"seconds": round(spent, 1)}
        if source == "pattern":
            for resolution in RESOLUTIONS:
                with torch.no_grad():
                    row[str(resolution)] = against(decoder.decode(latent, resolution), item.garment)
        yield row


def seen(kind: str, count: int) -> Iterator[dict]:
    """One row for each of the first garments that the decoder learned."""
    decoder = load_isp(kind)
    for number, item in enumerate(load_items(kind, "train")[:count]):
        with torch.no_grad():
            found = {str(r): against(decoder.decode(decoder.codes[number], r), item.garment) for r in RESOLUTIONS}
        yield {"kind": kind, "source": "seen", "garment": number, **found}


def interpolations(kind: str, count: int, resolution: int = 128, seed: int = 0) -> dict[str, float]:
    """Random places on the way between random learned codes.

    ``right``: manifold, with as many open borders as one of the two ends, and as both where they agree; ``changing``:
    pairs whose ends differ, ``right_changing``: how many of these are right.
    """
    decoder, rng = load_isp(kind), np.random.default_rng(seed)
    rows = []
    loops: dict[int, int] = {}
    with torch.no_grad():
        for _ in range(count):
            a, b = (int(k) for k in rng.choice(len(decoder.codes), 2, replace=False))
            for k in (a, b):
                loops.setdefault(k, boundary_loops(decoder.decode(decoder.codes[k], 96).mesh.faces))
            share = float(rng.uniform(0.1, 0.9))
            try:
                faces = decoder.decode(torch.lerp(decoder.codes[a], decoder.codes[b], share), resolution).mesh.faces
                manifold, found = is_manifold(faces.numpy()), boundary_loops(faces)
            except UserError:
                manifold, found = False, -1
            rows.append((manifold, manifold and found in (loops[a], loops[b]), loops[a] != loops[b]))
    manifold, right, changing = np.array(rows).T
    names = {"pairs": count, "manifold": manifold.sum(), "right": right.sum(), "changing": changing.sum()}
    return {k: int(v) for k, v in names.items()} | {"right_changing": int((right & changing).sum())}


def gradient_error(kind: str, codes: int = 3, resolution: int = 96, step: float = 2e-3) -> dict[str, float]:
    """Eq. 6 against central differences along random directions, percent of the vertices' motion."""
    decoder, generator = load_isp(kind), torch.Generator().manual_seed(0)
    errors: dict[str, list[float]] = {"inside": [], "border": []}
    for k in range(codes):
        code = decoder.codes[(37 * k) % len(decoder.codes)]
        way = torch.randn(len(code), generator=generator)
        way = way / way.norm()
        with torch.no_grad():
            shape = decoder.decode_like(code, decoder.decode(code, resolution))
            ends = [decoder.decode_like(code + h * way, shape).mesh.vertices for h in (step, -step)]
        moved = (ends[0] - ends[1]) / (2 * step)
        found = _directional(lambda z, like=shape: decoder.decode_like(z, like).mesh.vertices, code, way)
        border = torch.zeros(len(moved), dtype=torch.bool)
        border[shape.vertex_of_point[shape.border_labels >= 0]] = True
        for name, rows in (("inside", ~border), ("border", border)):
            errors[name].append(100 * float((found - moved)[rows].norm() / moved[rows].norm()))
    return {name: round(float(np.mean(values)), 3) for name, values in errors.items()}


def _directional(function: Callable[[Tensor], Tensor], at: Tensor, way: Tensor) -> Tensor:
    """Derivative of ``function`` along ``way``: reverse mode twice."""
    z = at.clone().requires_grad_()
    out = function(z)
    dummy = torch.zeros_like(out, requires_grad=True)
    (back,) = torch.autograd.grad(out, z, dummy, create_graph=True)
    (along,) = torch.autograd.grad(back, dummy, way)
    return along


def decode_ms(kind: str, resolution: int, rounds: int) -> float:
    """Median time of a forward decoding over learned codes [ms]."""
    decoder = load_isp(kind)
    times = []
    with torch.no_grad():
        for k in range(rounds + 1):
            begun = time.perf_counter()
            decoder.decode(decoder.codes[(31 * k) % len(decoder.codes)], resolution)
            times.append(1e3 * (time.perf_counter() - begun))
    return round(statistics.median(times[1:]), 1)
