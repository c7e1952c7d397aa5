"""The pose-seeded split of a person into the garments that the user names, without a parsing network.

Each layer (jacket, top or dress, lower garment, skin, hair, shoes) has a colour mixture learned from this photo alone,
at seeds that the pose gives, and a place: sleeves, hems and waist as one-dimensional splits (``zones``), skin only
where skin can be (head, beyond sleeves and hems, a bared waist). Colour and place make one energy a pixel; mean-field
steps with an edge-aware filter as the message smooth it (Kraehenbuehl and Koltun 2011, with He's guided filter in place
of the bilateral one); the mixtures are then learned again from what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from recon.perceive.bodymap import ARM_L, ARM_R, HEAD, LEG_L, LEG_R, TORSO, BodyMap
from recon.perceive.colours import FLOOR, SHADED, SPREAD, fit_mixture, lab
from recon.perceive.segment import guided
from recon.perceive.zones import (
    BACKGROUND,
    HAIR,
    JACKET,
    LAYERS,
    LOWER,
    SHOE,
    SKIN,
    TOP,
    ZONES,
    Zone,
    limb_ends,
    waist_split,
)

MESSAGE = 4.0
"""Weight of the neighbours' opinion against a pixel's own log-likelihoods."""
ROUNDS, STEPS = 2, 4
NEVER = -60.0
"""Energy of a layer that cannot be here."""
COMPONENTS = {HAIR: 2, BACKGROUND: 6}
"""Components of a layer's colour mixture, where not 4."""
MIN_SEED = 40
"""Fewer pixels teach no colour."""


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


@dataclass(frozen=True)
class Parsed:
    """The split of a window."""

    belief: np.ndarray
    """(h, w, LAYERS) probabilities, zero outside of the person."""
    colour: np.ndarray
    """(h, w, LAYERS) colour log-likelihoods alone."""
    ends: Ends
    """Where garments end."""


def split(rgb: np.ndarray, person: np.ndarray, body: BodyMap, outfit: Outfit) -> Parsed:
    """Layer probabilities of a window.

    Args:
        rgb: (h, w, 3) uint8.
        person: (h, w) bool.
        body: the window's body coordinates.
        outfit: what is worn.
    """
    colours = lab(rgb)
    inner = cv2.erode(person.astype(np.uint8), np.ones((3, 3))) > 0
    seeds = _seeds(colours, inner, body, outfit) | _background(colours, person, body)
    samples = seeds
    for k in range(ROUNDS):
        colour = _colour(colours, person, samples, first=k == 0)
        ends = find_ends(colour, inner, body, outfit)
        energy = colour + place(body, outfit, ends)
        energy[..., HAIR] -= np.where(long_hair(colour, inner, body), 0, _past(body.chin + 0.05 - body.up, 60, 12))
        belief = smooth(rgb, energy, person)
        best, sure = belief.argmax(-1), (belief.max(-1) > 0.85) & inner
        samples = {n: np.vstack([x, *[colours[sure & (best == n)]] * 2]) for n, x in seeds.items() if n != BACKGROUND}
        samples |= {BACKGROUND: seeds[BACKGROUND]} if BACKGROUND in seeds else {}
    return Parsed(belief, colour, ends)


def _seeds(colours: np.ndarray, person: np.ndarray, body: BodyMap, outfit: Outfit) -> dict[int, np.ndarray]:
    """Layer -> (N, 3) colours at places where the pose makes the layer near certain."""
    places = (body.cheeks & person, body.face & person, (body.head < 0.5) & person, person)
    face = next((m for m in places if m.sum() > MIN_SEED), person)
    bare = _bare_limbs(body, outfit) & person
    face = bare if body.behind and bare.sum() > MIN_SEED else face
    skin = fit_mixture(colours[face], 2, SHADED).log_likelihood(colours)
    like_face = skin > np.percentile(skin[face], 10) - 1
    unlike_face = skin < np.percentile(skin[face], 3) - 2
    pick = {SKIN: face | (body.hand < 0.8) & person & like_face, SHOE: person & (body.foot < 0.5)}
    hair = person & (body.head < 1.25) & (body.up > body.chin + 0.15) & unlike_face & ~body.face
    if hair.sum() > 0.06 * (person & (body.head < 1)).sum():  # fewer are eyes and shadows of a bald head
        pick[HAIR] = hair
    trunk = body.core & person & (body.part == TORSO)
    pick[TOP] = trunk & ~like_face if (trunk & ~like_face).sum() > 0.35 * trunk.sum() else trunk
    if not outfit.dress:
        legs = body.thighs & person & (body.hand > 1.2) & (body.up < -0.05)
        pick[LOWER] = legs & ~like_face if (legs & ~like_face).sum() > 0.3 * legs.sum() else legs
    if JACKET in outfit.zones:
        pick |= _jacket_seeds(colours, person, body, like_face)
    return {k: colours[m] for k, m in pick.items() if m.sum() >= MIN_SEED}


