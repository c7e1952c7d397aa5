"""Where garments may be worn, by the name that the user gave, and where they end on this photo.

Sleeves, hems and waists cut a limb once: cloth before, something else after. So they are found as one-dimensional
splits of a colour score along the limb, which needs far less colour evidence than deciding pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

JACKET, TOP, LOWER, SKIN, HAIR, SHOE, BACKGROUND = range(7)
LAYERS = 7

BIN = 0.04
CLIP = 4.0


@dataclass(frozen=True)
class Range:
    """Where an end may lie along a limb: free of cost between ``low`` and ``high``, likeliest at ``usual``."""

    low: float
    usual: float
    high: float

    def cost(self, at: np.ndarray) -> np.ndarray:
        """Cost of ends at places ``at``, in fully convinced bins (a bone has 25 bins: a weak but steady score of 0.16
        moves an end away from the usual place)."""
        outside = np.maximum(self.low - at, 0) + np.maximum(at - self.high, 0)
        return 4 * np.abs(at - self.usual) + 20 * outside


@dataclass(frozen=True)
class Zone:
    """Where a garment of a name may be worn."""

    layer: int
    """JACKET, TOP or LOWER."""
    sleeve: Range = Range(0.0, 0.0, 0.3)
    """End along the arm: 0 shoulder, 1 elbow, 2 wrist."""
    hem: Range = Range(0.0, 0.0, 0.5)
    """End along the leg: 0 hip, 1 knee, 2 ankle."""
    waist: float = 0.0
    """Usual height of its hem (upper garments) or waistband, on the trunk: 0 hips, 1 shoulders."""
    between: bool = False
    """Whether it also covers what lies between the legs."""


ZONES = {
    "jacket": Zone(JACKET, sleeve=Range(1.0, 1.95, 2.25), waist=-0.15),
    "top": Zone(TOP, sleeve=Range(-0.1, 1.2, 2.2), waist=-0.02),
    "tank": Zone(TOP, sleeve=Range(-0.3, 0.0, 0.3), waist=0.0),
    "tshirt": Zone(TOP, sleeve=Range(0.25, 0.75, 1.2), waist=-0.02),
    "shirt": Zone(TOP, sleeve=Range(0.6, 1.9, 2.2), waist=-0.02),
    "skirt": Zone(LOWER, hem=Range(0.2, 0.9, 2.1), waist=0.15, between=True),
    "trousers": Zone(LOWER, hem=Range(0.35, 1.95, 2.2), waist=0.05),
    "shorts": Zone(LOWER, hem=Range(0.15, 0.7, 1.25), waist=0.05),
    "dress": Zone(TOP, sleeve=Range(-0.3, 0.3, 2.2), hem=Range(0.2, 0.9, 2.1), between=True),
}
"""Garment name -> where it may be worn: a new name is a line here."""


@dataclass(frozen=True)
class Outfit:
    """What is worn, by layer; unnamed layers are there all the same, so that they are not taken for a named one."""

    zones: dict[int, Zone]
    """Layer -> zone; a dress has no LOWER."""
    names: dict[int, str]
    """Layer -> the user's name, for the named ones."""

    @staticmethod
    def of(garments: Sequence[str]) -> Outfit:
        """The outfit of the user's garment names (keys of ``ZONES``, at most one a layer)."""
        names = {ZONES[name].layer: name for name in garments}
        zones = {layer: ZONES[name] for layer, name in names.items()}
        if TOP not in zones:
            zones[TOP] = ZONES["top"]
        if LOWER not in zones and names.get(TOP) != "dress":
            zones[LOWER] = ZONES["trousers"]
        return Outfit(zones, names)

    @property
    def dress(self) -> bool:
        """Whether one piece covers trunk and legs."""
        return LOWER not in self.zones


@dataclass
class Ends:
    """Where the garments end on this photo."""

    sleeve: dict[int, float] = field(default_factory=dict)
    """Arm part -> end of the outer sleeve along the arm."""
    hem: dict[int, float] = field(default_factory=dict)
    """Leg part -> end of the lower garment (or dress) along the leg."""
    upper: float = 0.0
    """Height where the upper garment ends, on the trunk."""
    lower: float = 0.0
    """Height where the lower garment begins."""
    jacket: float = 0.0
    """Height where the jacket ends."""
    evidence: dict[str, float] = field(default_factory=dict)
    """'waist', 'jacket', 'sleeve', 'hem' -> how far colours support the end, in [0, 1]."""


