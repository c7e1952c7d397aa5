"""The data set of draped garments: drawing one, and the compact files that they ship in.

A file holds all garments of one kind and split in npz format (no pickles): positions in whole quanta of 0.05 mm,
coded as differences, and the panels that they were cut from. A card (json) beside it says where it comes from.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon.garments.patterns import PANEL_NAMES, SEAM_NAMES
from recon.types import TWO_PANELS, Garment, Mesh, UserError

QUANTUM = 5e-5
"""Resolution of stored positions [m]."""
VARIANTS: dict[str, dict[str, float]] = {
    "top": {"tank": 0.15, "tshirt": 0.30, "shirt": 0.35, "jacket": 0.20},
    "skirt": {"skirt": 1.0},
    "trousers": {"trousers": 0.72, "shorts": 0.28},
    "dress": {"dress": 1.0},
    "shirt6": {"tshirt6": 0.45, "shirt6": 0.55},
}
"""Share of each variant in its kind."""
SPLITS = ("train", "test")
MAX_ATTEMPTS = 8


@dataclass(frozen=True)
class Item:
    """One garment of the data set."""

    garment: Garment
    """At rest on the neutral body."""
    parameters: dict[str, float]
    """The named sizes it was cut from [m]."""
    attempts: int
    """How many were drawn until one passed the gate."""
    rejected: tuple[str, ...]
    """Why the others did not."""
    stretch_p95: float
    """95th percentile of its triangles' largest stretch."""


def draw(room, kind: str, split: str, index: int, seed: int) -> Item:
    """Garment ``index`` of a kind: drawn, cut, draped in ``room`` (a ``FittingRoom``) and passed by the gate.

    The result depends on the arguments alone. Raises ``RuntimeError`` if ``MAX_ATTEMPTS`` in a row fail.
    """
    from recon.garments import patterns

    reasons: list[str] = []
    for attempt in range(MAX_ATTEMPTS):
        key = [seed, list(VARIANTS).index(kind), SPLITS.index(split), index, attempt]
        rng = np.random.default_rng(np.random.SeedSequence(key))
        variant = str(rng.choice(list(VARIANTS[kind]), p=list(VARIANTS[kind].values())))
        parameters = patterns.sample(variant, rng, room.measures)
        try:
            pattern = patterns.cut(variant, parameters)
        except ValueError:
            reasons.append("cut")
            continue
        garment = room.drape(pattern)
        verdict = room.judge(garment)
        if verdict.passed:
            return Item(garment, parameters, attempt + 1, tuple(reasons), verdict.stretch_p95)
        reasons.append(verdict.reason)
    raise RuntimeError(f"{kind} {index} ({split}): {MAX_ATTEMPTS} draws failed: {', '.join(reasons)}")


def write_items(path: Path, kind: str, items: Sequence[Item]) -> None:
    """Write garments of one kind into one file, whole or not at all."""
    garments = [item.garment for item in items]
    columns: dict[str, list[NDArray]] = {
        name: [] for name in ("vertices", "points", "faces", "welds", "labels", "fronts")
    }
    for g in garments:
        faces = g.panel_faces.numpy()
        columns["vertices"].append(_quanta(g.mesh.vertices.numpy()))
        columns["points"].append(_quanta(g.panel_points.numpy()))
        columns["faces"].append(faces.astype(np.uint16))
        columns["welds"].append(g.vertex_of_point.numpy().astype(np.uint16))
        columns["labels"].append(g.border_labels.numpy().astype(np.int8))
        counts = torch.bincount(g.panel_of_face, minlength=len(g.panel_names))
        columns["fronts"].append(counts[:-1].numpy().astype(np.int32))
    arrays: dict[str, NDArray] = {f"count_{k}": np.array([len(a) for a in v], np.int32) for k, v in columns.items()}
    for name in ("vertices", "points", "faces"):
        arrays[name] = _encode(columns[name])
    for name in ("welds",):
        arrays[name] = _encode([a[:, None] for a in columns[name]])
    for name in ("labels", "fronts"):
        arrays[name] = np.concatenate(columns[name])
    meta = {
        "kind": kind,
        "seam_names": list(SEAM_NAMES[kind]),
        "panel_names": list(PANEL_NAMES.get(kind, TWO_PANELS)),
        "variants": [g.variant for g in garments],
        "parameters": [{k: round(v, 6) for k, v in item.parameters.items()} for item in items],
        "attempts": [item.attempts for item in items],
        "rejected": [list(item.rejected) for item in items],
        "stretch_p95": [round(item.stretch_p95, 5) for item in items],
    }
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    _write(path, arrays)


