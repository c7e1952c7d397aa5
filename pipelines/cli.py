"""The command ``recon``: words to pipelines, mistakes to one line, nothing heavy imported before it is needed."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import recon


@dataclass(frozen=True)
class Command:
    """A command: where its settings and its function live."""

    says: str
    """What it does, for ``recon --help``."""
    module: str
    config: str = ""
    """Name of the module's settings dataclass; "" = the function takes nothing."""
    run: str = "main"
    """Name of the module's function of these settings."""
    show: Callable[[Callable[..., Any], Any], int] | None = None
    """Calls (run, settings), shows progress and result and returns the exit code; None = print what comes back."""
    words: str = ""
    """The setting that words before the first option fill."""
    repeats: bool = False
    """Whether a garment named twice is meant twice."""


OK, WRONG, INTERRUPTED = 0, 2, 130


def _show_photo(fit_photo: Callable[..., Any], config: Any) -> int:
    """Fit with progress on stderr; the figures and where the results lie on stdout."""
    from pipelines.progress import Progress

    with Progress() as progress:
        result = fit_photo(config, say=progress.say, tick=progress.tick)
    for note in result.figures.get("notes", []):
        print(f"note: {note}")
    for name, found in result.figures["garments"].items():
        print(
            f"{name}: IoU {found['iou']:.3f}, {found['vertices']} vertices, {found['penetrating_vertices']} inside the "
            f"body, {found['self_intersections']} self-intersections, stretch p95 {found['stretch_p95']:.3f}"
        )
    print(f"{Path(result.folder) / 'report.html'}   ({result.figures['seconds']['total']:.0f} s)")
    return OK


def _show_scan(fit_scan: Callable[..., Any], config: Any) -> int:
    """Fit with progress on stderr; the figures and where the results lie on stdout."""
    from pipelines.progress import Progress

    with Progress() as progress:
        result = fit_scan(config, say=progress.say, tick=progress.tick)
    for note in result.figures.get("notes", []):
        print(f"note: {note}")
    for name, found in result.figures["garments"].items():
        print(
            f"{name}: {found['scan_mm']:.1f} mm from its scan (median; {found['scan_mm_code_only']:.1f} by its code "
            f"alone), {found['penetrating_vertices']} vertices inside the body, {found['self_intersections']} "
            f"self-intersections, stretch p95 {found['stretch_p95']:.3f}"
        )
    print(f"{Path(result.folder) / 'report.html'}   ({result.figures['seconds']['total']:.0f} s)")
    return OK


def _show_animation(animate: Callable[..., Any], config: Any) -> int:
    """Drape with a line a stage on stderr; the figures and where the results lie on stdout."""
    result = animate(config, say=lambda line: print(line, file=sys.stderr))
    for name, found in result.figures["garments"].items():
        out = found["limbs_out_pct"]
        note = f", a limb out of its opening in {out:.0f} % of frames" if out else ""
        print(
            f"{name}: edges {found['eps_e']:.2f} %, areas {found['eps_a']:.2f} % off the template, "
            f"{found['eps_c']:.3f} % of vertices inside the body{note}"
        )
    print(f"{result.folder}   ({result.figures['frames']} frames, {result.figures['seconds']:.0f} s)")
    return OK


def _show_drape(drape: Callable[..., Any], config: Any) -> int:
    """Drape with a line a stage on stderr; the figures and where the results lie on stdout."""
    result = drape(config, say=lambda line: print(line, file=sys.stderr))
    for note in result.figures.get("untangle", {}).get("notes", []):
        print(f"note: {note}")
    for name, found in result.figures["garments"].items():
        over = ", ".join(f"{share:.2f} % beneath {inner}" for inner, share in found["beneath_pct"].items())
        print(
            f"{name}: by {found['draper']}, {found['inside_body_pct']:.3f} % inside the body, "
            f"{found['self_intersections']} self-intersections{', ' if over else ''}{over}"
        )
    print(f"{result.folder}   ({sum(result.figures['seconds'].values()):.1f} s)")
    return OK


def _show_figures(run: Callable[..., Any], config: Any) -> int:
    """Progress on stderr, the figures as JSON on stdout."""
    from pipelines.progress import Progress

    with Progress() as progress:
        came = run(config, tick=progress.tick)
    print(json.dumps(came, indent=1))
    return OK


