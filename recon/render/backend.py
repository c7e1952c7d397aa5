"""The one place that prepares Mitsuba and Dr.Jit: finds LLVM, picks the variant, moves arrays to and from torch.

Dr.Jit compiles its CPU kernels with LLVM, loaded at run time from a shared library. The package ``karellen-llvm-core``
brings one; versions 14 to 16, which many systems have, abort the whole process on some operations. Dr.Jit's thread pool
does not survive ``fork`` after first use: start worker processes with the method "spawn".
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from recon.types import UserError

LLVM_PACKAGE = "karellen-llvm-core"
HOW_TO = f"pip install {LLVM_PACKAGE} wheel-axle-runtime (or set DRJIT_LIBLLVM_PATH to libLLVM 17 or newer)"


def find_llvm() -> Path | None:
    """The LLVM library that Dr.Jit shall load: the environment's choice, else the one from pip, else None."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return Path(chosen)
    try:
        files = importlib.metadata.files(LLVM_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    names = ("libLLVM.so", "libLLVM.dylib", "LLVM-C.dll")
    found = [Path(str(f.locate())).resolve() for f in files if f.name in names]
    return next((path for path in found if path.exists()), None)


def load(device: torch.device | str = "cpu") -> tuple[ModuleType, ModuleType]:
    """Mitsuba and Dr.Jit, ready for tensors on ``device``: ``llvm_ad_rgb`` for the CPU, ``cuda_ad_rgb`` for CUDA.

    Raises:
        UserError: the CPU variant has no usable LLVM library; the line says how to get one.
    """
    wanted = "cuda_ad_rgb" if torch.device(device).type == "cuda" else "llvm_ad_rgb"
    if wanted == "llvm_ad_rgb":
        path = find_llvm()
        if path is None or not path.exists():
            found = f"{path} does not exist" if path else "no LLVM library found"
            raise UserError(f"renderer: {found}; wanted libLLVM for Dr.Jit: {HOW_TO}")
        os.environ["DRJIT_LIBLLVM_PATH"] = str(path)
    mi = importlib.import_module("mitsuba")
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    return mi, importlib.import_module("drjit")


@dataclass(frozen=True)
class LlvmReport:
    """What ``recon doctor`` says about the renderer."""

    path: str
    """The LLVM library ("" = none found)."""
    version: str
    """Versions of Mitsuba, Dr.Jit and LLVM, in words."""
    works: bool
    """A small kernel was compiled and gave the right number."""
    advice: str
    """What to do, where it does not work."""


def llvm_report() -> LlvmReport:
    """Compile and run one small kernel, and say what was found."""
    path = str(find_llvm() or "")
    try:
        mi, dr = load("cpu")
        works = float(dr.sum(mi.Float([1.0, 2.0, 3.0]) * 2)[0]) == 12.0
        llvm = dr.detail.llvm_version() if hasattr(dr.detail, "llvm_version") else _packaged_version()
        return LlvmReport(path, f"mitsuba {mi.__version__}, drjit {dr.__version__}, LLVM {llvm}", works, "")
    except Exception as error:  # whatever is wrong, the doctor reports it instead of falling ill
        return LlvmReport(path, "", False, f"{error}; {HOW_TO}" if HOW_TO not in str(error) else str(error))


def _packaged_version() -> str:
    try:
        return importlib.metadata.version(LLVM_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


def to_dr(kind: type, tensor: Tensor):
    """A flat Dr.Jit array of ``kind`` with the tensor's values (any shape, detached)."""
    flat = tensor.detach().contiguous().reshape(-1)
    if flat.device.type == "cpu":
        return kind(flat.numpy())
    torch.cuda.current_stream(flat.device).synchronize()  # Dr.Jit works on a stream of its own
    return kind(flat)


def to_torch(array, device: torch.device) -> Tensor:
    """A flat Dr.Jit array as a tensor on ``device`` (unsigned integers come back as int32 with the same bits)."""
    if device.type == "cpu":
        values = array.numpy()  # waits for the kernel, which ``.torch()`` on the CPU may not
        return torch.from_numpy(values.view("int32") if values.dtype == "uint32" else values)
    values = array.torch().to(device)
    return values.view(torch.int32) if values.dtype == torch.uint32 else values
