"""Garments to learn draping on: many of a kind, coarse, ready for physics."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, islice, repeat

import torch
from torch import Tensor

from recon.bodies import Body
from recon.cloth.energies import Cloth
from recon.cloth.frames import FramePhysics, FrameWeights
from recon.cloth.inextensible import OneRings
from recon.draping.dress import held_vertices
from recon.garments import GarmentDecoder, load_decoder
from recon.metrics import largest_stretch
from recon.types import Garment, Mesh

TORN = 2.5
"""Nowhere is a garment that can be worn so many times longer than it was cut."""
NEIGHBOURS = 8
"""A code between two others is drawn between one and one of its so many nearest: clean garments, all of them new."""


def between(codes: Tensor, generator: torch.Generator) -> Tensor:
    """A random code (z,) on the way between two neighbouring learned ones (n, z)."""
    one = codes[int(torch.randint(len(codes), (), generator=generator))]
    near = (codes - one).square().sum(1).topk(min(NEIGHBOURS + 1, len(codes)), largest=False).indices[1:]
    other = codes[near[int(torch.randint(len(near), (), generator=generator))]] if len(near) else one
    share = torch.rand((), generator=generator)
    return one + share * (other - one)


def wearable(garment: Garment) -> bool:
    """Whether it came whole: coarse grids leave straps unsewn, and between codes of unlike garments a seam may be sewn
    to the wrong places."""
    sewn = all(bool((garment.border_labels == k).any()) for k in shoulder_seams(garment))
    return sewn and float(largest_stretch(garment).max()) < TORN


def garments_of(decoder: GarmentDecoder, count: int, vertices: int, generator: torch.Generator) -> list[Garment]:
    """``count`` garments of about so many vertices each: half random learned codes, half between learned ones."""
    chosen = torch.randperm(len(decoder.codes), generator=generator)[: (count + 1) // 2]
    codes = chain(decoder.codes[chosen], (between(decoder.codes, generator) for _ in repeat(None)))
    with torch.no_grad():
        decoded = (decoder.decode(code, resolution_for(decoder, code, vertices)) for code in codes)
        return list(islice(filter(wearable, decoded), count))


def resolution_for(decoder: GarmentDecoder, code: Tensor, vertices: int) -> int:
    """Cells of the grid that cut the garment of a code (z,) into about so many vertices."""
    found = len(decoder.decode(code, 64).mesh.vertices)
    return max(24, round(64 * (vertices / found) ** 0.5))


def shoulders(garment: Garment) -> Tensor:
    """(H,) vertices of the seams on shoulders and arms, which clothes hang on that no waistband holds."""
    labels = torch.tensor(shoulder_seams(garment), dtype=torch.long)
    return garment.vertex_of_point[torch.isin(garment.border_labels, labels)].unique()


def shoulder_seams(garment: Garment) -> list[int]:
    """Their labels."""
    return [k for k, name in enumerate(garment.seam_names) if name.startswith("shoulder")]


@dataclass(frozen=True)
class Wardrobe:
    """Garments of one kind with their physics, all on the same posed bodies."""

    garments: list[Garment]
    cloths: list[Cloth]
    physics: list[FramePhysics]
    held: list[Tensor]
    """Vertices of each waistband, empty where nothing holds it."""
    hung: list[Tensor]
    """Vertices of each one's shoulder seams, empty where it has none."""

    @classmethod
    def of(cls, garments: list[Garment], body: Body, weights: FrameWeights, frames: int) -> Wardrobe:
        """``frames``: bodies at a time."""
        rest = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
        cloths = [Cloth.from_garment(g) for g in garments]
        rings = [OneRings.of(g.mesh.vertices, g.mesh.faces) for g in garments]
        first = FramePhysics(cloths[0], rings[0], rest, weights, frames)
        physics = [first, *(first.dressed(c, r) for c, r in zip(cloths[1:], rings[1:], strict=True))]
        held = [torch.as_tensor(held_vertices(g)) for g in garments]
        return cls(garments, cloths, physics, held, [shoulders(g) for g in garments])

    @classmethod
    def decoded(
        cls, kind: str, count: int, vertices: int, body: Body, weights: FrameWeights, frames: int, seed: int
    ) -> Wardrobe:
        """``count`` garments of a kind's shipped decoder, of about so many vertices."""
        decoder = load_decoder(kind)
        generator = torch.Generator().manual_seed(seed)
        return cls.of(garments_of(decoder, count, vertices, generator), body, weights, frames)
