"""``report.html``: one file, nothing loaded from elsewhere, that shows what a fit found; and the overlay picture."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pipelines.fit_result import FitResult
from recon.files.atomic import write_whole
from recon.files.patterns import pattern_svg

LONGEST = 1000
"""Longer side of photos in the report [px]."""
SHADED = 720
"""The same of the shaded picture beside them, whose cost grows with its pixels."""

Picture = NDArray[np.uint8]
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

    photo = result.photo.rgb.cpu().numpy()
    meshes = [result.body, *result.garments.values()]
    colours: list[Colour] = [colour_of(name) for name in ("body", *result.garments)]
    shade: list[Colour | Tensor] = [*colours]
    renderer = LabelRenderer(
        [mesh.faces for mesh in meshes], [None, *range(len(meshes) - 1)], [len(mesh.vertices) for mesh in meshes]
    )
    cover = renderer([mesh.vertices for mesh in meshes], result.camera, photo.shape[:2]).cpu().numpy()
    masks = [result.photo.garments[name].cpu().numpy() for name in result.garments]
    overlay = draw_overlay(photo, cover, masks, colours[1:])
    small = _smaller(photo, SHADED)
    look = Look(samples=4, sky_rays=4)
    seen = picture(meshes, shade, result.camera, small.shape[:2], replace(look, background=None)).cpu().numpy()
    around = tuple(view.cpu().numpy() for view in turntable(meshes, shade, 6, (480, 320), look))
    write_whole(result.folder / "overlay.png", _encoded(overlay, ".png"))
    write_whole(result.folder / "turntable.png", _encoded(np.concatenate(around, axis=1), ".png"))
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


def _encoded(picture: Picture, kind: str) -> bytes:
    """The picture's file content; ``kind``: .png or .jpg."""
    done, data = cv2.imencode(kind, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88] if kind == ".jpg" else [])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} could not be encoded as {kind}")
    return data.tobytes()


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


def write_report(result: FitResult, pictures: Pictures, config: Any) -> None:
    """Write ``report.html`` to the result's folder; ``config`` is the settings dataclass of the run."""
    figures = result.figures
    names = list(result.garments)
    title = f"{', '.join(names)} from {Path(config.photo).name}"
    patterns = {layer.name: pattern_svg(layer.garment, layer.name) for layer in result.layers}
    sections = [
        _section("Photo and fit", _pictures(pictures), "White: the masks. Coloured: the garments found."),
        _section("Around", _strip(pictures.turntable)),
        _section("Figures", _figures(figures)),
        _section("Sewing patterns", "".join(f"<figure>{svg}</figure>" for svg in patterns.values()), _PATTERN_NOTE),
        _section("Files", _files(names)),
        _section("Time", _table([(k, f"{v:.1f} s") for k, v in figures["seconds"].items()])),
        _section("Settings", _table(_flat(config)), closed=True),
        _section("Versions", _table(figures["versions"].items()), closed=True),
    ]
    notes = "".join(f"<li>{escape(note)}</li>" for note in figures.get("notes", ()))
    page = _PAGE.format(
        title=escape(title),
        style=_STYLE,
        notes=f"<ul class=notes>{notes}</ul>" if notes else "",
        body="\n".join(sections),
    )
    write_whole(result.folder / "report.html", page)


def _section(title: str, content: str, note: str = "", closed: bool = False) -> str:
    said = f"<p>{escape(note)}</p>" if note else ""
    if closed:
        return f"<details><summary><h2>{title}</h2></summary>{said}{content}</details>"
    return f"<section><h2>{title}</h2>{said}{content}</section>"


def _image(picture: Picture, alt: str) -> str:
    data = base64.b64encode(_encoded(picture, ".jpg")).decode()
    h, w = picture.shape[:2]
    return f'<img src="data:image/jpeg;base64,{data}" width="{w}" height="{h}" alt="{escape(alt)}">'


def _pictures(pictures: Pictures) -> str:
    shown = {
        "photo": pictures.photo,
        "garments over the photo": pictures.overlay,
        "body and garments": pictures.dressed,
    }
    cells = (f"<figure>{_image(at, name)}<figcaption>{name}</figcaption></figure>" for name, at in shown.items())
    return f"<div class=row>{''.join(cells)}</div>"


def _strip(views: Sequence[Picture]) -> str:
    turn = 360 / max(len(views), 1)
    return (
        f"<div class=strip>{''.join(_image(view, f'{round(k * turn)} degrees') for k, view in enumerate(views))}</div>"
    )


