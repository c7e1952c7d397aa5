"""One self-contained HTML page: sections, pictures within it, tables of figures and settings, files beside it."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.files.atomic import write_whole

Picture = NDArray[np.uint8]
Targets = Mapping[str, tuple[str, str, float | None, bool]]
"""Figure -> what to call it, its format, what it should be at least (True) or at most (False)."""

PATTERN_NOTE = (
    "Both sides of a seam bear the same number; the files in patterns/ are at true scale. Blue: open edges. "
    "A piece is what the cloth would be without stretch; add your own seam allowance."
)


def write_page(path: Path, title: str, sections: Sequence[str], notes: Sequence[str] = ()) -> None:
    """Write the page, whole or not at all."""
    said = "".join(f"<li>{escape(note)}</li>" for note in notes)
    page = _PAGE.format(
        title=escape(title),
        style=_STYLE,
        notes=f"<ul class=notes>{said}</ul>" if said else "",
        body="\n".join(sections),
    )
    write_whole(path, page)


def section(title: str, content: str, note: str = "", closed: bool = False) -> str:
    """A heading, what is said below it, and the content; ``closed``: folded away."""
    said = f"<p>{escape(note)}</p>" if note else ""
    if closed:
        return f"<details><summary><h2>{title}</h2></summary>{said}{content}</details>"
    return f"<section><h2>{title}</h2>{said}{content}</section>"


def image(picture: Picture, alt: str) -> str:
    """A picture within the page."""
    data = base64.b64encode(encoded(picture, ".jpg")).decode()
    h, w = picture.shape[:2]
    return f'<img src="data:image/jpeg;base64,{data}" width="{w}" height="{h}" alt="{escape(alt)}">'


def strip(views: Sequence[Picture]) -> str:
    """Views from around, side by side."""
    turn = 360 / max(len(views), 1)
    return (
        f"<div class=strip>{''.join(image(view, f'{round(k * turn)} degrees') for k, view in enumerate(views))}</div>"
    )


def figures_table(garments: Mapping[str, Mapping[str, Any]], targets: Targets) -> str:
    """A row a figure, a column a garment, and what was aimed at; misses are marked."""
    head = "".join(f"<th>{escape(name)}</th>" for name in garments)
    rows = []
    for key, (label, form, target, at_least) in targets.items():
        cells = "".join(_cell(found.get(key), form, target, at_least) for found in garments.values())
        wanted = "" if target is None else f"{'≥' if at_least else '≤'} {target}" if target else "0"
        rows.append(f"<tr><td>{label}</td>{cells}<td class=wanted>{wanted}</td></tr>")
    return f"<table><tr><th></th>{head}<th class=wanted>aim</th></tr>{''.join(rows)}</table>"


def _cell(value: float | None, form: str, target: float | None, at_least: bool) -> str:
    """A table cell, marked where it misses its aim."""
    if value is None:
        return "<td>–</td>"
    missed = target is not None and (value < target if at_least else value > target)
    return f"<td{' class=missed' if missed else ''}>{form.format(value)}</td>"


def files_list(files: Sequence[tuple[str, str]]) -> str:
    """(path, what it is) of files beside the page."""
    return "<ul>" + "".join(f'<li><a href="{at}">{at}</a> {escape(what)}</li>' for at, what in files) + "</ul>"


def table(rows: Any) -> str:
    """(name, value) pairs."""
    cells = "".join(f"<tr><td>{escape(str(key))}</td><td>{escape(str(value))}</td></tr>" for key, value in rows)
    return f"<table>{cells}</table>"


def flat(config: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """(dotted name, value) of every field of nested settings."""
    rows: list[tuple[str, Any]] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            rows += flat(value, f"{prefix}{field.name}.")
        else:
            rows.append((prefix + field.name, ", ".join(map(str, value)) if isinstance(value, tuple) else value))
    return rows


def encoded(picture: Picture, kind: str) -> bytes:
    """The picture's file content; ``kind``: .png or .jpg."""
    done, data = cv2.imencode(kind, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88] if kind == ".jpg" else [])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} could not be encoded as {kind}")
    return data.tobytes()


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
