"""The photo alone -> :class:`recon.types.Photo`: people, the chosen one's mask, its split, confidences and notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from recon.perceive import blazepose
from recon.perceive.bodymap import ARM_L, ARM_R, BodyMap, body_map
from recon.perceive.cleanup import sharpen, tidy
from recon.perceive.confidence import garment_confidence, pose_confidence
from recon.perceive.parse import Parsed, split
from recon.perceive.segment import Window, person_mask, window_around
from recon.perceive.zones import HAIR, JACKET, LOWER, SHOE, SKIN, TOP, ZONES, Outfit
from recon.types import Photo, UserError

MAX_SIDE = 2048
"""Larger photos are shrunk to this for perception [px]; masks and landmarks come back in the photo's own pixels."""
LAYER_NAMES = {JACKET: "jacket", TOP: "top or dress", LOWER: "lower garment"}
CUT_PARTS = {
    "feet": (29, 30, 31, 32), "legs": (25, 26, 27, 28), "hands": (15, 16), "head": (0, 2, 5), "hips": (23, 24),
}  # fmt: skip


def perceive(
    rgb: Tensor, garments: Sequence[str], person: int | None = None, masks: Mapping[str, Tensor] | None = None
) -> Photo:
    """What one photo shows of one person and the named garments.

    Args:
        rgb: (H, W, 3) uint8, upright.
        garments: names, keys of ``recon.perceive.zones.ZONES``; at most one jacket, one top (tank, tshirt, shirt) or
            dress, one lower garment.
        person: which of several people, 1 = the largest, 2 = the next ...; without it the largest, with a note.
        masks: the user's own masks, name -> (H, W) bool; they replace the split for every name that they hold.

    Raises:
        UserError: nobody found, no such person, garment names that are unknown or cannot be worn together.
    """
    names = ordered(garments)
    image = np.ascontiguousarray(rgb.cpu().numpy())
    shrink = min(1.0, MAX_SIDE / max(image.shape[:2]))
    if shrink < 1:
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    found, notes = choose(blazepose.people(image), person)
    notes += cut_off(found.landmarks, image.shape[:2])
    window = window_around(found.mask, found.landmarks)
    small = window.cut(image)
    soft = person_mask(small, window.cut(found.mask))
    body = body_map(small.shape[:2], window.points(found.landmarks))
    outfit = Outfit.of(names)
    parsed = split(small, soft > 0.5, body, outfit)
    seen = assemble(image, window, soft, body, parsed, outfit)
    confidence = {"person": found.score, "pose": pose_confidence(found.landmarks)}
    for layer, name in outfit.names.items():
        sure = garment_confidence(layer, parsed, soft > 0.5, found.landmarks)
        confidence[name] = 1.0 if masks and name in masks else sure
    size = (int(rgb.shape[0]), int(rgb.shape[1]))
    seen = with_masks(enlarged(seen, size), masks or {})
    scale = np.array([size[1] / image.shape[1], size[0] / image.shape[0], 1.0])
    return Photo(
        rgb=rgb,
        person=torch.from_numpy(seen.person),
        garments={name: torch.from_numpy(seen.layers[name]) for name in names},
        ignore=torch.from_numpy(seen.ignore),
        landmarks=torch.from_numpy(found.landmarks * scale).float(),
        landmarks_world=torch.from_numpy(found.world).float(),
        confidence=confidence,
        notes=tuple(notes + doubts(seen, confidence)),
    )


def ordered(garments: Sequence[str]) -> list[str]:
    """The names, outermost first (jacket, top or dress, lower garment: tops hang over waistbands), after checks."""
    unknown = [g for g in garments if g not in ZONES]
    if unknown or not garments:
        raise UserError(f"--garments: found {', '.join(unknown) or 'none'}; wanted some of {', '.join(ZONES)}")
    layers: dict[int, str] = {}
    for name in dict.fromkeys(garments):
        layer = ZONES[name].layer
        if layer in layers:
            raise UserError(f"--garments: found {layers[layer]} and {name}; wanted one {LAYER_NAMES[layer]}")
        layers[layer] = name
    if layers.get(TOP) == "dress" and LOWER in layers:
        raise UserError(f"--garments: found dress and {layers[LOWER]}; wanted a dress alone, or a top with it")
    return [layers[k] for k in sorted(layers)]


