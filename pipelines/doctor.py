"""``recon doctor``: what this installation consists of, what is wrong with it, and what to do about that."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

import recon
from recon.types import UserError

REINSTALL = "install again: pip install -e . -c constraints.txt (in a fresh clone: make demo)"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    what: str
    found: str
    advice: str = ""
    """What to do about it; "" = nothing is wrong."""


def main() -> int:
    """Print every finding, what is wrong last; 0 = all well, 1 = something is wrong."""
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True)
    wrong = []
    for finding in examine():
        mark = "[red]wrong[/]" if finding.advice else "[green]ok[/]   "
        console.print(f"{mark}  {finding.what:<24} ", end="")
        console.print(finding.found, markup=False)
        wrong += [finding] * bool(finding.advice)
    for finding in wrong:
        console.print(f"\n{finding.what}: {finding.found}\n  -> {finding.advice}", markup=False)
    console.print("\neverything is in place" if not wrong else f"\n{len(wrong)} wrong")
    return 1 if wrong else 0


def examine() -> Iterator[Finding]:
    """All findings, in the order in which they are printed."""
    for examination in (_python, _packages, _machine, _renderer, _perception, _weights, _body):
        yield from _guarded(examination)


def _guarded(examination: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The examination's findings; what it stumbles over is a finding too, whatever it is."""
    try:
        yield from examination()
    except Exception as error:
        name = examination.__name__.strip("_")
        yield Finding(name, f"{type(error).__name__}: {error}".splitlines()[0], REINSTALL)


def _python() -> Iterator[Finding]:
    found = f"{platform.python_version()} at {sys.executable}"
    yield Finding("python", found, "" if sys.version_info >= (3, 11) else "use Python 3.11 or newer")
    yield Finding("garment-recon", f"{recon.__version__} at {Path(recon.__file__).parent}")


def _packages() -> Iterator[Finding]:
    """Every package that the project requires here, against the range that it asks for."""
    try:
        asked = importlib.metadata.requires("garment-recon") or []
    except importlib.metadata.PackageNotFoundError:
        yield Finding("garment-recon", "not installed", REINSTALL)
        return
    for requirement in map(Requirement, asked):
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            yield Finding(requirement.name, "not installed", f"pip install '{requirement.name}{requirement.specifier}'")
            continue
        fits = requirement.specifier.contains(version, prereleases=True)
        advice = "" if fits else f"pip install '{requirement.name}{requirement.specifier}'"
        yield Finding(requirement.name, version, advice)


def _machine() -> Iterator[Finding]:
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Finding("cpu", f"{cores} cores, torch uses {torch.get_num_threads()} threads")
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none that torch can use (it is not needed)"
    yield Finding("gpu", gpu)


def _renderer() -> Iterator[Finding]:
    """Compile a kernel in a process of its own: an LLVM that does not fit ends the process instead of raising."""
    code = (
        "import json, dataclasses; from recon.render.backend import llvm_report; "
        "print(json.dumps(dataclasses.asdict(llvm_report())))"
    )
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        yield Finding("renderer", "compiling a kernel took over 300 s", "pip install -U karellen-llvm-core")
        return
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        library = os.environ.get("DRJIT_LIBLLVM_PATH")
        advice = f"unset DRJIT_LIBLLVM_PATH ({library})" if library else "pip install -U karellen-llvm-core"
        yield Finding("renderer", f"ended by itself: {last}", advice)
        return
    report = json.loads(done.stdout.strip().splitlines()[-1])
    found = f"{report['version']} ({report['path'] or 'no LLVM library'})"
    yield Finding("renderer", found, "" if report["works"] else report["advice"] or REINSTALL)


def _perception() -> Iterator[Finding]:
    from ai_edge_litert.interpreter import Interpreter

    folder = Path(recon.__file__).parent / "perceive" / "models"
    for name in ("pose_detection.tflite", "pose_landmark_full.tflite"):
        path = folder / name
        if not path.is_file():
            yield Finding(name, f"{path}: missing", REINSTALL)
            continue
        try:
            Interpreter(model_path=str(path)).allocate_tensors()
            yield Finding(name, f"{path.stat().st_size / 1e6:.1f} MB, loads")
        except Exception as error:
            yield Finding(name, f"{path}: {str(error).splitlines()[0]}", REINSTALL)


def _weights() -> Iterator[Finding]:
    """The decoder of every kind that a photo may name, against the digest that the manifest holds."""
    from recon.files.weights import PACKAGED, read_manifest, read_weights
    from recon.garments import COMMON

    names = {f"isp-{kind}": f"recon train isp --kind {kind}" for kind in COMMON}
    try:
        cards = read_manifest()
    except UserError as error:
        yield Finding(
            "weights", str(error), f"restore {PACKAGED} from the repository, or: {next(iter(names.values()))}"
        )
        return
    for name in sorted({*cards, *names}):
        try:
            weights = read_weights(name)
            size = sum(t.numel() for t in weights.tensors.values())
            yield Finding(f"weights {name}", f"{size / 1e6:.2f} M numbers, digest as recorded")
        except UserError as error:
            other = f", or: {names[name]}" if name in names else ""
            yield Finding(f"weights {name}", str(error), f"restore {PACKAGED} from the repository{other}")


def _body() -> Iterator[Finding]:
    from recon.bodies import load_body

    try:
        body = load_body()
    except UserError as error:
        yield Finding("body anny", str(error), REINSTALL)
        return
    count = len(body.weights)
    yield Finding("body anny", f"{count} vertices, {len(body.faces)} faces, {body.n_shape} shape coefficients")
