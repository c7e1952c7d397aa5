"""Sewing patterns on disk: a garment's panels as an SVG at true scale in millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from recon.files.atomic import write_whole
from recon.types import Garment, behind

MARGIN = 40.0
"""White around the pieces [mm]."""

_STYLE = """
.pattern .cut { fill: #fbf7ef; stroke: #1c1c1c; stroke-linejoin: round; fill-rule: evenodd }
.pattern .seam { fill: none; stroke: #b3361b; stroke-linecap: round }
.pattern .open { fill: none; stroke: #1c5d99; stroke-linecap: butt }
.pattern .grain, .pattern .notch, .pattern .scale { fill: none; stroke: #1c1c1c }
.pattern text { font-family: Helvetica, Arial, sans-serif; fill: #1c1c1c }
.pattern .of-seam { fill: #b3361b }
.pattern .of-open { fill: #1c5d99 }
.pattern .name { font-weight: bold }
"""


@dataclass(frozen=True)
class Run:
    """A stretch of a piece's border with one meaning: one seam, or one open edge."""

    label: int
    """Index into the garment's ``seam_names``; 0 = open edge."""
    points: NDArray[np.float64]
    """(N, 2) from end to end [mm], page axes (y down); first = last where the whole loop is one run."""
    vertices: frozenset[int]
    """Welded vertices along it: the runs of one seam on both panels have the same."""

    @property
    def length(self) -> float:
        """Arc length [mm]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True)
class Piece:
    """One piece of cloth to cut, in its place on the page."""

    name: str
    loops: list[NDArray[np.float64]]
    """Closed outlines (N, 2) [mm], page axes: the outer one and holes; the last point joins the first."""
    runs: list[Run]
    """What each stretch of the outlines is."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Where the panel coordinates' origin lies on the page [mm]."""

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner [mm]."""
        points = np.concatenate(self.loops)
        return points.min(0), points.max(0)


def write_svg(garment: Garment, path: str | Path, name: str = "") -> None:
    """Write the garment's panels at true scale: cut lines, numbered seams with lengths, grain lines, names, scale bar.

    One unit of the drawing is one millimetre on paper. Panels are drawn side by side as seen from outside, the
    front first; no seam allowance. ``name`` defaults to the file's stem. NaN or infinite coordinates are a ValueError.
    """
    path = Path(path)
    write_whole(path, pattern_svg(garment, name or path.stem))


def pattern_svg(garment: Garment, name: str) -> str:
    """The text of the SVG that ``write_svg`` writes."""
    points = garment.panel_points.detach().cpu().double()
    if not np.isfinite(points.numpy()).all():
        raise ValueError(f"{name}: panel coordinates are NaN or infinite; nothing was written")
    pieces, (width, height) = _lay_out([cut_pieces(garment, panel) for panel in range(len(garment.panel_names))])
    size = float(np.clip(0.011 * width, 8.0, 26.0))
    numbers = _seam_numbers(pieces)
    height += 3.5 * size
    body = [_draw(piece, garment.seam_names, numbers, size) for piece in pieces]
    body.append(_foot(" · ".join(dict.fromkeys([name, garment.variant or garment.kind])), height, size))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="pattern" width="{width:.2f}mm" height="{height:.2f}mm" '
        f'viewBox="0 0 {width:.2f} {height:.2f}">\n<title>{escape(name)}</title>\n<style>{_STYLE}</style>\n'
        f'<rect width="100%" height="100%" fill="#ffffff"/>\n' + "\n".join(body) + "\n</svg>\n"
    )


def _seam_numbers(pieces: list[Piece]) -> dict[tuple[int, frozenset[int]], int]:
    """(label, vertices) of each sewn run -> the number of its seam: runs that share most vertices share it."""
    numbers: dict[tuple[int, frozenset[int]], int] = {}
    for run in (run for piece in pieces for run in piece.runs if run.label > 0):
        shared = {key: len(key[1] & run.vertices) for key in numbers if key[0] == run.label}
        partner = max(shared, key=lambda key: shared[key], default=None)
        if partner is None or 2 * shared[partner] <= min(len(partner[1]), len(run.vertices)):
            numbers[run.label, run.vertices] = max(numbers.values(), default=0) + 1
        else:
            numbers[run.label, run.vertices] = numbers[partner]
    return numbers


def _foot(title: str, height: float, size: float) -> str:
    """A bar of 100 mm to check the print by, and what the sheet is."""
    y, tick = height - size, size / 3
    bar = f"M{MARGIN} {y:.1f}h100m0 {-tick:.1f}v{2 * tick:.1f}m-100 0v{-2 * tick:.1f}"
    text = f"100 mm · {title} · 1:1 in mm · seen from outside · no seam allowance"
    return (
        f'<path class="scale" stroke-width="{size / 14:.2f}" d="{bar}"/>'
        f'<text x="{MARGIN + 100 + size:.1f}" y="{y + tick:.1f}" font-size="{size:.1f}">{escape(text)}</text>'
    )


def cut_pieces(garment: Garment, panel: int) -> list[Piece]:
    """The connected pieces of one panel, from the wearer's right to the left, in millimetres.

    Page axes: y down, x to the wearer's left for the front and mirrored for the back, as each is seen from outside.
    """
    title = garment.panel_names[panel]
    mirror = np.array([-1.0 if behind(title) else 1.0, -1.0])
    points = garment.panel_points.detach().cpu().double().numpy() * 1000.0 * mirror
    faces = garment.panel_faces.cpu().numpy()
    of_face = garment.panel_of_face.cpu().numpy()
    vertex = garment.vertex_of_point.cpu().numpy()
    labels = garment.border_labels.cpu().numpy()
    across = {frozenset(edge) for edge in vertex[_border(faces[of_face != panel])].tolist()}
    pieces: dict[int, list[NDArray[np.int64]]] = {}
    own = faces[of_face == panel]
    component = _components(own, len(points))
    for loop in _loops(_border(own)):
        pieces.setdefault(int(component[loop[0]]), []).append(loop)
    ordered = sorted(pieces.values(), key=lambda loops: float(points[np.concatenate(loops), 0].mean()))
    made = []
    for k, loops in enumerate(ordered):
        runs = [run for loop in loops for run in _runs(loop, points, labels, vertex, across)]
        side = "" if len(ordered) == 1 else f" {k + 1} of {len(ordered)}"
        made.append(Piece(title.replace("_", " ") + side, [points[loop] for loop in loops], runs))
    return made


def _border(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """(E, 2) directed edges that only one face has."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, which, count = np.unique(np.sort(edges, 1), axis=0, return_inverse=True, return_counts=True)
    return edges[count[which.ravel()] == 1]


def _components(faces: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """(n,) number of the connected piece that each point belongs to."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _loops(edges: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Directed border edges chained to closed loops; a point that several loops pass is passed by each."""
    following: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        start = next(iter(following))
        loop, at = [start], start
        while at in following:
            ahead = following[at].pop()
            if not following[at]:
                del following[at]
            if ahead == start:
                break
            loop.append(ahead)
            at = ahead
        if len(loop) > 2:
            loops.append(np.array(loop))
    return loops


def _runs(
    loop: NDArray[np.int64],
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    vertex: NDArray[np.int64],
    across: set[frozenset[int]],
) -> list[Run]:
    """The loop cut where its meaning changes.

    ``across``: welded border edges of the other panels; an edge is sewn where two panels have it. A seam's end point
    may carry either neighbour's label, so where two labels meet the edge takes that of the end which turns less: not
    the corner.
    """
    ahead = np.roll(loop, -1)
    place = points[loop]
    before, after = place - np.roll(place, 1, axis=0), np.roll(place, -1, axis=0) - place
    cosine = (before * after).sum(1) / np.maximum(np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-12)
    turn = dict(zip(loop.tolist(), np.arccos(np.clip(cosine, -1.0, 1.0)).tolist()))
    kinds = []
    for a, b in zip(loop.tolist(), ahead.tolist()):
        ends = sorted((int(labels[at]) for at in (a, b)), key=lambda label: label <= 0)
        if frozenset((int(vertex[a]), int(vertex[b]))) not in across:
            kinds.append(0)
        elif ends[1] <= 0 or ends[0] == ends[1]:
            kinds.append(max(ends[0], 0))
        else:
            kinds.append(int(labels[a if turn[a] < turn[b] else b]))
    starts = [i for i in range(len(kinds)) if kinds[i] != kinds[i - 1]] or [0]
    runs = []
    for k, start in enumerate(starts):
        stop = starts[(k + 1) % len(starts)]
        index = np.arange(start, stop + (len(loop) if stop <= start else 0) + 1) % len(loop)
        runs.append(Run(kinds[start], place[index], frozenset(vertex[loop[index]].tolist())))
    return runs


def _lay_out(panels: list[list[Piece]]) -> tuple[list[Piece], tuple[float, float]]:
    """All pieces moved to their places: panels side by side, top edges on one line; and the page's size [mm]."""
    placed: list[Piece] = []
    left, height = 2 * MARGIN, 0.0
    for pieces in (pieces for pieces in panels if pieces):
        low = np.min([piece.box[0] for piece in pieces], axis=0)
        high = np.max([piece.box[1] for piece in pieces], axis=0)
        shift = np.array([left, 2 * MARGIN]) - low
        for piece in pieces:
            runs = [Run(run.label, run.points + shift, run.vertices) for run in piece.runs]
            placed.append(Piece(piece.name, [loop + shift for loop in piece.loops], runs, (shift[0], shift[1])))
        left += float(high[0] - low[0]) + 3 * MARGIN
        height = max(height, float(high[1] - low[1]))
    return placed, (left - MARGIN, height + 4 * MARGIN)


def _draw(
    piece: Piece, seam_names: tuple[str, ...], numbers: dict[tuple[int, frozenset[int]], int], size: float
) -> str:
    """One piece as an SVG group; ``size`` is the text's height [mm]."""
    line = size / 12
    outline = " ".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in loop) + "Z" for loop in piece.loops)
    parts = [f'<path id="cut-{piece.name.replace(" ", "-")}" class="cut" stroke-width="{line:.2f}" d="{outline}"/>']
    for run in piece.runs:
        kind = "seam" if run.label > 0 else "open"
        course = "M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in run.points)
        dash = "" if run.label > 0 else f' stroke-dasharray="{0.6 * size:.1f} {0.3 * size:.1f}"'
        parts.append(f'<path class="{kind}" stroke-width="{2.2 * line:.2f}"{dash} d="{course}"/>')
        middle, outward = _middle(run, piece)
        text = f"{run.length:.0f} mm"
        if run.label > 0:
            text = f"{numbers[run.label, run.vertices]} {seam_names[run.label].replace('_', ' ')} · {text}"
            parts.append(_tick(middle, outward, size, line))
        parts.append(_label(text, middle, outward, size, kind))
    low, high = piece.box
    parts.append(_grain(piece, low, high, size, line))
    x, y = piece.origin
    return (
        f'<g class="piece" data-name="{escape(piece.name)}" data-origin="{x:.3f} {y:.3f}">\n'
        + "\n".join(parts)
        + "\n</g>"
    )


def _middle(run: Run, piece: Piece) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The point half way along the run, and the unit direction out of the piece there."""
    steps = np.linalg.norm(np.diff(run.points, axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    half = 0.5 * walked[-1]
    middle = np.array([np.interp(half, walked, run.points[:, k]) for k in (0, 1)])
    k = int(np.clip(np.searchsorted(walked, half) - 1, 0, len(steps) - 1))
    along = (run.points[k + 1] - run.points[k]) / max(float(steps[k]), 1e-9)
    normal = np.array([along[1], -along[0]])
    return middle, normal if not _contains(piece, middle + 1.5 * normal) else -normal


def _contains(piece: Piece, point: NDArray[np.float64]) -> bool:
    """Even-odd test of a point against the piece's outlines."""
    crossings = 0
    for loop in piece.loops:
        a, b = loop, np.roll(loop, -1, axis=0)
        spans = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = a[:, 0] + (point[1] - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
        crossings += int((spans & (x > point[0])).sum())
    return crossings % 2 == 1


def _tick(at: NDArray[np.float64], outward: NDArray[np.float64], size: float, line: float) -> str:
    """A notch across the cut line, where both sides of a seam meet half way."""
    (x0, y0), (x1, y1) = at - 0.5 * size * outward, at
    return f'<path class="notch" stroke-width="{1.5 * line:.2f}" d="M{x0:.2f} {y0:.2f}L{x1:.2f} {y1:.2f}"/>'


def _label(text: str, at: NDArray[np.float64], outward: NDArray[np.float64], size: float, kind: str) -> str:
    """Text along the border, just outside the piece, never upside down."""
    x, y = at + 0.85 * size * outward
    angle = np.degrees(np.arctan2(outward[0], -outward[1]))
    angle = (angle + 90.0) % 180.0 - 90.0
    return (
        f'<text class="of-{kind}" font-size="{0.8 * size:.1f}" text-anchor="middle" dy="0.35em" '
        f'transform="translate({x:.2f} {y:.2f}) rotate({angle:.1f})">{escape(text)}</text>'
    )


def _clear_row(piece: Piece, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[float, float, float]:
    """Where there is room for text: x and y of its start, and how far the piece reaches to the right of it [mm]."""
    best = (float(low[0]), float(0.5 * (low + high)[1]), 0.0)
    for share in (0.5, 0.4, 0.6, 0.3, 0.7):
        y = float(low[1] + share * (high - low)[1])
        xs = np.linspace(low[0], high[0], 61)
        inside = np.array([_contains(piece, np.array([x, y])) for x in xs] + [False])
        starts = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
        for start in starts.tolist():
            width = float(xs[1] - xs[0]) * int(np.argmin(inside[start:]) - 1)
            if 0.6 * width > 1.2 * best[2]:
                best = (float(xs[start]) + 0.4 * width, y, 0.6 * width)
    return best


def _grain(piece: Piece, low: NDArray[np.float64], high: NDArray[np.float64], size: float, line: float) -> str:
    """The grain line (upright on the wearer), the piece's name beside it."""
    x, middle, room = _clear_row(piece, low, high)
    half = 0.12 * float((high - low)[1])
    while half > 2 * size and not all(_contains(piece, np.array([x, middle + end])) for end in (-half, half)):
        half *= 0.9
    y0, y1 = middle - half, middle + half
    a = 0.35 * size
    arrow = (
        f"M{x:.2f} {y0:.2f}V{y1:.2f}M{x - a:.2f} {y0 + 2 * a:.2f}L{x:.2f} {y0:.2f}L{x + a:.2f} {y0 + 2 * a:.2f}"
        f"M{x - a:.2f} {y1 - 2 * a:.2f}L{x:.2f} {y1:.2f}L{x + a:.2f} {y1 - 2 * a:.2f}"
    )
    beside = x + size
    name = escape(piece.name)
    fitting = min(1.4 * size, room / (0.62 * len(piece.name)))
    return (
        f'<path class="grain" stroke-width="{line:.2f}" d="{arrow}"/>'
        f'<text class="name" x="{beside:.2f}" y="{middle:.2f}" font-size="{fitting:.1f}">{name}</text>'
        f'<text x="{beside:.2f}" y="{middle + 1.5 * size:.2f}" font-size="{size:.1f}">cut 1 · grain</text>'
    )