def read_items(path: Path) -> list[Item]:
    """Read what :func:`write_items` wrote. Raises ``UserError`` for anything else."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(arrays["meta"].tobytes())
        columns = {
            name: _decode(arrays[name], arrays[f"count_{name}"], width)
            for name, width in (("vertices", 3), ("points", 2), ("faces", 3), ("welds", 1))
        }
        labels = np.split(arrays["labels"], np.cumsum(arrays["count_labels"])[:-1])
    except FileNotFoundError:
        raise UserError(f"{path}: not found; make it with `recon dataset make`") from None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{path}: no garment file ({type(error).__name__}), wanted one of `recon dataset make`"
        ) from None
    items = []
    panel_names = tuple(meta.get("panel_names", TWO_PANELS))
    fronts = torch.tensor(arrays["fronts"]).long().view(-1, len(panel_names) - 1)
    for i, variant in enumerate(meta["variants"]):
        welds = torch.tensor(columns["welds"][i][:, 0].astype(np.int64) & 0xFFFF)
        faces = torch.tensor(columns["faces"][i].astype(np.int64) & 0xFFFF)
        vertices = torch.tensor((columns["vertices"][i].astype(np.float64) * QUANTUM).astype(np.float32))
        garment = Garment(
            kind=meta["kind"],
            mesh=Mesh(vertices, welds[faces]),
            panel_points=torch.tensor((columns["points"][i].astype(np.float64) * QUANTUM).astype(np.float32)),
            panel_faces=faces,
            panel_of_face=torch.bucketize(torch.arange(len(faces)), fronts[i].cumsum(0), right=True),
            vertex_of_point=welds,
            border_labels=torch.tensor(labels[i].astype(np.int64)),
            seam_names=tuple(meta["seam_names"]),
            variant=variant,
            panel_names=panel_names,
        )
        items.append(
            Item(
                garment, meta["parameters"][i], meta["attempts"][i], tuple(meta["rejected"][i]), meta["stretch_p95"][i]
            )
        )
    return items


def load_garments(path_or_kind: str | Path, split: str = "train") -> list[Garment]:
    """Garments of a file, or of a kind's ``split`` ("train" or "test") of the shipped data set."""
    return [item.garment for item in load_items(path_or_kind, split)]


def load_items(path_or_kind: str | Path, split: str = "train") -> list[Item]:
    """As :func:`load_garments`, with the sizes that each was cut from."""
    if str(path_or_kind) in VARIANTS:
        if split not in SPLITS:
            raise UserError(f"split {split!r}: unknown, wanted one of {', '.join(SPLITS)}")
        path = Path(__file__).parents[2] / "examples" / "garments" / f"{path_or_kind}_{split}.npz"
    else:
        path = Path(path_or_kind)
    return read_items(path)


def _quanta(positions: NDArray) -> NDArray:
    """Positions [m] as int16 multiples of the quantum (up to 1.6 m from the origin)."""
    whole = np.round(positions.astype(np.float64) / QUANTUM)
    if np.abs(whole).max() > 32767:
        raise ValueError("positions beyond 1.6 m can't be stored")
    return whole.astype(np.int16)


def _encode(parts: list[NDArray]) -> NDArray:
    """Differences along each part, all low bytes before all high bytes, column by column: what compresses well."""
    whole = np.concatenate(
        [np.diff(p.view(np.uint16), axis=0, prepend=np.zeros((1, p.shape[1]), np.uint16)) for p in parts]
    )
    return np.ascontiguousarray(whole.T).view(np.uint8).reshape(-1, 2).T.copy()


def _decode(stored: NDArray, counts: NDArray, width: int) -> list[NDArray]:
    whole = np.ascontiguousarray(stored.T).view(np.uint16).reshape(width, -1).T
    return [np.cumsum(p, axis=0, dtype=np.uint16).view(np.int16) for p in np.split(whole, np.cumsum(counts)[:-1])]


def _write(path: Path, arrays: dict[str, NDArray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_LZMA) as file:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            # A fixed date: the same garments give the same bytes.
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getvalue(), zipfile.ZIP_LZMA)
    part.replace(path)
