"""Sewing patterns back from SVG: the cut lines that ``write_svg`` drew, as any vector program saved them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from recon.types import TWO_PANELS, UserError, behind

MM_PER_INCH = 25.4
CHORD = 1.5
"""Curves are cut into chords of about this length [mm]."""
OPEN = 0.5
"""An outline whose ends are further apart than this is open [mm]."""
LARGEST, SMALLEST = 3000.0, 100.0
"""A pattern's extent [mm]; outside of this the file is of other units."""


def read_svg(path: str | Path, names: Sequence[str] = TWO_PANELS) -> list[list[NDArray[np.float64]]]:
    """The cut lines of an edited pattern: closed loops (N, 2) of each panel, panel coordinates [m].

    Curves, transforms and relative paths are understood. What counts are the paths called ``cut-front...``,
    ``cut-back...`` and so on for each of the panels' ``names``; seams, texts and marks may stay as they were. The last
    point of a loop joins the first.

    Raises:
        UserError: missing, no SVG, no physical size, a missing panel, an open outline, outlines that cross, or a
            pattern of no one's size.
    """
    path = Path(path)
    svg, origins = _parse(path)
    found: dict[str, list[NDArray[np.float64]]] = {name.replace("_", "-"): [] for name in names}
    for element in svg.elements():
        match = re.match(rf"cut-({'|'.join(found)})\b", str(getattr(element, "id", None) or ""))
        if match is None or not hasattr(element, "as_subpaths"):
            continue
        panel = match[1]
        origin = origins.get(str(element.id))
        if origin is None:
            raise UserError(f"{path}: {element.id} lost its group's data-origin; edit a file of recon decode --pattern")
        loops = [_loop(path, panel, sub) for sub in element.as_subpaths()]
        mirror = np.array([-1.0 if behind(panel.replace("-", "_")) else 1.0, -1.0])
        found[panel] += [(loop - origin) * mirror / 1000.0 for loop in loops]
    for panel, loops in found.items():
        _check(path, panel, loops, len(found))
    return list(found.values())


def _parse(path: Path):
    """The document in millimetres, and the origin (2,) [mm] of each cut path by its id."""
    import svgelements

    wanted = "wanted an SVG pattern of recon decode --pattern"
    try:
        root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: can't be read ({error.strerror}); {wanted}") from None
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: no SVG ({error}); {wanted}") from None
    if root.tag.rpartition("}")[2] != "svg":
        raise UserError(f"{path}: a <{root.tag.rpartition('}')[2]}> file; {wanted}")
    width = root.get("width", "")
    if not re.fullmatch(r"\s*[\d.]+\s*(mm|cm|in|pt|pc)\s*", width):
        raise UserError(
            f"{path}: its width is {width or 'missing'}; wanted a size in mm: save the document in millimetres"
        )
    origins: dict[str, NDArray[np.float64]] = {}
    for group in root.iter():
        origin = group.get("data-origin", "")
        for child in group.iter() if origin else ():
            if (child.get("id") or "").startswith("cut-"):
                origins[str(child.get("id"))] = np.array([float(v) for v in origin.split()])
    try:
        return svgelements.SVG.parse(str(path), ppi=MM_PER_INCH), origins
    except Exception as error:  # whatever a parser raises on a broken file is the file's fault
        raise UserError(f"{path}: cannot be read as SVG ({type(error).__name__}); {wanted}") from None


def _loop(path: Path, panel: str, sub) -> NDArray[np.float64]:
    """(N, 2) one closed outline [mm]."""
    import svgelements

    points: list[tuple[float, float]] = []
    for segment in svgelements.Path(sub):
        if isinstance(segment, (svgelements.Move, svgelements.Line, svgelements.Close)):
            if segment.end is not None:
                points.append((segment.end.x, segment.end.y))
            continue
        count = max(2, int(np.ceil(segment.length(error=1e-3) / CHORD)))
        points += [(p.x, p.y) for p in (segment.point(k / count) for k in range(1, count + 1))]
    loop = np.array(points, float).reshape(-1, 2)
    if len(loop) < 3:
        raise UserError(f"{path}: the {panel} panel has an outline of {len(loop)} points; wanted at least 3")
    gap = float(np.linalg.norm(loop[0] - loop[-1]))
    closed = any(isinstance(s, svgelements.Close) for s in svgelements.Path(sub))
    if not closed and gap > OPEN:
        x, y = loop[-1]
        raise UserError(f"{path}: the {panel} panel's outline is open by {gap:.1f} mm at {x:.0f}, {y:.0f} mm; close it")
    steps = np.linalg.norm(loop - np.roll(loop, 1, 0), axis=1)
    return loop[steps > 1e-4]


def _check(path: Path, panel: str, loops: list[NDArray[np.float64]], count: int) -> None:
    if not loops:
        wanted = "both panels" if count == 2 else f"all {count} panels"
        raise UserError(f"{path}: no path called cut-{panel}...; wanted the outline of {wanted}")
    size = 1000 * float(np.ptp(np.concatenate(loops), axis=0).max())
    if not SMALLEST < size < LARGEST:
        raise UserError(f"{path}: the {panel} panel is {size:.0f} mm across; wanted true scale, 1 unit = 1 mm")
    place = crossing(loops)
    if place is not None:
        x, y = place * 100
        raise UserError(f"{path}: the {panel} panel's outline crosses itself at x {x:.1f}, y {y:.1f} cm of the panel")


def crossing(loops: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """A point (2,) where closed outlines (N, 2) cross each other or themselves; None where they don't."""
    a = np.concatenate(loops)
    b = np.concatenate([np.roll(loop, -1, 0) for loop in loops])
    d = b - a
    for i in range(len(a)):
        e, f = a - a[i], b - a[i]
        mine = np.sign(d[i, 0] * e[:, 1] - d[i, 1] * e[:, 0]) * np.sign(d[i, 0] * f[:, 1] - d[i, 1] * f[:, 0])
        u, v = a[i] - a, b[i] - a
        theirs = np.sign(d[:, 0] * u[:, 1] - d[:, 1] * u[:, 0]) * np.sign(d[:, 0] * v[:, 1] - d[:, 1] * v[:, 0])
        both = (mine < 0) & (theirs < 0)
        if both.any():
            return 0.5 * (a[i] + b[i])
    return None