def _bare_limbs(body: BodyMap, outfit: Outfit) -> np.ndarray:
    """(h, w) bool: arms and shins that a garment of the named kind cannot cover: skin that shows from behind, too."""
    sleeve = outfit.zones.get(JACKET, outfit.zones[TOP]).sleeve.high
    arm = ((body.part == ARM_L) | (body.part == ARM_R)) & (body.arm_axis < 0.6)
    out = arm & (body.arm > sleeve + 0.25) & (body.arm < 1.9)
    if not outfit.dress and LOWER in outfit.names:
        leg = ((body.part == LEG_L) | (body.part == LEG_R)) & (body.gap < 0.5)
        out |= leg & (body.leg > outfit.zones[LOWER].hem.high + 0.1) & (body.leg < 1.65)
    return out


def _background(colours: np.ndarray, person: np.ndarray, body: BodyMap) -> dict[int, np.ndarray]:
    """Colours of the ring round trunk and limbs: what may show through between them."""
    reach = np.ones((2 * round(0.35 * body.width) + 1,) * 2, np.uint8)
    near = cv2.dilate((person & (body.part != HEAD)).astype(np.uint8), reach) > 0
    ring = near & ~(cv2.dilate(person.astype(np.uint8), np.ones((5, 5))) > 0)
    return {BACKGROUND: colours[ring]} if ring.sum() >= MIN_SEED else {}


def _jacket_seeds(
    colours: np.ndarray, person: np.ndarray, body: BodyMap, like_face: np.ndarray
) -> dict[int, np.ndarray]:
    """JACKET from sleeves and sides; TOP from the trunk's middle, where the jacket's colours explain it badly."""
    arms = ((body.part == ARM_L) | (body.part == ARM_R)) & (body.arm > 0.2) & (body.arm < 1.5)
    sides = (body.part == TORSO) & (np.abs(body.across) > 0.7) & (body.up > 0.3) & (body.up < 0.85)
    jacket = (arms | sides) & person & ~like_face
    if jacket.sum() < MIN_SEED:
        return {}
    likely = fit_mixture(colours[jacket]).log_likelihood(colours)
    middle = person & (np.abs(body.across) < 0.35) & (body.up > 0.15) & (body.up < body.chin - 0.12)
    strange = middle & (likely < np.percentile(likely[jacket], 10) - 1) & ~(like_face & (body.neck < 0.22))
    return {JACKET: jacket, TOP: strange}


def _colour(colours: np.ndarray, person: np.ndarray, samples: dict[int, np.ndarray], first: bool) -> np.ndarray:
    """(h, w, LAYERS) log-likelihoods of the person's colours; layers without samples are never likely."""
    out = np.full((*colours.shape[:2], LAYERS), NEVER, np.float32)
    for layer, x in samples.items():
        spread = SHADED if layer == SKIN and first else SPREAD
        out[person, layer] = fit_mixture(x, COMPONENTS.get(layer, 4), spread).log_likelihood(colours[person])
    return out


