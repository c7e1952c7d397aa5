"""``report.html`` of a scan's fit: the scan, the garments found, their distances to it, figures and patterns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipelines.fit_result import FitResult
from pipelines.page import Picture, encoded, figures_table, section, strip, write_page
from pipelines.report import Colour, colour_of, common_sections, row_of
from recon.files.atomic import write_whole
from recon.types import Camera, Scan

HIDDEN = 0.05
"""Cloth further than this from any scan point of its own was not scanned [m]."""
FULL = 0.02
"""Distance at the end of the colour scale [m]."""
UNSEEN = (0.72, 0.72, 0.72)

TARGETS: dict[str, tuple[str, str, float | None, bool]] = {
    "scan_mm": ("its scan points' distance, median [mm]", "{:.1f}", 4.0, False),
    "scan_p95_mm": ("the same, 95th percentile [mm]", "{:.1f}", None, False),
    "scan_mm_code_only": ("median before refinement [mm]", "{:.1f}", 12.0, False),
    "penetrating_vertices": ("vertices inside the body", "{}", 0, False),
    "penetrating_faces": ("faces inside the body", "{}", 0, False),
    "self_intersections": ("self-intersections (pairs of faces)", "{}", 0, False),
    "stretch_p95": ("stretch, 95th percentile", "{:.3f}", 1.10, False),
    "seen_share": ("share of it that was scanned", "{:.2f}", None, True),
    "vertices": ("vertices", "{}", None, True),
    "faces": ("faces", "{}", None, True),
}
"""Figure -> what to call it, its format, what it should be at least (True) or at most (False)."""


@dataclass(frozen=True)
class ScanPictures:
    """What the report shows: (h, w, 3) uint8 RGB each."""

    scan: Picture
    """The points from the front, in their labels' colours."""
    dressed: Picture
    """Body and garments from the same side."""
    distances: tuple[Picture, ...]
    """Garments from four sides, coloured by their distance to the scan."""
    turntable: tuple[Picture, ...]
    """Body and garments from around."""


def coloured(distance: Tensor) -> Tensor:
    """(V,) distances [m] -> (V, 3) sRGB in [0, 1]: violet at 0, yellow at ``FULL``, grey where nothing was scanned."""
    from matplotlib import colormaps

    share = (distance / FULL).clamp(0, 1).nan_to_num(1.0).cpu().numpy()
    colour = torch.as_tensor(colormaps["plasma"](share)[:, :3], dtype=torch.float32)
    return torch.where(distance.cpu().isfinite()[:, None], colour, torch.tensor(UNSEEN))


def front(result: FitResult) -> float:
    """The direction that the body faces, as an angle about y [rad]: from there pictures are taken."""
    from recon.bodies.rig import rotation_matrices

    turn = result.body_pose.pose[0, 0]
    ahead = rotation_matrices(turn[None])[0] @ turn.new_tensor([0.0, 0.0, 1.0])
    return float(torch.atan2(ahead[0], ahead[2]))


def write_scan_pictures(result: FitResult, gaps: Mapping[str, Tensor]) -> ScanPictures:
    """Draw the fit, and write ``overlay.png`` (scan and fit beside each other) and ``turntable.png``."""
    from recon.render.shade import Look, orbit_camera, picture

    assert result.scan is not None, "a scan's fit has it"
    meshes = [result.body, *result.garments.values()]
    plain: list[Colour | Tensor] = [colour_of(name) for name in ("body", *result.garments)]
    shaded: list[Colour | Tensor] = [(0.93, 0.93, 0.93), *(coloured(gaps[name]) for name in result.garments)]
    look, size, facing = Look(samples=4, sky_rays=4), (480, 320), front(result)

    def views(colours: list[Colour | Tensor], count: int) -> tuple[Picture, ...]:
        cameras = [orbit_camera(meshes, facing + 2 * np.pi * k / count, 0.0, size) for k in range(count)]
        return tuple(picture(meshes, colours, camera, size, look).cpu().numpy() for camera in cameras)

    ahead = orbit_camera(meshes, facing, 0.0, (720, 480))
    dressed = picture(meshes, plain, ahead, (720, 480), look).cpu().numpy()
    points = draw_points(result.scan, ahead, (720, 480))
    pictures = ScanPictures(points, dressed, views(shaded, 4), views(plain, 6))
    write_whole(result.folder / "overlay.png", encoded(np.concatenate([points, dressed], 1), ".png"))
    write_whole(result.folder / "turntable.png", encoded(np.concatenate(pictures.turntable, 1), ".png"))
    return pictures


def draw_points(scan: Scan, camera: Camera, size: tuple[int, int]) -> Picture:
    """(h, w, 3): the scan's points, the nearer ones over the others, unlabelled ones in grey."""
    colours = np.array([colour_of(name) for name in scan.names] + [UNSEEN])
    pixels = camera.project(scan.points.cpu()).round().long().numpy()
    depth = camera.to_camera(scan.points.cpu())[:, 2].numpy()
    dim = 1 - 0.35 * (depth - depth.min()) / max(float(np.ptp(depth)), 1e-6)
    image = np.full((*size, 3), 255, np.uint8)
    for k in np.argsort(-depth):
        x, y = pixels[k]
        image[max(y - 1, 0) : y + 1, max(x - 1, 0) : x + 1] = 255 * dim[k] * colours[int(scan.labels[k])]
    return image


def write_scan_report(result: FitResult, pictures: ScanPictures, config: Any) -> None:
    """Write ``report.html`` to the result's folder; ``config`` is the settings dataclass of the run."""
    figures = result.figures
    title = f"{', '.join(result.garments)} from {Path(config.scan).name}"
    body = figures["body"]
    said = f"Skin points lie {body['skin_mm']:.1f} mm from the body (median). " if "skin_mm" in body else ""
    said += f"{100 * body['cloth_inside']:.1f} % of the garments' scan points are inside the body."
    scale = f"Violet: on the scan; yellow: {1e3 * FULL:.0f} mm or more away from it; grey: not scanned."
    files = [
        ("result.json", "every figure"),
        ("distances.ply", "the garments with their distance to the scan: colour, and distance_mm per vertex"),
        ("distances.glb", "the same for any viewer"),
        ("overlay.png", "scan and fit side by side"),
    ]
    sections = [
        section("Scan and fit", row_of({"scan": pictures.scan, "body and garments": pictures.dressed})),
        section("Distances", strip(pictures.distances), scale),
        section("Around", strip(pictures.turntable)),
        section("Figures", figures_table(figures["garments"], TARGETS) + f"<p>{said}</p>"),
        *common_sections(result, config, files),
    ]
    write_page(result.folder / "report.html", title, sections, figures.get("notes", ()))