def profile(place: np.ndarray, score: np.ndarray, low: float, high: float, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean clipped score in bins of ``place``: (edges (n + 1,), means (n,)); bins of few pixels (< ``least``) fade."""
    edges = np.arange(low, high + BIN, BIN)
    at = np.digitize(place, edges) - 1
    inside = (at >= 0) & (at < len(edges) - 1)
    count = np.bincount(at[inside], minlength=len(edges) - 1).astype(float)
    total = np.bincount(at[inside], np.clip(score[inside], -CLIP, CLIP), minlength=len(edges) - 1)
    return edges, total / np.maximum(count, least) / CLIP


def limb_ends(
    limbs: list[tuple[np.ndarray, np.ndarray]], allowed: Range, bounds: tuple[float, float], alike: float
) -> list[tuple[float, float]]:
    """The places where a garment ends along two limbs (both sleeves, both legs), found together.

    Args:
        limbs: of each limb (N,) places of its pixels and (N,) log-likelihood of what comes after the garment minus the
            garment's own.
        allowed: where an end may lie.
        bounds: the part of the limb that is looked at.
        alike: cost of ends that differ by one bone, in fully convinced bins: clothes are made the same on both sides.

    Returns:
        Of each limb its end, and the mean strength of the colour evidence around it in [0, 1].
    """
    totals, curves = [], []
    edges = np.zeros(0)
    for place, score in limbs:
        edges, means = profile(place, score, *bounds, max(4, round(0.004 * len(place))))
        before = np.concatenate([[0], np.cumsum(-means)])
        after = np.concatenate([np.cumsum(means[::-1])[::-1], [0]])
        totals.append(before + after - allowed.cost(edges))
        curves.append(means)
    both = totals[0][:, None] + totals[1][None, :] - alike * np.abs(edges[:, None] - edges[None, :])
    best = np.unravel_index(both.argmax(), both.shape)
    near = [slice(max(0, int(b) - 5), int(b) + 5) for b in best]
    return [(float(edges[b]), float(np.abs(m[n]).mean().clip(0, 1))) for b, m, n in zip(best, curves, near)]


def waist_split(
    up: np.ndarray, upper: np.ndarray, lower: np.ndarray, skin: np.ndarray, usual: float
) -> tuple[float, float, float]:
    """Heights on the trunk where the upper garment ends and where the lower one begins; apart only over a bare waist.

    Args:
        up: (N,) heights of trunk and thigh pixels.
        upper, lower, skin: (N,) log-likelihoods.
        usual: where to look when colours cannot tell.

    Returns:
        (end of the upper garment, begin of the lower one, evidence in [0, 1]).
    """
    mean = (upper + lower + skin) / 3
    least = max(4, round(0.004 * len(up)))
    curves = []
    for values in (upper, skin, lower):
        edges, means = profile(-up, values - mean, -0.85, 0.8, least)
        curves.append(np.concatenate([[0], np.cumsum(means)]))
    a, s, b = curves
    cost = Range(-0.35, 0.0, 0.35).cost(edges + usual)
    # Cloth down to edge i, skin from i to j, cloth from j on. A bare waist must pay for itself.
    i, j = np.meshgrid(np.arange(len(edges)), np.arange(len(edges)), indexing="ij")
    total = a[i] + s[j] - s[i] + b[-1] - b[j] - np.where(j > i, 1.0, 0) - 0.5 * (cost[i] + cost[j])
    total[j < i] = -np.inf
    total[(j > i) & (j - i < 3)] = -np.inf
    first, second = np.unravel_index(total.argmax(), total.shape)
    here = slice(max(0, min(first, second) - 5), max(first, second) + 5)
    evidence = np.abs(np.diff(a) - np.diff(b))[here].mean()
    return -float(edges[first]), -float(edges[second]), float(np.clip(evidence, 0, 1))