def find_ends(colour: np.ndarray, person: np.ndarray, body: BodyMap, outfit: Outfit) -> Ends:
    """Sleeves, hems and waists from colours alone."""
    ends, evidence = Ends(), {}
    outer = np.maximum(colour[..., JACKET], colour[..., TOP])
    sleeved = outfit.zones.get(JACKET, outfit.zones[TOP])
    skin = np.maximum(colour[..., SKIN], FLOOR)
    arms = [person & (body.part == arm) for arm in (ARM_L, ARM_R)]
    found = limb_ends([(body.arm[on], (skin - outer)[on]) for on in arms], sleeved.sleeve, (-0.3, 2.5), 6.0)
    for arm, (end, sure) in zip((ARM_L, ARM_R), found):
        ends.sleeve[arm], evidence[f"sleeve {arm}"] = end, sure
    cloth = colour[..., TOP if outfit.dress else LOWER]
    bare = np.maximum(skin, colour[..., SHOE] - np.where(body.leg < 1.8, 8, 0))  # shoes of the trousers' colour
    zone = outfit.zones[TOP if outfit.dress else LOWER]
    legs = [person & (body.part == leg) & (body.hand > 1.2) for leg in (LEG_L, LEG_R)]
    alike = 30.0 if zone.between else 10.0
    found = limb_ends([(body.leg[on], (bare - cloth)[on]) for on in legs], zone.hem, (0.0, 2.5), alike)
    for leg, (end, sure) in zip((LEG_L, LEG_R), found):
        ends.hem[leg], evidence[f"hem {leg}"] = end, sure
    if not outfit.dress:
        middle = person & (body.part != ARM_L) & (body.part != ARM_R) & (body.part != HEAD) & (body.hand > 1.2)
        inner = middle & (np.abs(body.across) < (0.45 if JACKET in outfit.zones else 1.1))
        ends.upper, ends.lower, evidence["waist"] = waist_split(
            body.up[inner], outer[inner], cloth[inner], skin[inner], outfit.zones[TOP].waist
        )
        ends.jacket = ends.upper
        if JACKET in outfit.zones:
            side = middle & (np.abs(body.across) > 0.6)
            ends.jacket, _, evidence["jacket"] = waist_split(
                body.up[side],
                colour[..., JACKET][side],
                cloth[side],
                np.full(int(side.sum()), FLOOR),
                outfit.zones[JACKET].waist,
            )
    ends.evidence = evidence
    return ends


def long_hair(colour: np.ndarray, person: np.ndarray, body: BodyMap) -> bool:
    """Whether the hair falls below the chin: it then shows beside the jaw (a hood there has another colour)."""
    beside = body.beside & person & (body.part != TORSO)
    hair = colour[..., HAIR] > colour[..., [JACKET, TOP, SKIN]].max(-1)
    return bool((hair & beside).sum() > max(0.4 * beside.sum(), 0.0008 * person.sum()))


def _past(z: np.ndarray, slope: float, most: float) -> np.ndarray:
    """Cost that grows with the way ``z`` past an end, at most ``most``."""
    return np.clip(slope * np.clip(z, -1e3, 1e3), 0, most)


def place(body: BodyMap, outfit: Outfit, ends: Ends) -> np.ndarray:
    """(h, w, LAYERS) log-priors of place."""
    out = np.zeros((*body.part.shape, LAYERS), np.float32)
    arm = (body.part == ARM_L) | (body.part == ARM_R)
    leg = (body.part == LEG_L) | (body.part == LEG_R)
    sleeve = np.where(body.part == ARM_L, ends.sleeve[ARM_L], ends.sleeve[ARM_R])
    hem = np.where(body.part == LEG_L, ends.hem[LEG_L], ends.hem[LEG_R])
    past_sleeve, past_hem = np.where(arm, body.arm - sleeve, 0), np.where(leg, body.leg - hem, 0)
    head = np.where(body.part == HEAD, _past(1.15 - body.head, 30, 12), 0)
    head = head + _past(body.up - body.chin, 25, 10)

    for layer in (JACKET, TOP):
        if layer in outfit.zones:
            out[..., layer] -= _past(past_sleeve, 25, 12) + head
            end = ends.jacket if layer == JACKET else ends.upper
            below = _past(end - body.up, 20, 12) if not outfit.dress else _past(past_hem, 25, 12)
            out[..., layer] -= np.where(arm, np.minimum(below, 2), below)
            out[..., layer] -= _past(0.9 - body.foot, 20, 6)
        else:
            out[..., layer] = NEVER
    if JACKET in outfit.zones:
        out[..., TOP] -= np.where(arm, 8, 0) + _past(np.abs(body.across) - 0.45, 14, 8)
        out[..., JACKET] -= _past(0.35 - np.abs(body.across), 4, 1) + _past(0.16 - body.neck, 30, 6)
    if outfit.dress:
        out[..., LOWER] = NEVER
    else:
        out[..., LOWER] -= _past(body.up - ends.lower, 20, 12) + _past(past_hem, 25, 12) + head
        out[..., LOWER] -= np.where(arm & (body.up > -0.3), 3, 0)
        out[..., LOWER] -= _past(0.7 - body.foot, 20, 4)
    out[..., SKIN] -= _skin_cost(body, arm, leg, past_sleeve, past_hem, ends, outfit)
    out[..., HAIR] -= _past(body.head - 1.2, 5, 14) + np.where(arm | leg, 4, 0) + np.where(body.face, 3, 0)
    out[..., SHOE] -= np.where(leg, _past(1.9 - body.leg, 25, 20), np.float32(20))
    out[..., SHOE] -= np.minimum(_past(body.foot - 1.0, 4, 8), np.where(past_hem > 0, 2, 8))
    # The person's mask closes narrow gaps: between the legs, between arm and trunk.
    out[..., BACKGROUND] -= 1.5 + _past(0.7 - body.gap, 12, 12) + _past(0.8 - body.neck, 20, 12)
    return out


