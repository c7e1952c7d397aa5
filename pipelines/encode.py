"""Any garment mesh to a code: ``recon encode garment.obj --out out/garment`` (DrapeNet §3.1).

The mesh is read and repaired, put where the decoder expects garments (on the neutral body, y up, facing +z), encoded in
one pass and refined by descent. What had to be guessed is tried and told; a distance says how well the decoder knows
such garments.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from recon.files.atomic import write_whole
from recon.files.meshes import write_obj
from recon.files.user_garments import read_garment_mesh
from recon.files.weights import read_manifest, read_weights
from recon.garments import COMMON
from recon.garments.latents import nearest
from recon.garments.udf import FAMILIES, UdfDecoder, family_of, load_udf
from recon.garments.udf_codes import CodeSearch, best_start, refined
from recon.metrics import sample_surface, surface_distance
from recon.types import Mesh, UserError

FEW, MANY = 2000, 10000
"""Surface points: to choose among guesses, and for the code."""
BESIDE, FINALISTS = 3, 4
"""Learned codes that are asked beside each guess's own; guesses for which all of them are."""
PRIOR = 1e-3
"""Weight of the codes' prior in refinement."""
WELL, ROUGHLY = 1.5, 3.0
"""Distances, as multiples of what unseen garments of the data set have, up to which a garment is known so well."""


@dataclass(frozen=True)
class Encode:
    """Settings of ``recon encode``."""

    mesh: tuple[Path, ...]
    """The garment: OBJ, PLY, STL, OFF or GLB; an open surface."""
    kind: str = "auto"
    """Garment kind: top, dress, trousers or skirt; auto = the one that fits best."""
    unit: Literal["auto", "m", "cm", "mm", "inch"] = "auto"
    """The file's unit; auto = by the garment's size."""
    up: Literal["auto", "y", "z"] = "auto"
    """The file's upward axis; auto = the one that fits better."""
    place: Literal["auto", "keep"] = "auto"
    """Move the garment to where the decoder expects it, or keep it where it is (on the neutral body)."""
    weights: Path | None = None
    """Folder of weights; None = those that ship."""
    refine: int = 60
    """Steps of descent after encoding; 0 = the encoder's code as it is."""
    resolution: int = 128
    """Cells along the longest side for the decoded mesh."""
    out: Path | None = None
    """Folder for the code (code.json) and both meshes; None = only tell."""
    seed: int = 0
    """Seed of the surface points."""


@dataclass(frozen=True)
class Guess:
    """One way to take a mesh."""

    decoder: UdfDecoder
    up: str
    turned: bool
    """Turned half round the vertical axis."""
    moved: bool
    shift: Tensor
    """(3,) [m]."""
    points: Tensor
    """(N, 3) in place [m]."""
    latent: Tensor
    misfit: float
    """How far the decoder's field is from the mesh's, in units of δ."""


def encode(config: Encode) -> dict[str, Any]:
    """Encode; returns what was found, and writes it where ``out`` says.

    Returns:
        ``kind``, ``latent``, ``distance_mm`` (the mesh's points to the decoded field), ``known`` (well, roughly,
        hardly), ``nearest`` learned variant, ``up``, ``turned``, ``shift`` [m] and ``notes``; with ``out`` also
        ``surface_mm``, exact distances between both meshes.

    Raises:
        UserError: the mesh is no open garment, settings are unknown, or the folder has another garment's code.
    """
    if len(config.mesh) != 1:
        raise UserError(f"recon encode: found {len(config.mesh)} files, wanted one mesh")
    if config.kind != "auto" and config.kind not in COMMON:
        raise UserError(f"garment kind: found {config.kind!r}, wanted auto or one of {', '.join(COMMON)}")
    path = config.mesh[0]
    mesh, notes = read_garment_mesh(path, config.unit)
    target = None if config.out is None else config.out / "code.json"
    if target is not None and target.exists():
        raise UserError(f"{target}: is there already, wanted a new folder; nothing was overwritten")
    best = _best(config, mesh)
    generator = torch.Generator().manual_seed(config.seed)
    placed = _turn(mesh, best.up, best.turned)
    placed = placed.with_vertices(placed.vertices + best.shift)
    points = sample_surface(placed, MANY, generator)[0]
    latent = best.decoder.encode(points)
    if config.refine:
        latent = _searched(config, best.decoder, latent, points)
    notes += _told(config, best)
    found = _report(config, best, latent, points) | {"mesh": str(path), "notes": notes}
    if target is not None:
        found |= _write(config, target, best.decoder, latent, placed, found)
    return found


def _best(config: Encode, mesh: Mesh) -> Guess:
    """The guess whose decoded field is closest to the mesh: of the best few by their encoded codes and the learned
    ones beside those, the best by all learned codes."""
    kinds = list(COMMON) if config.kind == "auto" else [config.kind]
    ups = ("y", "z") if config.up == "auto" else (config.up,)
    families = {family_of(k): k for k in kinds}
    there = {name: kind for name, kind in families.items() if f"udf-{name}" in read_manifest(config.weights)}
    decoders = [load_udf(kind, config.weights) for kind in (there or families).values()]
    guesses = []
    for decoder in decoders:
        if config.kind == "auto":
            decoder = UdfDecoder(decoder.nets, decoder.all_codes, decoder.known, sided=decoder.sided)
        for up in ups:
            for turned in (False, True):
                guesses += _places(config, decoder, _turn(mesh, up, turned), up, turned)
    guesses = sorted(guesses, key=lambda guess: guess.misfit)[:FINALISTS]
    if len(guesses) == 1:
        return guesses[0]
    return min(guesses, key=lambda g: _start(config, g.decoder, g.latent, g.points)[1])


