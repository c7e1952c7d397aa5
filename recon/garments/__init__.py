"""Garment decoders, sewing patterns and their latent spaces."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from recon.types import Garment, UserError

KINDS: dict[str, tuple[str, ...]] = {
    "top": ("tank", "tshirt", "shirt", "jacket"),
    "skirt": ("skirt",),
    "trousers": ("trousers", "shorts"),
    "dress": ("dress",),
    "shirt6": ("tshirt6", "shirt6"),
}
"""Garment kind (one decoder each) -> its variants."""

NAMES: dict[str, tuple[str, tuple[str, ...]]] = {
    "jacket": ("top", ("jacket",)),
    "top": ("top", ("tank", "tshirt", "shirt")),
    "tank": ("top", ("tank",)),
    "tshirt": ("top", ("tshirt",)),
    "shirt": ("top", ("shirt",)),
    "dress": ("dress", ("dress",)),
    "skirt": ("skirt", ("skirt",)),
    "trousers": ("trousers", ("trousers", "shorts")),
    "shorts": ("trousers", ("shorts",)),
}
"""Garment name that a user may give -> its kind and the variants that the name allows."""

COMMON = tuple(dict.fromkeys(kind for kind, _ in NAMES.values()))
"""Kinds that a photo may name, whose weights ship; the others are there to be trained."""

WAISTED = ("trousers", "skirt")
"""Kinds that a waistband holds up."""

DECODERS: dict[str, str] = {"isp": "recon.garments.isp:load_isp", "udf": "recon.garments.udf:load_udf"}
"""Decoder name -> ``module:function`` of (kind, folder, device)."""


@runtime_checkable
class GarmentDecoder(Protocol):
    """What every decoder answers to."""

    codes: Tensor
    """(n, z) learned codes."""
    variants: list[str]
    """The variant of each learned code."""
    parameters: list[dict[str, float]]
    """What the garment of each learned code was cut with, as far as it is known."""
    name: str
    """Key of ``DECODERS``."""

    @property
    def kind(self) -> str:
        """Key of ``KINDS``."""
        ...

    def decode(self, latent: Tensor, resolution: int = 256) -> Garment:
        """One code (z,) -> a sewn garment at rest, vertices differentiable in the code."""
        ...

    def decode_like(self, latent: Tensor, garment: Garment) -> Garment:
        """The same for a code near the one of ``garment``, in the topology of that: cheaper while a code descends."""
        ...


def load_decoder(
    kind: str, name: str = "isp", device: str | torch.device = "cpu", folder: str | Path | None = None
) -> GarmentDecoder:
    """The trained decoder of one kind; ``folder``: the user's own weights, None = those that ship.

    UserError: no such kind or decoder, weights missing or corrupt.
    """
    if kind not in KINDS:
        raise UserError(f"garment kind: found {kind!r}, wanted one of {', '.join(KINDS)}")
    if name not in DECODERS:
        raise UserError(f"decoder: found {name!r}, wanted one of {', '.join(DECODERS)}")
    module, _, function = DECODERS[name].partition(":")
    return getattr(import_module(module), function)(kind, folder, device)