def _figures(figures: Mapping[str, Any]) -> str:
    garments = figures["garments"]
    head = "".join(f"<th>{escape(name)}</th>" for name in garments)
    rows = []
    for key, (label, form, target, at_least) in TARGETS.items():
        cells = "".join(_figure(found.get(key), form, target, at_least) for found in garments.values())
        wanted = "" if target is None else f"{'≥' if at_least else '≤'} {target}" if target else "0"
        rows.append(f"<tr><td>{label}</td>{cells}<td class=wanted>{wanted}</td></tr>")
    body = f"<p>Body and garments together against the person's mask: IoU {figures['body']['iou']:.3f}.</p>"
    return f"<table><tr><th></th>{head}<th class=wanted>aim</th></tr>{''.join(rows)}</table>{body}"


def _figure(value: float | None, form: str, target: float | None, at_least: bool) -> str:
    """A table cell, marked where it misses its aim."""
    if value is None:
        return "<td>–</td>"
    missed = target is not None and (value < target if at_least else value > target)
    return f"<td{' class=missed' if missed else ''}>{form.format(value)}</td>"


def _files(names: Sequence[str]) -> str:
    files = [("scene.glb", "body and garments, named and coloured"), ("body.obj", "the body")]
    files += [(f"{name}.obj", f"{name}: welded, in metres, texture coordinates = pattern in metres") for name in names]
    files += [(f"patterns/{name}.svg", f"{name}: the pieces at true scale") for name in names]
    files += [("result.json", "every figure"), ("overlay.png", "garments over the photo")]
    return "<ul>" + "".join(f'<li><a href="{at}">{at}</a> {escape(what)}</li>' for at, what in files) + "</ul>"


def _table(rows: Any) -> str:
    cells = "".join(f"<tr><td>{escape(str(key))}</td><td>{escape(str(value))}</td></tr>" for key, value in rows)
    return f"<table>{cells}</table>"


def _flat(config: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """(dotted name, value) of every field of nested settings."""
    rows: list[tuple[str, Any]] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            rows += _flat(value, f"{prefix}{field.name}.")
        else:
            rows.append((prefix + field.name, ", ".join(map(str, value)) if isinstance(value, tuple) else value))
    return rows


_PATTERN_NOTE = (
    "Both sides of a seam bear the same number; the files in patterns/ are at true scale. Blue: open edges. "
    "A piece is what the cloth would be without stretch; add your own seam allowance."
)

_STYLE = """
:root { color-scheme: light dark; --ink: #1d1d1f; --dim: #6b6b70; --paper: #ffffff; --line: #e2e2e6; --bad: #b3361b }
@media (prefers-color-scheme: dark) {
  :root { --ink: #ececf0; --dim: #9a9aa2; --paper: #17171a; --line: #34343a; --bad: #ff8f73 }
}
body { margin: 2rem auto; max-width: 72rem; padding: 0 1.2rem; font: 15px/1.5 system-ui, Helvetica, Arial, sans-serif;
  color: var(--ink); background: var(--paper) }
h1 { font-size: 1.6rem; margin: 0 0 .5rem } h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem; display: inline-block }
p, figcaption { color: var(--dim); margin: .2rem 0 .6rem }
.row img, .strip img { width: 100% }
img, svg { max-width: 100%; height: auto; border-radius: 4px }
figure { margin: 0 } figure svg { border: 1px solid var(--line); margin-bottom: .8rem }
.row { display: grid; grid-template-columns: repeat(3, 1fr); gap: .8rem }
.strip { display: grid; grid-template-columns: repeat(6, 1fr); gap: .4rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
td, th { padding: .25rem 1.2rem .25rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top }
.wanted { color: var(--dim); font-weight: normal } .missed { color: var(--bad); font-weight: 600 }
.notes { padding: .6rem 1rem .6rem 2rem; border-left: 4px solid var(--bad); background: color-mix(in srgb, var(--bad)
8%, transparent) } summary { cursor: pointer } a { color: inherit } @media (max-width: 40rem) { .row {
grid-template-columns: 1fr } .strip { grid-template-columns: repeat(3, 1fr) } } @media print { body { margin: 0;
max-width: none } section { break-inside: avoid } details:not([open]) { display: none } }
"""

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
<h1>{title}</h1>
{notes}
{body}
</html>
"""
