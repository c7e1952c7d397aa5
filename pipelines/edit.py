"""Edit a garment through its pattern: ``recon edit top:12 --sleeve 0.6 --length 1.2 --open --out new.obj``.

Or with any vector program: ``recon decode top 12 --out a.obj --pattern a.svg``, edit the outlines, then
``recon edit top:12 --svg a.svg --out new.obj``. Either way the code is sought whose panels have the edited outline
(ISP Eq. 12), and the surface map drapes the new panels. Garments without panels, of ``--decoder udf``, are edited by
their codes: ``--attributes length=1`` (see ``edit_attributes``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from matplotlib.path import Path as Polygon
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.decode import check, finish
from pipelines.edit_attributes import extent, read_amounts, with_attributes
from pipelines.fit_code import CodeFit, find_code
from pipelines.fit_evidence import PatternEvidence
from pipelines.garment_source import latent_of
from pipelines.isp_samples import Outline
from recon.files.pattern_reading import read_svg
from recon.garments import load_decoder
from recon.garments.isp import IspDecoder, load_isp
from recon.garments.latents import editing_direction
from recon.garments.outlines import (
    LENGTHS,
    Loop,
    closed,
    known_parameters,
    opened,
    panel_loops,
    with_length,
    with_sleeves,
)
from recon.types import UserError

OPENING = 0.055
"""Width of a cut in front, where the training set has no open garment [m]."""


@dataclass(frozen=True)
class Edit:
    """Settings of ``recon edit``."""

    what: tuple[str, ...]
    """The garment as KIND:CODE: a learned code's number, mean, random:SEED or a code file."""
    out: Path
    """File to write: .obj, .ply or .glb."""
    svg: Path | None = None
    """Edited pattern of this garment (``recon decode --pattern``)."""
    sleeve: float | None = None
    """Sleeves so many times as long, measured from the shoulder."""
    length: float | None = None
    """The garment so many times as long, measured from its top."""
    open: bool = False
    """Cut it open in front."""
    close: bool = False
    """Close an open front."""
    attributes: tuple[str, ...] = ()
    """Without a pattern: more or less of sleeves, length or opening, as in length=-1 opening=1.5; 1 is a standard
    deviation of what changes in the code."""
    decoder: str = "isp"
    """Whose code it is: isp or udf (for ``attributes`` alone: its garments have no pattern)."""
    resolution: int = 256
    """Cells of the cutting grid along the domain's side."""
    code: Path | None = None
    """Also write the new code to this .json file."""
    pattern: Path | None = None
    """Also write the new panels to this .svg file."""
    weights: Path | None = None
    """Folder of your own weights; None = those that ship."""
    search: CodeFit = field(default_factory=lambda: CodeFit(rounds=8, prior=1e-3))
    """How the code is searched."""


def edit(config: Edit, tick: Callable[[int, float], None] | None = None) -> dict:
    """Find the code of the edited pattern, write its garment, and return how near the outline came [mm].

    Raises:
        UserError: no such garment, nothing to edit, an edit that this garment can't have, or a bad pattern file;
            nothing is written then.
    """
    kind, _, name = " ".join(config.what).partition(":")
    if not name:
        raise UserError(f"edit: found {' '.join(config.what)!r}; wanted KIND:CODE, such as top:12")
    check(config.out, config.resolution)
    _unharmed(config)
    if kind not in LENGTHS:
        raise UserError(f"garment kind: found {kind!r}, wanted one of {', '.join(LENGTHS)}")
    if config.attributes:
        return _by_attributes(config, kind, name)
    if config.decoder != "isp":
        raise UserError(f"edit: garments of --decoder {config.decoder} have no pattern to edit; wanted --attributes")
    decoder = load_isp(kind, config.weights)
    latent = latent_of(decoder, name)
    wanted = wanted_outline(config, decoder, latent)
    begun = time.perf_counter()
    evidence = PatternEvidence(decoder, [outline(decoder, loops) for loops in wanted], seed=config.search.seed)
    starts = torch.cat([_moved(config, decoder, latent), decoder.codes[evidence.starts()]])
    found = find_code(decoder, evidence, starts, config.search, tick)
    spent = time.perf_counter() - begun
    said = finish(decoder, found.latent, config)[1]
    return {**said, **outline_error(decoder, found.latent, wanted), "search_s": round(spent, 1)}


def _by_attributes(config: Edit, kind: str, name: str) -> dict:
    """Edit the code itself; what each attribute's regression found, and the garment's extent before and after [m]."""
    if config.svg or config.sleeve or config.length or config.open or config.close:
        raise UserError("edit: found --attributes and an edit of the pattern; wanted one of them")
    if config.pattern is not None and config.decoder != "isp":
        raise UserError(f"--pattern: garments of --decoder {config.decoder} have no panels")
    amounts = read_amounts(config.attributes)
    decoder = load_decoder(kind, config.decoder, folder=config.weights)
    latent = latent_of(decoder, name)
    edited, found = with_attributes(decoder, latent, amounts)
    with torch.no_grad():
        before = decoder.decode(latent, config.resolution)
    garment, said = finish(decoder, edited, config)
    sizes = {"before": extent(before.mesh.vertices), "after": extent(garment.mesh.vertices)}
    return {**said, "attributes": found, "extent": sizes}