def _skin_cost(
    body: BodyMap,
    arm: np.ndarray,
    leg: np.ndarray,
    past_sleeve: np.ndarray,
    past_hem: np.ndarray,
    ends: Ends,
    outfit: Outfit,
) -> np.ndarray:
    """(h, w) cost of skin: it needs a place as well as a colour."""
    cost = np.full(body.part.shape, 12.0, np.float32)
    cost = np.where(arm, _past(-past_sleeve, 25, 12), cost)
    cost = np.where(leg, _past(-past_hem, 25, 12), cost)
    cost = np.minimum(cost, _past(body.hand - 0.9, 8, 12))
    cost = np.minimum(cost, _past(body.head - 1.0, 8, 12))
    neckline = 0.2 if JACKET in outfit.zones else 0.5 if outfit.zones[TOP].sleeve.low < 0 else 0.32
    cost = np.minimum(cost, np.minimum(_past(body.neck - 0.1, 5, 12) + _past(body.neck - neckline, 25, 12), 12))
    # A bare arm may be in front of the trunk; there the colour decides.
    arm_end = np.where(body.across > 0, ends.sleeve[ARM_L], ends.sleeve[ARM_R])
    in_front = 1.5 + _past(body.arm_axis - 1.0, 16, 12) + _past(arm_end + 0.15 - body.arm, 25, 12)
    cost = np.minimum(cost, np.where(body.part == TORSO, in_front, 12))
    if outfit.zones[TOP].sleeve.high < 0.5:  # straps leave shoulders and shoulder blades bare
        cost = np.minimum(cost, 2.5 + _past(0.45 - body.up, 25, 12))
    if ends.upper > ends.lower:
        bared = np.maximum(body.up - ends.upper, ends.lower - body.up)
        cost = np.minimum(cost, np.where(arm, cost, _past(bared, 25, 12)))
    return cost


def smooth(rgb: np.ndarray, energy: np.ndarray, person: np.ndarray) -> np.ndarray:
    """(h, w, LAYERS) probabilities: mean-field steps on the energy, messages by a colour-guided filter."""
    radius = max(3, round(0.012 * max(person.shape)))
    alive = [k for k in range(LAYERS) if energy[..., k][person].max(initial=NEVER) > NEVER / 2]
    e = energy[..., alive]
    on = person.astype(np.float32)

    def softmax(x: np.ndarray) -> np.ndarray:
        p = np.exp(x - x.max(-1, keepdims=True))
        return p / p.sum(-1, keepdims=True) * on[..., None]

    weight = np.maximum(guided(rgb, on, radius, 1e-3), 0.05)
    p = softmax(0.5 * e)
    for _ in range(STEPS):
        p = softmax(e * 0.5 + MESSAGE * guided(rgb, p, radius, 1e-3) / weight[..., None])
    out = np.zeros((*person.shape, LAYERS), np.float32)
    out[..., alive] = p
    return out
