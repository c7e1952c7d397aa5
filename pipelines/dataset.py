"""Make the data set of draped garments: ``recon dataset make`` and ``recon dataset pack``.

One process a core; every finished garment is a file of its own: a re-run goes on where the last one was stopped.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from recon.garments.dataset import SPLITS, VARIANTS, Item, draw, read_items, write_items
from recon.types import UserError


@dataclass(frozen=True)
class DatasetMake:
    """Draw, cut and drape garments on the neutral body."""

    out: Path = Path("runs/dataset")
    """Folder of the finished garments, one file each, and of the packed files."""
    seed: int = 0
    """The set depends on this number alone (on one machine)."""
    tops: int = 600
    """Tank tops, T-shirts, shirts and jackets to train on."""
    skirts: int = 400
    """Skirts to train on."""
    trousers: int = 400
    """Trousers and shorts to train on."""
    dresses: int = 400
    """Dresses to train on."""
    shirts6: int = 0
    """Shirts of six panels to train on."""
    test: int = 20
    """Further garments of each kind, from other seeds, never to be trained on."""
    processes: int = 0
    """Processes; 0 = one a core."""


@dataclass(frozen=True)
class DatasetPack:
    """Put the garments made so far into the files that ship."""

    items: Path = Path("runs/dataset")
    """Folder of `recon dataset make`."""
    out: Path = Path("examples/garments")
    """Folder of the packed files, <kind>_<split>.npz, and of the card."""


@dataclass(frozen=True)
class Job:
    """One garment to make."""

    kind: str
    split: str
    index: int
    seed: int
    path: Path


def jobs(config: DatasetMake) -> list[Job]:
    """All garments, kinds and splits interleaved: whenever it is stopped, a balanced set exists; tests come early."""
    counts = {"top": config.tops, "skirt": config.skirts, "trousers": config.trousers, "dress": config.dresses}
    counts |= {"shirt6": config.shirts6} if config.shirts6 else {}
    ordered: list[tuple[float, int, Job]] = []
    for kind, count in counts.items():
        for split, total in (("train", count), ("test", config.test)):
            for index in range(total):
                place = index / total * (0.25 if split == "test" else 1.0)
                path = _item_path(config.out, kind, split, index)
                ordered.append((place, len(ordered), Job(kind, split, index, config.seed, path)))
    return [job for *_, job in sorted(ordered, key=lambda entry: entry[:2])]


def make_dataset(config: DatasetMake) -> dict:
    """Make what is missing; returns counts and figures. Raises ``UserError`` where the folder holds another set."""
    _claim(config)
    todo = [job for job in jobs(config) if not job.path.exists()]
    count = config.processes or os.cpu_count() or 1
    start, failures = time.time(), []
    if todo:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        context = multiprocessing.get_context("spawn")
        with Progress(*columns) as progress, context.Pool(min(count, len(todo)), _prepare) as pool:
            bar = progress.add_task("Draping garments", total=len(todo))
            for problem in pool.imap_unordered(_make, todo):
                if problem:
                    failures.append(problem)
                    progress.console.print(problem)
                progress.advance(bar)
    seconds = time.time() - start
    _log(config.out, len(todo), seconds, count)
    return {"made": len(todo) - len(failures), "failed": failures, "seconds": seconds}


def pack_dataset(config: DatasetPack) -> dict:
    """Write ``<kind>_<split>.npz`` from the garments made so far, and the card; returns the card."""
    settings = config.items / "dataset.json"
    if not settings.exists():
        raise UserError(
            f"{config.items}: no data set found there; make one with `recon dataset make --out {config.items}`"
        )
    seed = json.loads(settings.read_text())["seed"]
    counts: dict[str, dict] = {}
    for kind in VARIANTS:
        for split in SPLITS:
            paths = sorted((config.items / "items" / split / kind).glob("*.npz"))
            items = [item for path in paths for item in read_items(path)]
            if items:
                file = config.out / f"{kind}_{split}.npz"
                write_items(file, kind, items)
                counts[f"{kind}_{split}"] = _figures(items) | {"bytes": file.stat().st_size}
    card = _card(config.items, seed, counts)
    (config.out / "card.json").write_text(json.dumps(card, indent=2) + "\n")
    return card


def _card(folder: Path, seed: int, counts: dict[str, dict]) -> dict:
    drawn = sum(c["drawn"] for c in counts.values())
    kept = sum(c["garments"] for c in counts.values())
    log = folder / "log.jsonl"
    runs = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return {
        "what": "Garments cut from parametric patterns, draped on the neutral body by our simulator",
        "licence": "CC0-1.0",
        "seed": seed,
        "garments": kept,
        "pass_rate": round(kept / drawn, 4) if drawn else None,
        "gate": "0 vertices and face centres in the body, 95th percentile of stretch < 1.03, 0 self-intersections",
        "files": counts,
        "runs": runs,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
    }


def _figures(items: list[Item]) -> dict:
    reasons = Counter(reason for item in items for reason in item.rejected)
    return {
        "garments": len(items),
        "drawn": sum(item.attempts for item in items),
        "rejected": dict(reasons.most_common()),
        "variants": dict(Counter(item.garment.variant for item in items).most_common()),
        "vertices": round(sum(len(item.garment.mesh.vertices) for item in items) / len(items)),
        "stretch_p95_max": max(item.stretch_p95 for item in items),
    }


def _item_path(out: Path, kind: str, split: str, index: int) -> Path:
    return out / "items" / split / kind / f"{index:04d}.npz"


def _claim(config: DatasetMake) -> None:
    """One folder, one seed."""
    path = config.out / "dataset.json"
    if path.exists():
        found = json.loads(path.read_text())["seed"]
        if found != config.seed:
            raise UserError(
                f"{config.out}: holds the set of seed {found}, wanted seed {config.seed} or an empty folder"
            )
    config.out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({k: str(v) if isinstance(v, Path) else v for k, v in asdict(config).items()}, indent=2))


def _log(out: Path, made: int, seconds: float, processes: int) -> None:
    if made:
        line = {"garments": made, "seconds": round(seconds, 1), "processes": processes}
        with (out / "log.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")


_room = None


def _prepare() -> None:
    """Once a process: one thread, and the body in its fitting room."""
    global _room
    import torch

    torch.set_num_threads(1)
    from recon.bodies import load_body
    from recon.garments.patterns_body import Measures
    from recon.garments.patterns_drape import FittingRoom

    _room = FittingRoom(Measures.from_body(load_body()))


def _make(job: Job) -> str:
    """Make one garment; returns what went wrong, or nothing."""
    try:
        write_items(job.path, job.kind, [draw(_room, job.kind, job.split, job.index, job.seed)])
    except RuntimeError as error:
        return str(error)
    return ""