def _learned(config: Encode, decoder: UdfDecoder) -> Tensor:
    """(n, Z) learned codes of the kind, or of the whole family where none is named."""
    return decoder.all_codes if config.kind == "auto" else decoder.codes


def _start(config: Encode, decoder: UdfDecoder, latent: Tensor, points: Tensor) -> tuple[Tensor, float]:
    """The best of a code and all learned ones, and its misfit."""
    codes = torch.cat([latent[None], _learned(config, decoder)])
    return best_start(decoder, codes, decoder.spread(points), decoder.nets.shape.reach)


def _searched(config: Encode, decoder: UdfDecoder, latent: Tensor, points: Tensor) -> Tensor:
    """The code refined, from the encoder's and from the learned one that fits best; the better of both ends."""
    reach, how = decoder.nets.shape.reach, CodeSearch(config.refine, far=0.1, stay=0.0, prior=PRIOR)
    start = _start(config, decoder, latent, points)[0]
    starts, points = [latent] if torch.equal(start, latent) else [latent, start], decoder.spread(points)
    ends = torch.stack([refined(decoder, z, points, reach, how) for z in starts])
    return best_start(decoder, ends, points, reach)[0]


def _places(config: Encode, decoder: UdfDecoder, mesh: Mesh, up: str, turned: bool) -> list[Guess]:
    points = sample_surface(mesh, FEW, torch.Generator().manual_seed(config.seed))[0]
    guesses = [_guess(config, decoder, points, torch.zeros(3), up, turned)]
    if config.place == "auto":
        shape = decoder.nets.shape
        middle = (points.amax(0) + points.amin(0)) / 2
        high = points.new_tensor(shape.high) - points.amax(0) - 0.03  # the tallest reach the box's top
        for drop in (0.0, 0.04, 0.08, 0.14):
            shift = points.new_tensor(shape.centre) - middle
            shift[1] = high[1] - drop
            guesses.append(replace(_guess(config, decoder, points, shift, up, turned), moved=True))
    return guesses


def _guess(config: Encode, decoder: UdfDecoder, points: Tensor, shift: Tensor, up: str, turned: bool) -> Guess:
    at, reach = points + shift, decoder.nets.shape.reach
    latent = decoder.encode(at)
    codes = _learned(config, decoder)
    beside = codes[nearest(codes, latent, BESIDE)]
    latent, misfit = best_start(decoder, torch.cat([latent[None], beside]), decoder.spread(at), reach)
    return Guess(decoder, up, turned, False, shift, at, latent, misfit)


def _turn(mesh: Mesh, up: str, turned: bool) -> Mesh:
    """The mesh with y up and, if ``turned``, its back in front."""
    x, y, z = mesh.vertices.unbind(1)
    if up == "z":
        y, z = z, -y
    if turned:
        x, z = -x, -z
    return mesh.with_vertices(torch.stack([x, y, z], 1))


def _told(config: Encode, best: Guess) -> list[str]:
    notes = []
    if config.up == "auto" and best.up == "z":
        notes.append("read as z up, which fits better; --up says otherwise")
    if best.turned:
        notes.append("turned half round: it faced the other way")
    if best.moved:
        x, y, z = (1e3 * v for v in best.shift.tolist())
        notes.append(f"moved by {x:.0f}, {y:.0f}, {z:.0f} mm onto the neutral body; --place keep says otherwise")
    return notes


def _report(config: Encode, best: Guess, latent: Tensor, points: Tensor) -> dict[str, Any]:
    decoder = best.decoder
    with torch.no_grad():
        distance = 1e3 * float(decoder.field(latent)(decoder.spread(points)).mean())
    alike = int(nearest(decoder.all_codes, latent)[0])
    kind = decoder.known[alike].kind if config.kind == "auto" else config.kind
    card = read_weights(f"udf-{family_of(kind)}", config.weights).card
    usual = float(card.get("metrics", {}).get("unseen", {}).get("field_mm", 0.0))
    share = distance / usual if usual else float("nan")
    known = "well" if share <= WELL else "roughly" if share <= ROUGHLY else "hardly" if usual else "not measured"
    return {
        "kind": kind,
        "family": family_of(kind),
        "kinds": list(FAMILIES[family_of(kind)]),
        "decoder": "udf",
        "latent": [round(v, 6) for v in latent.tolist()],
        "distance_mm": round(distance, 3),
        "usual_mm": usual,
        "known": known,
        "nearest": decoder.known[alike].variant,
        "up": best.up,
        "turned": best.turned,
        "shift": [round(v, 5) for v in best.shift.tolist()],
    }


def _write(
    config: Encode, target: Path, decoder: UdfDecoder, latent: Tensor, placed: Mesh, found: dict[str, Any]
) -> dict[str, Any]:
    """Both meshes and the code, the code last; how far the meshes are apart."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        decoded = decoder.decode(latent, config.resolution).mesh
    generator = torch.Generator().manual_seed(config.seed)
    apart = [
        float(surface_distance(sample_surface(a, 4000, generator)[0], b)[0].mean())
        for a, b in ((placed, decoded), (decoded, placed))
    ]
    more = {"surface_mm": round(500 * sum(apart), 3), "decoded": str(target.parent / "decoded.obj")}
    write_obj(placed, target.parent / "placed.obj", "placed")
    write_obj(decoded, target.parent / "decoded.obj", "decoded")
    write_whole(target, json.dumps(found | more, indent=1, allow_nan=False) + "\n")
    return more
