"""Garments as commands name them: ``KIND:CODE`` of a decoder, ``KIND:train:N`` or ``KIND:test:N`` of the data set, or a
mesh file."""

from __future__ import annotations

from pathlib import Path

import torch

from recon.types import Garment, Mesh, UserError

FORMS = "KIND:NUMBER, KIND:mean, KIND:random:SEED, KIND:train:N, KIND:test:N or a mesh file"


def load_garment(name: str, resolution: int = 96) -> Garment | Mesh:
    """The garment that ``name`` names, at rest on the neutral body; a mesh where it has no panels.

    Args:
        name: see ``FORMS``.
        resolution: cells of the grid that codes are cut on.

    Raises:
        UserError: no such kind, code, garment or file.
    """
    from recon.garments import KINDS

    kind, _, code = name.partition(":")
    if kind not in KINDS or not code:
        from recon.files.meshes import read_mesh

        if Path(name).suffix or Path(name).exists():
            return read_mesh(name)
        raise UserError(f"garment: found {name!r}; wanted {FORMS} (KIND: {', '.join(KINDS)})")
    split, _, number = code.partition(":")
    if split in ("train", "test"):
        from recon.garments.dataset import load_garments

        return _pick(name, list(load_garments(kind, split)), number)
    return _decoded(name, kind, code, resolution)


def _pick(name: str, items: list, number: str):
    if not number.isdigit() or int(number) >= len(items):
        raise UserError(f"garment: found {name!r}; wanted a number from 0 to {len(items) - 1} at its end")
    return items[int(number)]


def _decoded(name: str, kind: str, code: str, resolution: int) -> Garment:
    from recon.garments import load_decoder
    from recon.garments.latents import LatentPrior

    decoder = load_decoder(kind)
    word, _, seed = code.partition(":")
    if code == "mean":
        latent = decoder.codes.mean(0)
    elif word == "random" and seed.isdigit():
        latent = LatentPrior.of(decoder.codes).sample(1, torch.Generator().manual_seed(int(seed)))[0]
    else:
        latent = _pick(name, list(decoder.codes), code)
    with torch.no_grad():
        return decoder.decode(latent, resolution)
