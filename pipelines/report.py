"""``report.html``: one file, nothing loaded from elsewhere, that shows what a fit found; and the overlay picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pipelines.fit_garment import Layer
from pipelines.fit_result import FitResult
from pipelines.page import (
    PATTERN_NOTE,
    Picture,
    encoded,
    figures_table,
    files_list,
    flat,
    image,
    section,
    strip,
    table,
    write_page,
)
from recon.files.atomic import write_whole
from recon.files.patterns import pattern_svg

LONGEST = 1000
"""Longer side of photos in the report [px]."""
SHADED = 720
"""The same of the shaded picture beside them, whose cost grows with its pixels."""

Colour = tuple[float, float, float]

COLOURS = {
    "body": (0.80, 0.66, 0.57),
    "top": (0.36, 0.53, 0.76),
    "jacket": (0.33, 0.56, 0.45),
    "trousers": (0.42, 0.42, 0.50),
    "skirt": (0.78, 0.42, 0.52),
    "dress": (0.72, 0.45, 0.70),
}
"""sRGB colours of body and garments in scenes and pictures; other names share a neutral one."""
OTHER = (0.82, 0.60, 0.35)


def colour_of(name: str) -> tuple[float, float, float]:
    """The colour of a body or garment in scenes and pictures."""
    aliases = {"tshirt": "top", "shirt": "top", "tank": "top", "shorts": "trousers"}
    return COLOURS.get(aliases.get(name, name), OTHER)


@dataclass(frozen=True)
class Pictures:
    """What the report shows: (h, w, 3) uint8 RGB each."""

    photo: Picture
    overlay: Picture
    """The photo under the garments' colours, their borders, and the borders of their masks in white."""
    dressed: Picture
    """Body and garments from the photo's camera, over the faded photo."""
    turntable: tuple[Picture, ...]
    """Body and garments from around, the first from the front."""


def write_pictures(result: FitResult) -> Pictures:
    """Draw the fit, and write ``overlay.png`` (in the photo's size) and ``turntable.png`` to the result's folder."""
    from recon.render.labels import LabelRenderer
    from recon.render.shade import Look, picture, turntable

    shown, camera = result.photo, result.camera
    assert shown is not None and camera is not None, "a photo's fit has both"
    photo = shown.rgb.cpu().numpy()
    meshes = [result.body, *result.garments.values()]
    colours: list[Colour] = [colour_of(name) for name in ("body", *result.garments)]
    shade: list[Colour | Tensor] = [*colours]
    renderer = LabelRenderer(
        [mesh.faces for mesh in meshes], [None, *range(len(meshes) - 1)], [len(mesh.vertices) for mesh in meshes]
    )
    cover = renderer([mesh.vertices for mesh in meshes], camera, photo.shape[:2]).cpu().numpy()
    masks = [shown.garments[name].cpu().numpy() for name in result.garments]
    overlay = draw_overlay(photo, cover, masks, colours[1:])
    small = _smaller(photo, SHADED)
    look = Look(samples=4, sky_rays=4)
    seen = picture(meshes, shade, camera, small.shape[:2], replace(look, background=None)).cpu().numpy()
    around = tuple(view.cpu().numpy() for view in turntable(meshes, shade, 6, (480, 320), look))
    write_whole(result.folder / "overlay.png", encoded(overlay, ".png"))
    write_whole(result.folder / "turntable.png", encoded(np.concatenate(around, axis=1), ".png"))
    return Pictures(_smaller(photo), _smaller(overlay), _over(seen, small), around)


def draw_overlay(
    photo: Picture, cover: NDArray[np.float32], masks: Sequence[NDArray[np.bool_]], colours: Sequence[Colour]
) -> Picture:
    """The photo (h, w, 3) tinted where layers (cover (L, h, w)) lie, their borders, and those of the masks in white."""
    drawn = photo.astype(np.float32)
    thick = max(1, round(max(photo.shape[:2]) / 450))
    for layer, colour in zip(cover, colours):
        tint = 255.0 * np.array(colour, np.float32)
        drawn += 0.5 * layer[..., None] * (tint - drawn)
    out = np.clip(np.round(drawn), 0, 255).astype(np.uint8)
    for mask in masks:
        cv2.drawContours(out, _contours(mask), -1, (255, 255, 255), thick, cv2.LINE_AA)
    for layer, colour in zip(cover, colours):
        strong = tuple(int(165 * channel) for channel in colour)
        cv2.drawContours(out, _contours(layer > 0.5), -1, strong, thick, cv2.LINE_AA)
    return out


