"""Garments as commands name them: ``KIND:CODE`` of a decoder, ``KIND:train:N`` or ``KIND:test:N`` of the data set, or a
mesh file. A CODE is a learned code's number, ``mean``, ``random:SEED`` or a code file."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from recon.garments import GarmentDecoder
from recon.types import Garment, Mesh, UserError

FORMS = "KIND:NUMBER, KIND:mean, KIND:random:SEED, KIND:FILE.json, KIND:train:N, KIND:test:N or a mesh file"


def load_garment(name: str, resolution: int = 96, decoder: str = "isp", weights: Path | None = None) -> Garment | Mesh:
    """The garment that ``name`` names, at rest on the neutral body; a mesh where it has no panels.

    Args:
        name: see ``FORMS``.
        resolution: cells of the grid that codes are cut on.
        decoder: what makes garments of codes: isp or udf.
        weights: folder of the user's own weights; used where it has the decoder's.

    Raises:
        UserError: no such kind, code, garment or file.
    """
    from recon.files.weights import folder_with
    from recon.garments import KINDS, load_decoder

    kind, _, code = name.partition(":")
    if kind not in KINDS or not code:
        from recon.files.meshes import read_garment

        if Path(name).suffix or Path(name).exists():
            return read_garment(name)
        raise UserError(f"garment: found {name!r}; wanted {FORMS} (KIND: {', '.join(KINDS)})")
    split, _, number = code.partition(":")
    if split in ("train", "test"):
        from recon.garments.dataset import load_garments

        return _pick(name, list(load_garments(kind, split)), number)
    own = folder_with(f"{decoder}-", weights)
    chosen = load_decoder(kind, decoder, folder=own)
    with torch.no_grad():
        return chosen.decode(latent_of(chosen, code), resolution)


def _pick(name: str, items: list, number: str):
    if not number.isdigit() or int(number) >= len(items):
        raise UserError(f"garment: found {name!r}; wanted a number from 0 to {len(items) - 1} at its end")
    return items[int(number)]


def latent_of(decoder: GarmentDecoder, code: str) -> Tensor:
    """The code (z,) that ``code`` names: a learned code's number, ``mean``, ``random:SEED`` or a code file.

    Raises:
        UserError: no such code, or a file of another kind or size.
    """
    from recon.garments.latents import LatentPrior

    word, _, seed = code.partition(":")
    if code == "mean":
        return decoder.codes.mean(0)
    if word == "random" and seed.isdigit():
        return LatentPrior.of(decoder.codes).sample(1, torch.Generator().manual_seed(int(seed)))[0]
    if code.isdigit() and int(code) < len(decoder.codes):
        return decoder.codes[int(code)]
    if Path(code).suffix:
        from recon.files.codes import read_code

        return read_code(code, decoder.kind, decoder.codes.shape[1], decoder.name).to(decoder.codes)
    last = len(decoder.codes) - 1
    raise UserError(f"code: found {code!r}; wanted a number from 0 to {last}, mean, random:SEED or a .json file")
