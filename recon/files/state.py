"""State on disk: dataclasses, dicts and tensors as a flat safetensors file plus a JSON description.

Nothing is pickled: only dataclasses of this project's packages are built again, from their own fields.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

_PACKAGES = ("recon", "pipelines")


def encode(value: Any) -> tuple[Any, dict[str, Tensor]]:
    """Split ``value`` into a JSON-able description and its tensors (detached, on the CPU, bit for bit).

    Dataclasses of recon and pipelines, dicts with string keys, lists, tuples, tensors, numpy arrays, paths, numbers,
    strings and None may be nested at will; anything else is a TypeError that says where it was found.
    """
    tensors: dict[str, Tensor] = {}

    def walk(at: Any, where: str) -> Any:
        if at is None or isinstance(at, (bool, int, float, str)):
            return at
        if isinstance(at, Tensor):
            # A copy of its own: safetensors refuses tensors that share memory.
            tensors[where] = at.detach().cpu().contiguous().clone()
            return {"$tensor": where}
        if isinstance(at, np.ndarray):
            tensors[where] = torch.from_numpy(np.array(at, order="C"))
            return {"$array": where}
        if isinstance(at, np.generic):
            return at.item()
        if isinstance(at, Path):
            return {"$path": str(at)}
        if is_dataclass(at) and not isinstance(at, type) and type(at).__module__.split(".")[0] in _PACKAGES:
            inner = {f.name: walk(getattr(at, f.name), f"{where}.{f.name}") for f in fields(at) if f.init}
            return {"$class": f"{type(at).__module__}:{type(at).__qualname__}", "fields": inner}
        if isinstance(at, dict) and all(isinstance(key, str) for key in at):
            return {"$dict": {key: walk(item, f"{where}.{key}") for key, item in at.items()}}
        if isinstance(at, tuple):
            return {"$tuple": [walk(item, f"{where}.{i}") for i, item in enumerate(at)]}
        if isinstance(at, list):
            return [walk(item, f"{where}.{i}") for i, item in enumerate(at)]
        raise TypeError(f"{where}: a {type(at).__module__}.{type(at).__qualname__} cannot be kept as state")

    return walk(value, "state"), tensors


def decode(description: Any, tensors: dict[str, Tensor], device: str | torch.device = "cpu") -> Any:
    """The value that ``encode`` took apart, with its tensors on ``device``."""
    if isinstance(description, list):
        return [decode(item, tensors, device) for item in description]
    if not isinstance(description, dict):
        return description
    if "$tensor" in description:
        return tensors[description["$tensor"]].to(device)
    if "$array" in description:
        return tensors[description["$array"]].numpy()
    if "$path" in description:
        return Path(description["$path"])
    if "$tuple" in description:
        return tuple(decode(item, tensors, device) for item in description["$tuple"])
    if "$dict" in description:
        return {key: decode(item, tensors, device) for key, item in description["$dict"].items()}
    made = {key: decode(item, tensors, device) for key, item in description["fields"].items()}
    return _dataclass(description["$class"])(**made)


def _dataclass(name: str) -> type:
    """The dataclass called ``module:Name``, of this project's packages only."""
    module, _, qualname = name.partition(":")
    if module.split(".")[0] not in _PACKAGES:
        raise ValueError(f"state names a class of a foreign package: {name}")
    found: Any = importlib.import_module(module)
    for part in qualname.split("."):
        found = getattr(found, part)
    if not (isinstance(found, type) and is_dataclass(found)):
        raise ValueError(f"state names something that is no dataclass: {name}")
    return found


def canonical(value: Any) -> str:
    """One text for equal settings: sorted JSON in which tensors stand as digests of their bytes."""
    description, tensors = encode(value)
    sums = {
        name: [str(t.dtype), list(t.shape), hashlib.sha256(_raw(t)).hexdigest()] for name, t in sorted(tensors.items())
    }
    return json.dumps([description, sums], sort_keys=True, separators=(",", ":"))


def _raw(tensor: Tensor) -> bytes:
    return tensor.reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b""


def digest(*parts: str | bytes) -> str:
    """SHA-256 (hex) over the parts, each preceded by its length so that no two lists collide."""
    total = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        total.update(len(data).to_bytes(8, "little"))
        total.update(data)
    return total.hexdigest()


def file_digest(path: str | Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
