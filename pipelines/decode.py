"""From a code to a garment file: ``recon decode top 12 --resolution 256 --out top.obj``.

Instead of a code, evidence of the garment may be given: ``recon decode top --fit scan.ply --out top.obj`` searches the
code whose garment explains a mesh, a point cloud or a silhouette.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from pipelines.fit_code import CodeFit, find_code
from pipelines.garment_source import latent_of
from recon.files.codes import write_code
from recon.files.meshes import write_mesh, write_textured_glb
from recon.files.patterns import write_svg
from recon.files.textures import read_texture, write_png
from recon.garments import GarmentDecoder, load_decoder
from recon.garments.textures import Sheet, template, unsewn
from recon.metrics import boundary_loops
from recon.types import Garment, UserError

FORMATS = (".obj", ".ply", ".glb")
PATTERN_RESOLUTION = 128
"""Most cells of the grid that patterns for editing are cut on."""
RESOLUTIONS = (16, 1024)
"""Least and most cells along the domain's side."""


@dataclass(frozen=True)
class Decode:
    """Settings of ``recon decode``."""

    what: tuple[str, ...]
    """KIND and CODE: top, skirt, trousers or dress; a learned code's number, mean, random:SEED or a code file. With
    ``fit`` the KIND alone."""
    out: Path
    """File to write: .obj (keeps the panels as texture coordinates [m]), .ply or .glb."""
    resolution: int = 256
    """Cells of the cutting grid along the domain's side; 128 = 9-11 mm, 256 = half of that."""
    decoder: str = "isp"
    """Decoder to use: isp (sewing patterns) or udf (distance fields, without panels)."""
    weights: Path | None = None
    """Folder of your own weights; None = those that ship."""
    code: Path | None = None
    """Also write the code to this .json file, which commands take as CODE."""
    pattern: Path | None = None
    """Also write the panels to this .svg file, at true scale; ``recon edit`` reads it back."""
    texture: Path | None = None
    """Image to put on the panels (front left, back right; twice as wide as high); for .glb files."""
    template: Path | None = None
    """Also write an image of the panels' outlines to draw a texture on (.png)."""
    fit: Path | None = None
    """Evidence to find the code from: a mesh (obj, ply, stl, off, glb) or points (ply, npy, xyz, txt), at rest on the
    neutral body in metres; or the garment's silhouette (png, jpg) as the neutral body wears it, seen by the camera of
    ``pipelines.fit_evidence.front_camera``."""
    search: CodeFit = field(default_factory=CodeFit)
    """How the code is searched."""


def decode(config: Decode, tick: Callable[[int, float], None] | None = None) -> dict:
    """Decode, write, and return the figures: vertices, faces, open borders and the time [ms]; of a fit, how near it is.

    Raises:
        UserError: no such kind, code or format, a resolution out of range, or evidence that can't be read; nothing is
            written then.
    """
    wanted = 2 if config.fit is None else 1
    if len(config.what) != wanted:
        form = "KIND CODE, such as top mean" if wanted == 2 else "KIND alone with --fit"
        raise UserError(f"decode: found {' '.join(config.what)!r}; wanted {form}")
    check(config.out, config.resolution)
    if config.fit is not None and config.fit.exists() and config.out.exists() and config.fit.samefile(config.out):
        raise UserError(f"{config.out}: is the evidence; wanted another file to write")
    if config.texture is not None and config.out.suffix.lower() != ".glb":
        raise UserError(f"{config.out}: ends in {config.out.suffix!r}; wanted .glb with --texture")
    if config.pattern is not None and config.decoder != "isp":
        raise UserError(f"--pattern: garments of --decoder {config.decoder} have no panels; wanted --decoder isp")
    decoder = load_decoder(config.what[0], config.decoder, folder=config.weights)
    if config.fit is None:
        texture = None if config.texture is None else read_texture(config.texture)
        latent = latent_of(decoder, config.what[1])
        garment, said = finish(decoder, latent, config)
        _painted(config, decoder, garment, texture)
        return said
    return _fitted(config, decoder, config.fit, tick)


def _painted(config: Decode, decoder: GarmentDecoder, garment: Garment, texture: Tensor | None) -> None:
    """Write the template, and the garment with its texture."""
    if texture is None and config.template is None:
        return
    from recon.garments.isp import IspDecoder

    if not isinstance(decoder, IspDecoder):
        raise UserError(f"decoder: found {config.decoder}; textures wanted isp")
    sheet = Sheet.of(decoder.nets.shape)
    if texture is not None:
        write_textured_glb(unsewn(garment), sheet.coordinates(garment), texture, config.out)
    if config.template is not None:
        write_png(config.template, template(garment, sheet))


def _fitted(config: Decode, decoder: GarmentDecoder, fit: Path, tick: Callable[[int, float], None] | None) -> dict:
    from pipelines.fit_evidence import Bank, evidence_of
    from recon.garments.isp import IspDecoder

    if not isinstance(decoder, IspDecoder):
        raise UserError(f"decoder: found {config.decoder}; --fit wanted isp (recon encode finds codes of udf)")
    evidence = evidence_of(decoder, fit, config.search.seed)
    begun = time.perf_counter()
    starts = evidence.starts(Bank(decoder))
    found = find_code(decoder, evidence, decoder.codes[starts], config.search, tick)
    spent = time.perf_counter() - begun
    said = finish(decoder, found.latent, config)[1]
    evidence.renew(found.latent)
    figures = {k: round(v, 3) for k, v in evidence.figures(found.latent).items()}
    return {**said, **figures, "search_s": round(spent, 1), "start": starts[found.start]}


def check(out: Path, resolution: int) -> None:
    """UserError where file or resolution can't be written, before anything is computed."""
    if out.suffix.lower() not in FORMATS:
        raise UserError(f"{out}: ends in {out.suffix!r}; wanted one of {', '.join(FORMATS)}")
    low, high = RESOLUTIONS
    if not low <= resolution <= high:
        raise UserError(f"resolution: found {resolution}; wanted {low} to {high}")


@runtime_checkable
class Outputs(Protocol):
    """Settings that say what to write."""

    @property
    def out(self) -> Path: ...
    @property
    def resolution(self) -> int: ...
    @property
    def code(self) -> Path | None: ...
    @property
    def pattern(self) -> Path | None: ...


def finish(decoder: GarmentDecoder, latent: Tensor, wanted: Outputs) -> tuple[Garment, dict]:
    """Decode one code (z,), write the garment and perhaps the code and the pattern; the garment and its figures."""
    begun = time.perf_counter()
    with torch.no_grad():
        garment = decoder.decode(latent, wanted.resolution)
    spent = time.perf_counter() - begun
    write_mesh(garment, wanted.out)
    if wanted.code is not None:
        write_code(wanted.code, decoder.kind, latent, decoder.name)
    if wanted.pattern is not None:
        with torch.no_grad():  # coarse outlines are what people can edit
            write_svg(decoder.decode(latent, min(wanted.resolution, PATTERN_RESOLUTION)), wanted.pattern)
    return garment, {"file": str(wanted.out), **summary(garment), "decode_ms": round(1e3 * spent)}


def summary(garment: Garment) -> dict:
    """What a decoded garment is: its variant, its size and how many open borders it has."""
    faces = garment.mesh.faces
    return {
        "variant": garment.variant,
        "vertices": len(garment.mesh.vertices),
        "faces": len(faces),
        "open_borders": boundary_loops(faces),
    }
