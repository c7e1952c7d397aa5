"""The cuts themselves: outlines of tops, skirts, trousers and dresses from named sizes.

An outline is the border of a panel in the frontal plane of the T-posed body: x to the wearer's left,
y up, metres. Left and right are mirror images, so only the left half is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from recon.garments.patterns_mesh import Edge

Outline = dict[str, list[list[Edge]]]
"""Panel name ("front" ...) -> its pieces (two where the front is cut open) -> their border, counter-clockwise."""


def bezier(*points: NDArray | Sequence[float], count: int = 33) -> NDArray:
    """(count, 2) points on the Bézier curve of these control points."""
    t = np.linspace(0, 1, count)[:, None]
    level = [np.broadcast_to(np.asarray(p, float), (count, 2)) for p in points]
    while len(level) > 1:
        level = [(1 - t) * a + t * b for a, b in zip(level, level[1:])]
    return level[0]


def through(points: list[NDArray], axis: int, count: int = 49) -> NDArray:
    """(count, 2) smooth curve through points that are monotone along ``axis`` (shape-preserving cubic)."""
    p = np.stack(points)
    order = np.argsort(p[:, axis])
    curve = PchipInterpolator(p[order, axis], p[order, 1 - axis])
    at = np.linspace(p[0, axis], p[-1, axis], count)
    out = np.empty((count, 2))
    out[:, axis], out[:, 1 - axis] = at, curve(at)
    return out


def mirrored(edges: list[Edge]) -> list[Edge]:
    """The same edges on the wearer's right, in the order that keeps the loop counter-clockwise."""

    def swap(name: str) -> str:
        return name.replace("_left", "_right")

    return [Edge(swap(e.label), (e.line * [-1, 1])[::-1], e.held) for e in edges[::-1]]


def bodice(p: dict[str, float]) -> Outline:
    """Top or dress: neck, shoulder, sleeve or armhole, side and hem.

    The left half runs counter-clockwise: hem -> side -> underarm -> cuff -> shoulder -> neck.
    """
    out: Outline = {}
    neck = np.array([p["neck_x"], p["neck_y"]])
    side = bodice_side(p)
    armpit = side[-1]
    for panel in ("front", "back"):
        depth = p[f"neck_depth_{panel}"]
        v = p["neck_v"] if panel == "front" else 0.0
        edges = [Edge("side_left", side)] + _sleeve(p, neck, armpit)
        centre = np.array([0.0, neck[1] - depth])
        gap = p.get("opening", 0.0) / 2 if panel == "front" else 0.0
        hem = _hem(p, side[0])
        line = _neckline(neck, centre, v)
        if gap:
            out[panel] = _cut_open(edges, line, hem, gap)
        else:
            whole = np.concatenate([line, (line * [-1, 1])[::-1][1:]])
            bottom = np.concatenate([(hem * [-1, 1])[::-1], hem[1:]])
            out[panel] = [[Edge("open", bottom), *edges, Edge("open", whole), *mirrored(edges)]]
    return out


def set_in(p: dict[str, float]) -> Outline:
    """Six-panel shirt (ISP appendix C): the bodice cut along its armholes, sleeves of a front and a back each.

    Both sides of an armhole are the same curve in the plane, as seams of front and back are; the front's is deeper.
    """
    neck = np.array([p["neck_x"], p["neck_y"]])
    side = bodice_side(p)
    under, cuff, over = _sleeve(p, neck, side[-1])
    tip = int(np.argmin(np.abs(over.line[:, 0] - p["shoulder_x"])))
    hem = _hem(p, side[0])
    bottom = np.concatenate([(hem * [-1, 1])[::-1], hem[1:]])
    out: Outline = {}
    for panel in ("front", "back"):
        armhole = _armhole(side[-1], over.line[tip], p[f"armhole_{panel}"])
        edges = [
            Edge("side_left", side),
            Edge(f"armhole_{panel}_left", armhole),
            Edge("shoulder_left", over.line[tip:]),
        ]
        line = _neckline(neck, np.array([0.0, neck[1] - p[f"neck_depth_{panel}"]]), p["neck_v"] * (panel == "front"))
        whole = np.concatenate([line, (line * [-1, 1])[::-1][1:]])
        out[panel] = [[Edge("open", bottom), *edges, Edge("open", whole), *mirrored(edges)]]
        sleeve = [
            under,
            cuff,
            Edge("sleeve_over_left", over.line[: tip + 1]),
            Edge(f"armhole_{panel}_left", armhole[::-1]),
        ]
        out[f"sleeve_{panel}_left"], out[f"sleeve_{panel}_right"] = [sleeve], [mirrored(sleeve)]
    return out