def _contours(mask: NDArray[np.bool_]) -> Sequence[Any]:
    return cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]


def _smaller(picture: Picture, longest: int = LONGEST) -> Picture:
    """The picture with its longer side at most ``longest``."""
    scale = longest / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _over(front: NDArray[np.uint8], photo: Picture) -> Picture:
    """An RGBA picture over the photo faded towards white."""
    alpha = front[..., 3:].astype(np.float32) / 255.0
    faded = 0.4 * photo + 0.6 * 255.0
    return np.round(alpha * front[..., :3] + (1.0 - alpha) * faded).astype(np.uint8)


TARGETS: dict[str, tuple[str, str, float | None, bool]] = {
    "iou": ("overlap with its mask (IoU)", "{:.3f}", 0.92, True),
    "iou_code_only": ("the same before refinement", "{:.3f}", 0.85, True),
    "penetrating_vertices": ("vertices inside the body", "{}", 0, False),
    "penetrating_faces": ("faces inside the body", "{}", 0, False),
    "self_intersections": ("self-intersections (pairs of faces)", "{}", 0, False),
    "stretch_p95": ("stretch, 95th percentile", "{:.3f}", 1.10, False),
    "vertices": ("vertices", "{}", None, True),
    "faces": ("faces", "{}", None, True),
    "mask_confidence": ("confidence in its mask", "{:.2f}", None, True),
}
"""Figure -> what to call it, its format, what it should be at least (True) or at most (False)."""


NO_PATTERN = (
    "decoded from a distance field (--decoder udf), which knows a surface but no panels that it could be cut from; "
    "with --decoder isp there are patterns."
)


def write_report(result: FitResult, pictures: Pictures, config: Any) -> None:
    """Write ``report.html`` to the result's folder; ``config`` is the settings dataclass of the run."""
    figures = result.figures
    title = f"{', '.join(result.garments)} from {Path(config.photo).name}"
    shown = {
        "photo": pictures.photo,
        "garments over the photo": pictures.overlay,
        "body and garments": pictures.dressed,
    }
    whole = f"<p>Body and garments together against the person's mask: IoU {figures['body']['iou']:.3f}.</p>"
    sections = [
        section("Photo and fit", row_of(shown), "White: the masks. Coloured: the garments found."),
        section("Around", strip(pictures.turntable)),
        section("Figures", figures_table(figures["garments"], TARGETS) + whole),
        *common_sections(result, config, [("result.json", "every figure"), ("overlay.png", "garments over the photo")]),
    ]
    write_page(result.folder / "report.html", title, sections, figures.get("notes", ()))


def mesh_files(layers: Sequence[Layer]) -> list[tuple[str, str]]:
    """(path, what it is) of the meshes and patterns that every fit writes."""
    files = [("scene.glb", "body and garments, named and coloured"), ("body.obj", "the body")]
    for layer in layers:
        uv = "texture coordinates = pattern in metres" if layer.garment.has_panels else "without texture coordinates"
        files.append((f"{layer.name}.obj", f"{layer.name}: welded, in metres, {uv}"))
    cut = [layer.name for layer in layers if layer.garment.has_panels]
    return files + [(f"patterns/{name}.svg", f"{name}: the pieces at true scale") for name in cut]


def common_sections(result: FitResult, config: Any, files: Sequence[tuple[str, str]]) -> list[str]:
    """Sewing patterns, files, times, settings and versions: the end of every report."""
    figures = result.figures
    cut = [layer for layer in result.layers if layer.garment.has_panels]
    bare = [layer.name for layer in result.layers if not layer.garment.has_panels]
    drawn = "".join(f"<figure>{pattern_svg(layer.garment, layer.name)}</figure>" for layer in cut)
    return [
        *([section("Sewing patterns", drawn, PATTERN_NOTE)] if cut else []),
        *([section("No sewing patterns", f"<p>{', '.join(bare)}: {NO_PATTERN}</p>")] if bare else []),
        section("Files", files_list([*mesh_files(result.layers), *files])),
        section("Time", table([(k, f"{v:.1f} s") for k, v in figures["seconds"].items()])),
        section("Settings", table(flat(config)), closed=True),
        section("Versions", table(figures["versions"].items()), closed=True),
    ]


def row_of(pictures: Mapping[str, Picture]) -> str:
    """Pictures side by side, each with its name below."""
    cells = (f"<figure>{image(at, name)}<figcaption>{name}</figcaption></figure>" for name, at in pictures.items())
    return f"<div class=row>{''.join(cells)}</div>"