def choose(people: list[blazepose.Person], person: int | None) -> tuple[blazepose.Person, list[str]]:
    """The wanted person, and a note when there was a choice."""
    if not people:
        raise UserError("photo: no person found; wanted one person, seen from head to knees or more")
    if person is not None and not 1 <= person <= len(people):
        raise UserError(f"--person: found {person}; wanted 1 to {len(people)} (people by size, the largest first)")
    if person is None and len(people) > 1:
        return people[0], [f"{len(people)} people found: the largest was taken; choose another with --person"]
    return people[(person or 1) - 1], []


def cut_off(landmarks: np.ndarray, size: tuple[int, int]) -> list[str]:
    """A note on the parts whose landmarks lie outside of the photo."""
    h, w = size
    inside = (landmarks[:, 0] > 0) & (landmarks[:, 0] < w) & (landmarks[:, 1] > 0) & (landmarks[:, 1] < h)
    parts = [part for part, points in CUT_PARTS.items() if not inside[list(points)].any()]
    return [f"person cut off by the photo's border: {', '.join(parts)} not seen"] if parts else []


@dataclass(frozen=True)
class Seen:
    """Masks at the photo's size."""

    person: np.ndarray
    """(H, W) float32."""
    layers: dict[str, np.ndarray]
    """Name -> (H, W) bool."""
    ignore: np.ndarray
    """(H, W) bool."""


def assemble(
    image: np.ndarray, window: Window, soft: np.ndarray, body: BodyMap, parsed: Parsed, outfit: Outfit
) -> Seen:
    """The window's split as crisp, clean masks of the photo's size."""
    person, labels = sharpen(image, window, soft, parsed.belief)
    labels = tidy(labels)
    x0, y0, x1, y1 = window.box
    hides = cv2.resize(before_garments(body).astype(np.uint8), (x1 - x0, y1 - y0), interpolation=cv2.INTER_NEAREST) > 0
    ignore = np.isin(labels, (HAIR, SHOE)) | ((labels == SKIN) & hides)
    # An upper garment that nobody asked for hides what is under it; an unnamed lower one hides nothing.
    ignore |= np.isin(labels, [layer for layer in (JACKET, TOP) if layer not in outfit.names])

    def whole(part: np.ndarray) -> np.ndarray:
        out = np.zeros(image.shape[:2], part.dtype)
        out[y0:y1, x0:x1] = part
        return out

    return Seen(whole(person), {n: whole(labels == layer) for layer, n in outfit.names.items()}, whole(ignore))


def enlarged(seen: Seen, size: tuple[int, int]) -> Seen:
    """The masks at ``size`` (H, W)."""
    if seen.person.shape == size:
        return seen

    def grow(mask: np.ndarray) -> np.ndarray:
        return cv2.resize(mask.astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)

    return Seen(grow(seen.person), {n: grow(m) > 0.5 for n, m in seen.layers.items()}, grow(seen.ignore) > 0.5)


def before_garments(body: BodyMap) -> np.ndarray:
    """(h, w) bool: where skin may hide a garment: hands, and bare arms before the trunk or the legs."""
    arm = (body.part == ARM_L) | (body.part == ARM_R)
    return (body.hand < 1.3) | (arm & (body.arm > 1.95)) | (arm & (np.abs(body.across) < 1.0) & (body.up < 0.8))


def with_masks(seen: Seen, masks: Mapping[str, Tensor]) -> Seen:
    """The user's masks in place of the split's, for the names that they hold."""
    own = {name: mask.cpu().numpy().astype(bool) for name, mask in masks.items()}
    if not own:
        return seen
    taken = np.logical_or.reduce(list(own.values()))
    layers = {name: own.get(name, mask & ~taken) for name, mask in seen.layers.items()}
    return Seen(np.maximum(seen.person, taken.astype(np.float32)), layers, seen.ignore & ~taken)


def doubts(seen: Seen, confidence: dict[str, float]) -> list[str]:
    """Notes on garments that were not found or that hardly differ from their neighbours."""
    notes = []
    for name, mask in seen.layers.items():
        if mask.sum() < 0.003 * (seen.person > 0.5).sum():
            notes.append(f"{name}: hardly any of it found; give its mask with --masks")
        elif confidence[name] < 0.45:
            sure = f"confidence {confidence[name]:.2f}"
            notes.append(f"{name}: its mask is uncertain ({sure}); check the overlay or give --masks")
    return notes
