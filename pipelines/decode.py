"""From a code to a garment file: ``recon decode top 12 --resolution 256 --out top.obj``."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pipelines.garment_source import latent_of
from recon.files.codes import write_code
from recon.files.meshes import write_mesh
from recon.garments import GarmentDecoder, load_decoder
from recon.metrics import boundary_loops
from recon.types import Garment, UserError

FORMATS = (".obj", ".ply", ".glb")
RESOLUTIONS = (16, 1024)
"""Least and most cells along the domain's side."""


@dataclass(frozen=True)
class Decode:
    """Settings of ``recon decode``."""

    what: tuple[str, ...]
    """KIND and CODE: top, skirt, trousers or dress; a learned code's number, mean, random:SEED or a code file."""
    out: Path
    """File to write: .obj (keeps the panels as texture coordinates [m]), .ply or .glb."""
    resolution: int = 256
    """Cells of the cutting grid along the domain's side; 128 = 9-11 mm, 256 = half of that."""
    decoder: str = "isp"
    """Decoder to use."""
    weights: Path | None = None
    """Folder of your own weights; None = those that ship."""
    code: Path | None = None
    """Also write the code to this .json file, which commands take as CODE."""


def decode(config: Decode) -> dict:
    """Decode, write, and return the figures: vertices, faces, open borders and the time [ms].

    Raises:
        UserError: no such kind, code or format, or a resolution out of range; nothing is written then.
    """
    if len(config.what) != 2:
        raise UserError(f"decode: found {' '.join(config.what)!r}; wanted KIND CODE, such as top mean")
    kind, name = config.what
    check(config.out, config.resolution)
    decoder = load_decoder(kind, config.decoder, folder=config.weights)
    return finish(decoder, latent_of(decoder, name), config.resolution, config.out, config.code)


def check(out: Path, resolution: int) -> None:
    """UserError where file or resolution can't be written, before anything is computed."""
    if out.suffix.lower() not in FORMATS:
        raise UserError(f"{out}: ends in {out.suffix!r}; wanted one of {', '.join(FORMATS)}")
    low, high = RESOLUTIONS
    if not low <= resolution <= high:
        raise UserError(f"resolution: found {resolution}; wanted {low} to {high}")


def finish(decoder: GarmentDecoder, latent: Tensor, resolution: int, out: Path, code: Path | None) -> dict:
    """Decode one code (z,), write the garment and perhaps the code; the figures."""
    begun = time.perf_counter()
    with torch.no_grad():
        garment = decoder.decode(latent, resolution)
    spent = time.perf_counter() - begun
    write_mesh(garment, out)
    if code is not None:
        write_code(code, decoder.kind, latent)
    return {"file": str(out), **summary(garment), "decode_ms": round(1e3 * spent)}


def summary(garment: Garment) -> dict:
    """What a decoded garment is: its variant, its size and how many open borders it has."""
    faces = garment.mesh.faces
    return {
        "variant": garment.variant,
        "vertices": len(garment.mesh.vertices),
        "faces": len(faces),
        "open_borders": boundary_loops(faces),
    }