def _armhole(armpit: NDArray, tip: NDArray, depth: float) -> NDArray:
    """From the armpit up to the shoulder's tip, ``depth`` [m] hollowed towards the body."""
    inner = min(armpit[0], tip[0]) - depth
    rise = tip[1] - armpit[1]
    return bezier(armpit, [inner, armpit[1] + 0.25 * rise], [inner, armpit[1] + 0.7 * rise], tip)


def bodice_side(p: dict[str, float]) -> NDArray:
    """(N, 2) left side seam of a bodice, from the hem up."""
    return through(_side_points(p), 1)


def _side_points(p: dict[str, float]) -> list[NDArray]:
    points = [np.array([p["hem_x"], p["hem_y"]])]
    for name in ("hip", "yoke", "waist"):
        if f"{name}_x" in p and p[f"{name}_y"] > p["hem_y"] + 0.04:
            points.append(np.array([p[f"{name}_x"], p[f"{name}_y"]]))
    return points + [np.array([p["chest_x"], p["armpit_y"]])]


def _sleeve(p: dict[str, float], neck: NDArray, armpit: NDArray) -> list[Edge]:
    """From the armpit up to the neck: underarm seam, cuff, shoulder seam; or an armhole where there is no sleeve."""
    if p["sleeve_x"] <= 0:
        end = np.array([p["strap_x"], p["strap_y"]])
        hole = bezier(armpit, [end[0] - 0.004, armpit[1] + 0.03], end)
        return [Edge("open", hole), Edge("shoulder_left", np.stack([end, neck]))]
    cuff_top = np.array([p["sleeve_x"], p["sleeve_y"]])
    cuff_low = cuff_top - [0.0, p["cuff_height"]]
    bend = np.array([armpit[0] + p["underarm"], 0.0])
    slope = (cuff_low[1] - armpit[1]) / (cuff_low[0] - armpit[0])
    bend[1] = max(armpit[1] + 0.75 * p["underarm"], armpit[1] + slope * p["underarm"])
    bend[1] = min(bend[1], max(cuff_low[1], armpit[1] + 0.2 * p["underarm"]))
    under = bezier(armpit, bend, cuff_low)
    tip = np.array([p["shoulder_x"], p["shoulder_y"]])
    return [
        Edge("sleeve_under_left", under),
        Edge("open", np.stack([cuff_low, cuff_top])),
        Edge("shoulder_left", through([cuff_top, tip, neck], 0)),
    ]


def _neckline(neck: NDArray, centre: NDArray, v: float) -> NDArray:
    """From the neck point to the middle; v = 0 is round, 1 a straight V."""
    drop = neck - centre
    near_neck = (1 - v) * (neck - [0.02 * drop[0], 0.60 * drop[1]]) + v * (neck - 0.30 * drop)
    near_centre = (1 - v) * (centre + [0.70 * drop[0], 0.0]) + v * (centre + 0.30 * drop)
    return bezier(neck, near_neck, near_centre, centre)


def _hem(p: dict[str, float], corner: NDArray) -> NDArray:
    """From the middle to the left corner; ``hem_drop`` lowers the middle."""
    low = corner[1] - p.get("hem_drop", 0.0)
    return bezier([0.0, low], [0.55 * corner[0], low], corner)