def _unharmed(config: Edit) -> None:
    given = config.svg
    for path in (config.out, config.code, config.pattern):
        if given is not None and path is not None and path.exists() and given.exists() and path.samefile(given):
            raise UserError(f"{path}: is the edited pattern; wanted another file to write")


def wanted_outline(config: Edit, decoder: IspDecoder, latent: Tensor) -> list[list[Loop]]:
    """Each panel's loops after the edit, panel coordinates [m].

    Raises:
        UserError: no edit, one that this garment can't have, or panels beyond what the decoder knows.
    """
    for name, factor in (("sleeve", config.sleeve), ("length", config.length)):
        if factor is not None and not 0 < factor < 10:
            raise UserError(f"{name}: found {factor:g}; wanted a factor such as 0.6")
    with torch.no_grad():
        panels = panel_loops(decoder.decode(latent, 128))
    if config.svg is not None:
        panels = read_svg(config.svg, decoder.nets.shape.panel_names)
    elif config.sleeve is None and config.length is None and not config.open and not config.close:
        raise UserError("edit: nothing to do; wanted --svg, --sleeve, --length, --open or --close")
    known = known_parameters(decoder.codes, decoder.parameters, latent)
    if config.close:
        panels = closed(panels)
    if config.sleeve is not None:
        panels = with_sleeves(panels, config.sleeve, known)
    if config.length is not None:
        panels = with_length(panels, config.length, decoder.kind, known)
    if config.open:
        if decoder.kind != "top":
            raise UserError(f"open: a {decoder.kind} has no open form; wanted a top")
        panels = opened(panels, _opening(decoder))
    shape = decoder.nets.shape
    reach = max(float(np.abs(loop - shape.centre).max()) for loops in panels for loop in loops)
    if reach > shape.half:
        raise UserError(
            f"edit: reaches {100 * (reach - shape.half):.0f} cm beyond the patterns that {decoder.kind} knows"
        )
    return panels


def _opening(decoder: IspDecoder) -> float:
    known = [p["opening"] for p in decoder.parameters if p.get("opening")]
    return float(np.median(known)) if known else OPENING


def _moved(config: Edit, decoder: IspDecoder, latent: Tensor) -> Tensor:
    """(K, z) the code itself, and moved along the directions that the training set's parameters know."""
    known = known_parameters(decoder.codes, decoder.parameters, latent)
    moved = latent.clone()
    if config.length is not None:
        top = known[LENGTHS[decoder.kind].top]
        moved += _along(decoder, "hem_y", (1 - config.length) * (top - known["hem_y"]))
    if config.sleeve is not None and "shoulder_x" in known:
        moved += _along(decoder, "sleeve_x", (config.sleeve - 1) * (known["sleeve_x"] - known["shoulder_x"]))
    return torch.stack([latent, moved])


def _along(decoder: IspDecoder, name: str, change: float) -> Tensor:
    has = [k for k, p in enumerate(decoder.parameters) if name in p]
    values = torch.tensor([decoder.parameters[k][name] for k in has])
    return change * editing_direction(decoder.codes[has], values)


def outline(decoder: IspDecoder, loops: list[Loop]) -> Outline:
    """Loops in panel coordinates [m] as an outline in the decoder's domain; labels unknown (0)."""
    shape = decoder.nets.shape
    inside = [(loop - shape.centre) / shape.half for loop in loops]
    start = np.concatenate(inside)
    end = np.concatenate([np.roll(loop, -1, 0) for loop in inside])
    return Outline(start, end, np.zeros(len(start), np.int64), [Polygon(loop) for loop in inside])


def outline_error(decoder: IspDecoder, latent: Tensor, wanted: list[list[Loop]]) -> dict[str, float]:
    """Eq. 12's Chamfer distance: mean and 95th percentile between the code's outline and the wanted one [mm]."""
    with torch.no_grad():
        found = panel_loops(decoder.decode(latent, 256))
    away = []
    for a, b in zip(found, wanted, strict=True):
        p, q = (np.concatenate([dense(loop) for loop in loops]) for loops in (a, b))
        away += [cKDTree(p).query(q)[0], cKDTree(q).query(p)[0]]
    both = 1e3 * np.concatenate(away)
    return {"outline_mm": round(float(both.mean()), 2), "outline_p95_mm": round(float(np.quantile(both, 0.95)), 2)}


def dense(loop: Loop, step: float = 1e-3) -> Loop:
    """Points along a closed loop, at most ``step`` [m] apart."""
    ahead = np.roll(loop, -1, 0)
    counts = np.maximum(1, np.ceil(np.linalg.norm(ahead - loop, axis=1) / step)).astype(int)
    return np.concatenate(
        [a + (b - a) * (np.arange(n)[:, None] / n) for a, b, n in zip(loop, ahead, counts, strict=True)]
    )
