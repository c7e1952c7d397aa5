"""The results of a scan's fit: what a photo's has, and the distances to the scan in millimetres as a coloured mesh."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pipelines.fit_body import to_body
from pipelines.fit_garment import Layer, Models
from pipelines.fit_result import FitResult
from pipelines.measure import by_code, geometry
from pipelines.results import described, grounded, header, panel_notes, shifted, write_meshes
from pipelines.scan_report import HIDDEN, coloured, write_scan_pictures, write_scan_report
from recon.cloth.contact import BodyContact
from recon.files.atomic import write_whole
from recon.files.coloured import write_coloured
from recon.metrics import surface_distance
from recon.types import Mesh, Scan

Fitted = tuple[dict[str, Tensor], list[Layer], dict[str, Mesh]]
"""Body parameters; the layers at rest, graded, outermost first; name -> refined posed mesh."""


def write_scan_results(config, scan: Scan, models: Models, fitted: Fitted, seconds: dict) -> FitResult:
    """Measure, write all files, and last ``result.json``: its presence says that the others are there."""
    begin = time.perf_counter()
    values, layers, meshes = fitted
    out = Path(config.out)
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
    body, moved, shift = grounded(Mesh(posed.mesh.vertices[0], models.body.faces), meshes)
    scan, layers = replace(scan, points=scan.points + shift), shifted(layers, shift)
    place = replace(to_body(values), translation=values["translation"] + shift)
    gaps = {name: to_scan(mesh, name, scan) for name, mesh in moved.items()}
    figures = {
        **header(config),
        "garments": measured(layers, moved, gaps, models, place, scan),
        "body": body_figures(body, scan),
        "body_model": described(config.body, place),
        "scan": {"points": len(scan.points), "of": {name: len(scan.of(name)) for name in scan.names}},
        "notes": [*scan.notes, *panel_notes(layers)],
    }
    write_meshes(out, body, layers, moved)
    parts = {name: (mesh, 1e3 * gaps[name], coloured(gaps[name])) for name, mesh in moved.items()}
    write_coloured(parts, out / "distances.ply", "distance_mm")
    write_coloured(parts, out / "distances.glb", "distance_mm")
    result = FitResult(out, figures, place, body, tuple(layers), moved, scan=scan)
    pictures = write_scan_pictures(result, gaps)
    took = time.perf_counter() - begin
    figures["seconds"] = {**seconds, "export": took, "total": sum(seconds.values()) + took}
    write_scan_report(result, pictures, config)
    write_whole(out / "result.json", json.dumps(figures, indent=1) + "\n")
    return result


def to_scan(mesh: Mesh, name: str, scan: Scan) -> Tensor:
    """(V,) distance of each vertex to the nearest point of its label [m]; infinite where nothing was scanned: nearer
    than ``HIDDEN`` there is no such point, or there is one of another label nearer."""
    from scipy.spatial import cKDTree

    x = mesh.vertices.detach().cpu().numpy()
    own = torch.as_tensor(cKDTree(scan.of(name).cpu().numpy()).query(x)[0])
    outer = scan.names[1 : scan.names.index(name)]
    above = scan.of(*outer) if outer else scan.points[:0]
    hidden = own > HIDDEN
    if len(above):
        hidden |= torch.as_tensor(cKDTree(above.cpu().numpy()).query(x)[0]) < own
    return torch.where(hidden, torch.inf, own).float()


def measured(
    layers: list[Layer], meshes: dict[str, Mesh], gaps: dict[str, Tensor], models: Models, place, scan: Scan
) -> dict[str, dict]:
    """Figures per garment: distances of its scan points to it, before and after refinement, and its geometry."""
    with torch.no_grad():
        posed = models.body.pose(place)
        contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
        out = {}
        for layer in layers:
            name, points = layer.name, scan.of(layer.name)
            coded = by_code(layer, posed, models)
            away = 1e3 * surface_distance(points, meshes[name])[0]
            seen = gaps[name].isfinite()
            out[name] = {
                "kind": layer.garment.kind,
                "scan_mm": float(away.median()),
                "scan_p95_mm": float(away.quantile(0.95)),
                "scan_mm_code_only": float(1e3 * surface_distance(points, coded)[0].median()),
                "seen_share": float(seen.float().mean()),
                **geometry(layer, meshes[name], contact),
            }
    return out


def body_figures(body: Mesh, scan: Scan) -> dict[str, float]:
    """How far skin points are from the body, and how many garments' points are inside of it."""
    contact = BodyContact(body.vertices, body.faces)
    skin, cloth = scan.of("body"), scan.of(*scan.names[1:])
    found = {"cloth_inside": float((contact.signed_distance(cloth) < 0).float().mean())}
    if len(skin):
        found["skin_mm"] = float(1e3 * contact.signed_distance(skin).abs().median())
    return found
