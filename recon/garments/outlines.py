"""Named edits of flat patterns: longer, shorter, other sleeves, opened or closed in front (ISP §4.5).

Loops are closed outlines (N, 2) in panel coordinates [m], counter-clockwise, the last point joins the first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.garments.panels import border_loops
from recon.types import Garment, UserError, behind

Loop = NDArray[np.float64]
ROOM = 0.02
"""What must be left between a moved edge and what stays [m]."""
NEIGHBOURS = 8


@dataclass(frozen=True)
class Stretchable:
    """How a kind's length is changed: from ``top`` to the hem it is measured, below ``hold`` - ``below`` it moves."""

    top: str
    """Parameter of the upper end."""
    hold: str
    """Parameter above which nothing moves."""
    below: float
    """So far below that [m]."""


LENGTHS = {
    "top": Stretchable("neck_y", "armpit_y", 0.05),
    "shirt6": Stretchable("neck_y", "armpit_y", 0.05),
    "dress": Stretchable("neck_y", "hip_y", 0.02),
    "skirt": Stretchable("waist_y", "hip_y", 0.0),
    "trousers": Stretchable("waist_y", "crotch_y", 0.05),
}
"""By garment kind."""


def known_parameters(codes: Tensor, parameters: list[dict[str, float]], latent: Tensor) -> dict[str, float]:
    """Pattern parameters of a code (z,): those of the learned codes around it, the nearer the more they count."""
    square = (codes - latent).square().sum(1)
    near = square.topk(min(NEIGHBOURS, len(codes)), largest=False).indices.tolist()
    weight = torch.exp(-square / square[near].mean().clamp_min(1e-9)).tolist()
    found = {}
    for name in parameters[near[0]]:
        rows = [(weight[k], parameters[k][name]) for k in near if name in parameters[k]]
        found[name] = sum(w * v for w, v in rows) / max(sum(w for w, _ in rows), 1e-12)
    return found


def panel_loops(garment: Garment) -> list[list[Loop]]:
    """Outlines of each panel."""
    points = garment.panel_points.detach().cpu().double().numpy()
    panels = []
    for panel, name in enumerate(garment.panel_names):
        faces = garment.panel_faces[garment.panel_of_face == panel].cpu().numpy()
        panels.append([points[loop] for loop in border_loops(faces[:, [0, 2, 1]] if behind(name) else faces)])
    return panels


def with_length(panels: list[list[Loop]], factor: float, kind: str, known: dict[str, float]) -> list[list[Loop]]:
    """The hem moved so that the garment is ``factor`` times as long. UserError: shorter than can be."""
    rule = LENGTHS[kind]
    hold = known[rule.hold] - rule.below
    hem = min(float(loop[:, 1].min()) for loops in panels for loop in loops)
    hold = max(hold, hem + 2 * ROOM)
    new = known[rule.top] - factor * (known[rule.top] - hem)
    if new > hold - ROOM:
        least = (known[rule.top] - hold + ROOM) / (known[rule.top] - hem)
        raise UserError(f"length: found {factor:g}; wanted at least {least:.2f} for this garment")

    def move(loop: Loop) -> Loop:
        y = loop[:, 1]
        below = hold + (y - hold) * (hold - new) / (hold - hem)
        return np.stack([loop[:, 0], np.where(y < hold, below, y)], 1)

    return [[move(loop) for loop in loops] for loops in panels]


def with_sleeves(panels: list[list[Loop]], factor: float, known: dict[str, float]) -> list[list[Loop]]:
    """The cuffs moved: sleeves ``factor`` times as long, measured from the shoulder. UserError: it has no sleeves."""
    if "shoulder_x" not in known or "chest_x" not in known:
        raise UserError("sleeve: this garment has none; start from a tshirt, a shirt or a jacket")
    cuff = max(float(np.abs(loop[:, 0]).max()) for loops in panels for loop in loops)
    hold = known["chest_x"] + 0.01  # where the underarm curve begins
    tip = known["shoulder_x"]
    new = tip + factor * (cuff - tip)
    if new < hold + ROOM:
        least = (hold + ROOM - tip) / (cuff - tip)
        raise UserError(f"sleeve: found {factor:g}; wanted at least {least:.2f} for this garment")

    def move(loop: Loop) -> Loop:
        x = np.abs(loop[:, 0])
        beyond = hold + (x - hold) * (new - hold) / (cuff - hold)
        return np.stack([np.sign(loop[:, 0]) * np.where(x > hold, beyond, x), loop[:, 1]], 1)

    return [[move(loop) for loop in loops] for loops in panels]


def opened(panels: list[list[Loop]], gap: float) -> list[list[Loop]]:
    """The front cut open along its middle, ``gap`` [m] wide. UserError: it is open."""
    if len(panels[0]) != 1:
        raise UserError("open: the front is open already")
    front = panels[0][0]
    return [[_clip(front[::-1] * [-1, 1], gap / 2)[::-1] * [-1, 1], _clip(front, gap / 2)], *panels[1:]]


def _clip(loop: Loop, x: float) -> Loop:
    """What lies at and beyond x, the cut closed by a straight edge (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(loop, np.roll(loop, -1, 0), strict=True):
        if a[0] >= x:
            kept.append(a)
        if (a[0] >= x) != (b[0] >= x):
            kept.append(a + (b - a) * (x - a[0]) / (b[0] - a[0]))
    return np.array(kept)


def closed(panels: list[list[Loop]]) -> list[list[Loop]]:
    """The two halves of an open front joined along the middle. UserError: it is closed."""
    if len(panels[0]) != 2:
        raise UserError("close: the front is closed already")
    left, right = sorted(panels[0], key=lambda loop: -loop[:, 0].mean())
    edge = max(float(left[:, 0].min()), float(-right[:, 0].max()))
    # Counter-clockwise the left half runs from the hem over the side up to the neck, the right one back down.
    return [[np.concatenate([_without_edge(left, edge), _without_edge(right, edge)])], panels[1]]


def _without_edge(loop: Loop, edge: float) -> Loop:
    """The loop's points away from the front edge, from one end of it to the other."""
    away = np.abs(loop[:, 0]) > edge + 0.008
    start = int(np.nonzero(away & ~np.roll(away, 1))[0][0])
    turned = np.roll(np.arange(len(loop)), -start)
    return loop[turned[away[turned]]]