def _cut_open(edges: list[Edge], line: NDArray, hem: NDArray, gap: float) -> list[list[Edge]]:
    """Both halves of a front that is cut away within ``gap`` of the middle [m]."""
    y_neck = float(np.interp(gap, line[::-1, 0], line[::-1, 1]))
    line = np.concatenate([line[line[:, 0] > gap + 1e-6], [[gap, y_neck]]])
    y_hem = float(np.interp(gap, hem[:, 0], hem[:, 1]))
    hem = np.concatenate([[[gap, y_hem]], hem[hem[:, 0] > gap + 1e-6]])
    centre = np.stack([[gap, y_neck], [gap, y_hem]])
    left = [Edge("open", hem), *edges, Edge("open", line), Edge("open", centre)]
    return [left, mirrored(left)]


def skirt(p: dict[str, float]) -> Outline:
    """Skirt: waistband, side seams, hem."""
    side = skirt_side(p)
    waist = side[-1]
    hem = _hem(p, side[0])
    bottom = np.concatenate([(hem * [-1, 1])[::-1], hem[1:]])
    out: Outline = {}
    for panel in ("front", "back"):
        band = _waistband(waist, p["waist_drop"])
        out[panel] = [[Edge("open", bottom), Edge("side_left", side), band, *mirrored([Edge("side_left", side)])]]
    return out


def skirt_side(p: dict[str, float]) -> NDArray:
    """(N, 2) left side seam of a skirt, from the hem up."""
    points = [np.array([p["hem_x"], p["hem_y"]])]
    if p["hem_y"] < p["hip_y"] - 0.04:
        points.append(np.array([p["hip_x"], p["hip_y"]]))
    return through(points + [_yoke(p), np.array([p["waist_x"], p["waist_y"]])], 1)


def _yoke(p: dict[str, float]) -> NDArray:
    return np.array([p["yoke_x"], p["yoke_y"]])


def _waistband(waist: NDArray, drop: float) -> Edge:
    middle = [0.0, waist[1] - 2 * drop]
    return Edge("open", bezier(waist, middle, waist * [-1, 1]), held=True)


def trousers(p: dict[str, float]) -> Outline:
    """Trousers or shorts: waistband, side seams, hems, inseams that meet in a rounded crotch."""
    waist = np.array([p["waist_x"], p["waist_y"]])
    outer = np.array([p["hem_outer_x"], p["hem_y"] + p["hem_rise"]])
    inner = np.array([p["hem_inner_x"], p["hem_y"]])
    crotch = np.array([0.0, p["crotch_y"]])
    points = [outer]
    if p["knee_y"] > p["hem_y"] + 0.08:
        points.append(np.array([p["knee_outer_x"], p["knee_y"]]))
    points += [np.array([p["thigh_outer_x"], p["thigh_y"]]), np.array([p["hip_x"], p["hip_y"]]), _yoke(p), waist]
    side = through(points, 1)
    radius = p["crotch_radius"]
    # The inseam starts as a quarter of an arch under the crotch, so that two legs never leave from one point.
    ends = [radius, crotch[1] - 0.35 * radius], [radius, crotch[1] - 1.4 * radius]
    arch = bezier(crotch, [0.75 * radius, crotch[1]], *ends)
    inseam_points = [arch[-1]]
    if p["knee_y"] > p["hem_y"] + 0.08:
        inseam_points.append(np.array([p["knee_inner_x"], p["knee_y"]]))
    inseam = np.concatenate([arch[:-1], through(inseam_points + [inner], 1)])
    half = [Edge("inseam_left", inseam), Edge("open", np.stack([inner, outer])), Edge("side_left", side)]
    out: Outline = {}
    for panel in ("front", "back"):
        band = _waistband(waist, p["waist_drop"])
        out[panel] = [[*half, band, *mirrored(half)]]
    return out
