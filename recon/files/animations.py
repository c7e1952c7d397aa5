"""Moving meshes on disk: GLB with morph targets, OBJ sequences, PC2 point caches, and films from pictures."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.files.atomic import temporary, write_whole
from recon.files.meshes import Colour, linear_colour, write_obj
from recon.types import Garment, Mesh, UserError

FLOAT, UINT = 5126, 5125


@dataclass(frozen=True)
class Moving:
    """A surface that moves."""

    thing: Mesh | Garment
    """Faces, and panel coordinates where it has them."""
    frames: Tensor
    """(F, V, 3) [m]."""
    colour: Colour = (0.8, 0.8, 0.8)
    """sRGB in [0, 1]."""

    @property
    def faces(self) -> Tensor:
        """(N, 3)."""
        return (self.thing.mesh if isinstance(self.thing, Garment) else self.thing).faces

    def at(self, frame: int) -> Mesh | Garment:
        """One frame as a thing of its own."""
        from dataclasses import replace

        if isinstance(self.thing, Garment):
            return replace(self.thing, mesh=self.thing.mesh.with_vertices(self.frames[frame]))
        return self.thing.with_vertices(self.frames[frame])


def checked(parts: Mapping[str, Moving]) -> int:
    """The number of frames, the same in all parts; a ValueError for numbers that are none or frames that differ."""
    counts = {len(part.frames) for part in parts.values()}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"animation: parts have {sorted(counts)} frames; wanted as many of each, and one at least")
    for name, part in parts.items():
        if not bool(torch.isfinite(part.frames).all()):
            raise ValueError(f"{name}: has frames that are NaN or infinite; nothing was written")
    return counts.pop()


def write_obj_sequence(parts: Mapping[str, Moving], folder: str | Path) -> None:
    """``folder/<name>/<name>_0000.obj`` and on, frame by frame, vertices welded and in one order."""
    count, folder = checked(parts), Path(folder)
    for name, part in parts.items():
        for k in range(count):
            write_obj(part.at(k), folder / name / f"{name}_{k:04d}.obj", name)


def write_pc2(part: Moving, path: str | Path, fps: float) -> None:
    """A point cache (PC2) of one part: the vertex order is that of its OBJ files."""
    count = checked({"cache": part})
    points = part.frames.detach().cpu().float().numpy().astype("<f4")
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, points.shape[1], 0.0, 1.0, count)
    write_whole(path, head + points.tobytes())


def read_pc2(path: str | Path) -> Tensor:
    """(F, V, 3) of a point cache. UserError: not a PC2 file, or cut off."""
    data = Path(path).read_bytes()
    if len(data) < 32 or data[:12] != b"POINTCACHE2\0":
        raise UserError(f"{path}: found no POINTCACHE2 header; wanted a PC2 file")
    vertices, count = struct.unpack("<i", data[16:20])[0], struct.unpack("<i", data[28:32])[0]
    if len(data) != 32 + 12 * vertices * count:
        raise UserError(f"{path}: found {len(data) - 32} bytes; wanted {count} frames of {vertices} points")
    return torch.from_numpy(np.frombuffer(data, "<f4", offset=32).reshape(count, vertices, 3).copy())


def write_film(pictures: Sequence[Tensor], path: str | Path, fps: float) -> None:
    """Pictures (h, w, 3) uint8 as an animated GIF or MP4, by the file's ending."""
    path = Path(path)
    frames = [p.cpu().numpy() for p in pictures]
    if path.suffix == ".gif":
        from PIL import Image

        first, *rest = [Image.fromarray(f).quantize(128) for f in frames]
        data = io.BytesIO()
        first.save(data, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)
        write_whole(path, data.getvalue())
        return
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    beside = temporary(path).with_suffix(path.suffix)
    height, width = frames[0].shape[:2]
    film = cv2.VideoWriter(str(beside), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not film.isOpened():
        raise UserError(f"{path}: this machine's OpenCV can't write MP4; wanted a .gif instead")
    for frame in frames:
        film.write(np.ascontiguousarray(frame[..., ::-1]))
    film.release()
    beside.replace(path)


def write_animated_glb(parts: Mapping[str, Moving], path: str | Path, fps: float) -> None:
    """A binary glTF without a skeleton: every frame of a part is a morph target of its mesh, played in turn."""
    count = checked(parts)
    scene = _Glb()
    times = scene.accessor(np.arange(count, dtype=np.float32) / np.float32(fps), "SCALAR", bounds=True)
    weights = scene.accessor(np.eye(count, dtype=np.float32)[:, 1:].ravel(), "SCALAR") if count > 1 else 0
    for name, part in parts.items():
        node = scene.add(name, part)
        if count > 1:
            sampler = {"input": times, "output": weights, "interpolation": "LINEAR"}
            scene.samplers.append(sampler)
            channel = {"sampler": len(scene.samplers) - 1, "target": {"node": node, "path": "weights"}}
            scene.channels.append(channel)
    write_whole(path, scene.packed())


class _Glb:
    """Collects the tables and bytes of one glTF file."""

    def __init__(self) -> None:
        self.bytes = bytearray()
        self.accessors: list[dict] = []
        self.views: list[dict] = []
        self.nodes: list[dict] = []
        self.meshes: list[dict] = []
        self.materials: list[dict] = []
        self.samplers: list[dict] = []
        self.channels: list[dict] = []

    def accessor(self, values: NDArray, kind: str, bounds: bool = False, target: int | None = None) -> int:
        """Store an array; returns its accessor."""
        view = {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": values.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.bytes += values.tobytes()
        self.bytes += b"\0" * (-len(self.bytes) % 4)
        entry = {
            "bufferView": len(self.views) - 1,
            "componentType": UINT if values.dtype == np.uint32 else FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            low, high = values.reshape(len(values), -1).min(0), values.reshape(len(values), -1).max(0)
            entry |= {"min": low.tolist(), "max": high.tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def add(self, name: str, part: Moving) -> int:
        """One part as mesh, material and node; returns the node."""
        frames = part.frames.detach().cpu().float().numpy()
        faces = part.faces.cpu().numpy().astype(np.uint32)
        primitive: dict = {
            "attributes": {"POSITION": self.accessor(frames[0], "VEC3", True, 34962)},
            "indices": self.accessor(faces.ravel(), "SCALAR", True, 34963),
            "material": len(self.materials),
        }
        if len(frames) > 1:
            moves = (frames[1:] - frames[:1]).astype(np.float32)
            primitive["targets"] = [{"POSITION": self.accessor(m, "VEC3", True, 34962)} for m in moves]
        self.materials.append(
            {
                "name": name,
                "doubleSided": isinstance(part.thing, Garment),
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*linear_colour(part.colour), 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.9,
                },
            }
        )
        mesh = {"name": name, "primitives": [primitive]}
        self.meshes.append(mesh | ({"weights": [0.0] * (len(frames) - 1)} if len(frames) > 1 else {}))
        self.nodes.append({"name": name, "mesh": len(self.meshes) - 1})
        return len(self.nodes) - 1

    def packed(self) -> bytes:
        """The file's bytes."""
        tree = {
            "asset": {"version": "2.0", "generator": "garment-recon"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self.nodes)))}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.bytes)}],
        }
        if self.channels:
            tree["animations"] = [{"name": "motion", "samplers": self.samplers, "channels": self.channels}]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.bytes)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.bytes), b"BIN\0") + bytes(self.bytes)