COMMANDS = {
    "photo": Command("fit the garments of a photo", "pipelines.photo", "PhotoFit", "fit_photo", _show_photo, "photo"),
    "scan": Command("fit the garments of a labelled scan", "pipelines.scan", "ScanFit", "fit_scan", _show_scan, "scan"),
    "animate": Command(
        "drape garments over a motion", "pipelines.sequence", "Animate", "animate", _show_animation, "garments"
    ),
    "decode": Command("write the garment of a code", "pipelines.decode", "Decode", "decode", _show_figures, "what"),
    "drape": Command("dress a body in garments", "pipelines.drape", "Drape", "drape", _show_drape, "garments", True),
    "edit": Command("change a garment through its pattern", "pipelines.edit", "Edit", "edit", _show_figures, "what"),
    "dataset make": Command("make a set of draped garments", "pipelines.dataset", "DatasetMake", "make_dataset"),
    "dataset pack": Command("pack a set into one file a kind", "pipelines.dataset", "DatasetPack", "pack_dataset"),
    "train isp": Command("learn a garment decoder from a set", "pipelines.train_isp", "TrainIsp", "train_isp"),
    "encode": Command("a code for any garment mesh", "pipelines.encode", "Encode", "encode", None, "mesh"),
    "train udf": Command("learn encoder and decoder of open meshes", "pipelines.train_udf", "TrainUdf", "train_udf"),
    "train gaps": Command("learn to drape a garment in motion", "pipelines.train_gaps", "TrainGaps", "train_gaps"),
    "train drape-isp": Command(
        "learn to drape a kind of garment", "pipelines.train_drape_isp", "TrainDrapeIsp", "train_drape_isp"
    ),
    "train layers-isp": Command(
        "learn to layer garments", "pipelines.train_layers_isp", "TrainLayersIsp", "train_layers_isp"
    ),
    "train drape-drapenet": Command(
        "learn to drape any garment: DrapeNet's networks", "pipelines.train_drapenet", "TrainDrapenet", "train_drapenet"
    ),
    "doctor": Command("say whether everything is in place", "pipelines.doctor", "", "main"),
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command that ``args`` (default: the process') name; returns the exit code.

    0: done; 1: the doctor found something wrong; 2: the user's mistake, told in one line; 130: interrupted.
    """
    args = list(sys.argv[1:] if args is None else args)
    if not args or args[0] in ("-h", "--help", "help"):
        print(usage())
        return OK if args else WRONG
    if args[0] in ("-V", "--version"):
        print(f"recon {recon.__version__}")
        return OK
    name = next((n for n in (" ".join(args[:2]), args[0]) if n in COMMANDS), None)
    if name is None:
        return _wrong(f"{' '.join(args[:2])}: no such command; wanted one of {', '.join(COMMANDS)} (recon --help)")
    try:
        from recon.types import UserError
    except ModuleNotFoundError as error:
        return _wrong(f"package {error.name} is not installed; install again: pip install -e . -c constraints.txt")
    try:
        return _dispatch(name, args[len(name.split()) :])
    except UserError as error:
        return _wrong(str(error))
    except KeyboardInterrupt:
        print("\nrecon: interrupted; resume with the same command", file=sys.stderr)
        return INTERRUPTED


def usage() -> str:
    """The text of ``recon --help``."""
    width = max(map(len, COMMANDS))
    lines = [f"  recon {name:<{width}}   {command.says}" for name, command in COMMANDS.items()]
    example = "recon photo examples/photos/man-hoodie-trousers.jpg --garments top,trousers --out out/demo"
    about = "From a photo of a dressed person to simulation-ready garments with their sewing patterns."
    return "\n".join(
        [
            f"recon {recon.__version__}: {about}",
            "",
            *lines,
            "",
            f"For example: {example}",
            "Settings: recon COMMAND --help",
        ]
    )


def _wrong(line: str) -> int:
    print("recon: " + " ".join(line.split()), file=sys.stderr)
    return WRONG


def _dispatch(name: str, args: list[str]) -> int:
    """Read the command's settings and run it."""
    command = COMMANDS[name]
    config: tuple[Any, ...] = ()
    module = importlib.import_module(command.module)
    run: Callable[..., Any] = getattr(module, command.run)
    if command.config:
        import tyro

        settings = getattr(module, command.config)
        config = (_split(tyro.cli(settings, prog=f"recon {name}", args=_named(args, command.words)), command.repeats),)
    elif args:
        return _wrong(f"{' '.join(args)}: recon {name} takes nothing")
    if command.show:
        return command.show(run, *config)
    came = run(*config)
    if isinstance(came, int):
        return came
    if came is not None:
        print(json.dumps(came, indent=1) if isinstance(came, dict) else came)
    return OK


def _named(args: list[str], setting: str) -> list[str]:
    """The arguments with the words before the first option given to ``setting``."""
    count = next((k for k, word in enumerate(args) if word.startswith("-")), len(args))
    return [f"--{setting}", *args] if setting and count else args


def _split(config: Any, repeats: bool) -> Any:
    """Settings in which names may have been given as ``top,trousers``, as separate words or both."""
    if isinstance(getattr(config, "garments", None), tuple):
        names = [word.strip() for given in config.garments for word in given.split(",")]
        names = [name for name in names if name]
        config = replace(config, garments=tuple(names if repeats else dict.fromkeys(names)))
    return config


if __name__ == "__main__":
    sys.exit(main())
