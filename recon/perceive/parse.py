"""The pose-seeded split of a person into the garments that the user names, without a parsing network.

Each layer (jacket, top or dress, lower garment, skin, hair, shoes) has a colour mixture learned from this photo alone,
at seeds that the pose gives, and a place: sleeves, hems and waist as one-dimensional splits (``zones``), skin only
where skin can be (head, beyond sleeves and hems, a bared waist). Colour and place make one energy a pixel; mean-field
steps with an edge-aware filter as the message smooth it (Kraehenbuehl and Koltun 2011, with He's guided filter in place
of the bilateral one); the mixtures are then learned again from what was found.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from recon.perceive.bodymap import ARM_L, ARM_R, HEAD, LEG_L, LEG_R, TORSO, BodyMap
from recon.perceive.colours import FLOOR, SHADED, SPREAD, fit_mixture, lab
from recon.perceive.place import NEVER, past, place
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
    Ends,
    Outfit,
    limb_ends,
    waist_split,
)

MESSAGE = 4.0
"""Weight of the neighbours' opinion against a pixel's own log-likelihoods."""
ROUNDS, STEPS = 2, 4
COMPONENTS = {HAIR: 2, BACKGROUND: 6}
"""Components of a layer's colour mixture, where not 4."""
MIN_SEED = 40
"""Fewer pixels teach no colour."""


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
        energy[..., HAIR] -= np.where(long_hair(colour, inner, body), 0, past(body.chin + 0.05 - body.up, 60, 12))
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
