"""Log-priors of place: where on the body each layer may be, given where the garments end on this photo."""

from __future__ import annotations

import numpy as np

from recon.perceive.bodymap import ARM_L, ARM_R, HEAD, LEG_L, LEG_R, TORSO, BodyMap
from recon.perceive.zones import BACKGROUND, HAIR, JACKET, LAYERS, LOWER, SHOE, SKIN, TOP, Ends, Outfit

NEVER = -60.0
"""Energy of a layer that cannot be here."""


def past(z: np.ndarray, slope: float, most: float) -> np.ndarray:
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
    head = np.where(body.part == HEAD, past(1.15 - body.head, 30, 12), 0)
    head = head + past(body.up - body.chin, 25, 10)

    for layer in (JACKET, TOP):
        if layer in outfit.zones:
            out[..., layer] -= past(past_sleeve, 25, 12) + head
            end = ends.jacket if layer == JACKET else ends.upper
            below = past(end - body.up, 20, 12) if not outfit.dress else past(past_hem, 25, 12)
            out[..., layer] -= np.where(arm, np.minimum(below, 2), below)
            out[..., layer] -= past(0.9 - body.foot, 20, 6)
        else:
            out[..., layer] = NEVER
    if JACKET in outfit.zones:
        out[..., TOP] -= np.where(arm, 8, 0) + past(np.abs(body.across) - 0.45, 14, 8)
        out[..., JACKET] -= past(0.35 - np.abs(body.across), 4, 1) + past(0.16 - body.neck, 30, 6)
    if outfit.dress:
        out[..., LOWER] = NEVER
    else:
        out[..., LOWER] -= past(body.up - ends.lower, 20, 12) + past(past_hem, 25, 12) + head
        out[..., LOWER] -= np.where(arm & (body.up > -0.3), 3, 0)
        out[..., LOWER] -= past(0.7 - body.foot, 20, 4)
    out[..., SKIN] -= _skin_cost(body, past_sleeve, past_hem, ends, outfit)
    out[..., HAIR] -= past(body.head - 1.2, 5, 14) + np.where(arm | leg, 4, 0) + np.where(body.face, 3, 0)
    out[..., SHOE] -= np.where(leg, past(1.9 - body.leg, 25, 20), np.float32(20))
    out[..., SHOE] -= np.minimum(past(body.foot - 1.0, 4, 8), np.where(past_hem > 0, 2, 8))
    # The person's mask closes narrow gaps: between the legs, between arm and trunk.
    out[..., BACKGROUND] -= 1.5 + past(0.7 - body.gap, 12, 12) + past(0.8 - body.neck, 20, 12)
    return out


def _skin_cost(body: BodyMap, past_sleeve: np.ndarray, past_hem: np.ndarray, ends: Ends, outfit: Outfit) -> np.ndarray:
    """(h, w) cost of skin: it needs a place as well as a colour."""
    arm, leg = np.isin(body.part, (ARM_L, ARM_R)), np.isin(body.part, (LEG_L, LEG_R))
    cost = np.full(body.part.shape, 12.0, np.float32)
    cost = np.where(arm, past(-past_sleeve, 25, 12), cost)
    cost = np.where(leg, past(-past_hem, 25, 12), cost)
    cost = np.minimum(cost, past(body.hand - 0.9, 8, 12))
    cost = np.minimum(cost, past(body.head - 1.0, 8, 12))
    neckline = 0.2 if JACKET in outfit.zones else 0.5 if outfit.zones[TOP].sleeve.low < 0 else 0.32
    cost = np.minimum(cost, np.minimum(past(body.neck - 0.1, 5, 12) + past(body.neck - neckline, 25, 12), 12))
    # A bare arm may be in front of the trunk; there the colour decides.
    arm_end = np.where(body.across > 0, ends.sleeve[ARM_L], ends.sleeve[ARM_R])
    in_front = 1.5 + past(body.arm_axis - 1.0, 16, 12) + past(arm_end + 0.15 - body.arm, 25, 12)
    cost = np.minimum(cost, np.where(body.part == TORSO, in_front, 12))
    if outfit.zones[TOP].sleeve.high < 0.5:  # straps leave shoulders and shoulder blades bare
        cost = np.minimum(cost, 2.5 + past(0.45 - body.up, 25, 12))
    if ends.upper > ends.lower:
        bared = np.maximum(body.up - ends.upper, ends.lower - body.up)
        cost = np.minimum(cost, np.where(arm, cost, past(bared, 25, 12)))
    return cost
