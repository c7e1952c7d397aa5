"""Motion files: clips of joint rotations (npz), AMASS' npz and BVH, read into one form.

What a clip's joints are called and how its skeleton rests is the file's business; ``recon.bodies.retarget`` brings it
to the 24-joint rig.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.types import UserError

RIG_JOINTS = 24
BVH_UNITS = {"m": 1.0, "cm": 0.01, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Metres in one unit of a BVH file; CMU's is 1 / 0.45 inch."""
HIP_HEIGHT = (0.6, 1.4)
"""Hips of a standing person are this high [m]: the unit of a BVH file is the one that puts them there."""


@dataclass(frozen=True)
class Clip:
    """One motion as a skeleton of its own plays it."""

    name: str
    names: list[str]
    """(J,) joint names; empty where the rotations are those of the 24-joint rig already."""
    offsets: NDArray
    """(J, 3) rest offsets from the parents [m]."""
    local: NDArray
    """(F, J, 3, 3) local rotations."""
    parents: NDArray
    """(J,), -1 for the root."""
    root: NDArray
    """(F, 3) position of the root [m]."""
    fps: float
    """Frames per second."""
    source: str = ""
    """Where it was captured."""

    @property
    def world(self) -> NDArray:
        """(F, J, 3, 3) rotations chained from the root."""
        world = np.empty_like(self.local)
        for j, p in enumerate(self.parents):
            world[:, j] = self.local[:, j] if p < 0 else world[:, p] @ self.local[:, j]
        return world


def read_clip(path: str | Path) -> Clip:
    """Read a motion file.

    npz with ``names, parents, offsets, rotvec, root, fps`` (a clip); with ``pose (F, 24, 3), translation (F, 3), fps``
    (the rig's own numbers); with ``poses (F, >= 66), trans, mocap_framerate`` (AMASS: SMPL's order, z up); or BVH.

    Raises:
        UserError: missing file, another format, arrays missing or of other sizes.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such file; wanted a motion (npz or bvh)")
    kind = path.suffix.lower()
    if kind not in (".npz", ".bvh"):
        raise UserError(f"{path}: a {kind or 'nameless'} file; wanted a motion (npz or bvh)")
    try:
        clip = _read_bvh(path) if kind == ".bvh" else _read_npz(path)
    except UserError:
        raise
    except Exception as error:  # whatever a parser raises on a broken file is the file's fault
        raise UserError(
            f"{path}: cannot be read as {kind[1:]} ({type(error).__name__}: {error}); wanted a motion"
        ) from None
    if not len(clip.local):
        raise UserError(f"{path}: found no frames; wanted a motion")
    if not np.isfinite(clip.fps) or clip.fps <= 0:
        raise UserError(f"{path}: found {clip.fps} frames a second; wanted a positive number")
    return clip


def _read_npz(path: Path) -> Clip:
    with np.load(path, allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    if {"names", "parents", "offsets", "rotvec", "root"} <= data.keys():
        return Clip(
            path.stem,
            [str(n) for n in data["names"]],
            data["offsets"].astype(np.float64),
            _matrices(data["rotvec"]),
            data["parents"].astype(np.int64),
            data["root"].astype(np.float64),
            float(data.get("fps", 30.0)),
            str(data.get("source", "")),
        )
    if {"pose", "translation"} <= data.keys():
        return _rig_clip(path, data["pose"], data["translation"], float(data.get("fps", 30.0)))
    if {"poses", "trans"} <= data.keys():
        return _amass(path, data)
    raise UserError(
        f"{path}: found arrays {', '.join(sorted(data)) or 'none'}; wanted names, parents, offsets, rotvec, root; "
        "or pose, translation; or poses, trans"
    )


def _amass(path: Path, data: dict[str, NDArray]) -> Clip:
    """AMASS: z up; hands and face are left out."""
    flat = data["poses"].astype(np.float64)
    if flat.ndim != 2 or flat.shape[1] < 66:
        raise UserError(f"{path}: poses are {flat.shape}; wanted (F, 66 or more)")
    pose = np.zeros((len(flat), RIG_JOINTS, 3))
    pose[:, :22] = flat[:, :66].reshape(-1, 22, 3)
    up = Rotation.from_euler("x", -90, degrees=True)
    pose[:, 0] = (up * Rotation.from_rotvec(pose[:, 0])).as_rotvec()
    rate = data.get("mocap_framerate", data.get("mocap_frame_rate", 60.0))
    return _rig_clip(path, pose, data["trans"].astype(np.float64) @ up.as_matrix().T, float(rate))


def _rig_clip(path: Path, pose: NDArray, translation: NDArray, fps: float) -> Clip:
    pose, translation = pose.astype(np.float64), translation.astype(np.float64)
    if pose.ndim != 3 or pose.shape[1:] != (RIG_JOINTS, 3) or translation.shape != (len(pose), 3):
        raise UserError(f"{path}: pose {pose.shape}, translation {translation.shape}; wanted (F, 24, 3) and (F, 3)")
    none = np.zeros((RIG_JOINTS, 3))
    return Clip(path.stem, [], none, _matrices(pose), np.full(RIG_JOINTS, -1), translation, fps)


def _matrices(rotvec: NDArray) -> NDArray:
    """(F, J, 3) axis-angle -> (F, J, 3, 3); not-a-number stays what it is."""
    flat = rotvec.astype(np.float64).reshape(-1, 3)
    sound = np.isfinite(flat).all(1)
    out = np.full((len(flat), 3, 3), np.nan)
    if sound.any():
        out[sound] = Rotation.from_rotvec(flat[sound]).as_matrix()
    return out.reshape(*rotvec.shape[:2], 3, 3)


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = ()
    channels: tuple[str, ...] = ()


def _read_bvh(path: Path) -> Clip:
    words = iter(path.read_text(errors="replace").split())
    joints = list(_hierarchy(words))
    count = sum(len(j.channels) for j in joints)
    frames, fps = _motion_head(path, words)
    values = np.array(list(words), np.float64)
    if values.size != frames * count:
        raise UserError(f"{path}: found {values.size} numbers; wanted {frames} frames of {count} channels")
    values = values.reshape(frames, count)
    offsets = np.array([j.offset for j in joints], np.float64)
    local = np.tile(np.eye(3), (frames, len(joints), 1, 1))
    root, at = np.tile(offsets[0], (frames, 1)), 0
    for k, joint in enumerate(joints):
        for channel in joint.channels:
            axis = "XYZ".index(channel[0].upper())
            if channel.lower().endswith("rotation"):
                local[:, k] = (
                    local[:, k] @ Rotation.from_euler("xyz"[axis], values[:, at, None], degrees=True).as_matrix()
                )
            elif k == 0:
                root[:, axis] = values[:, at]
            at += 1
    unit = _unit(root)
    parents = np.array([j.parent for j in joints])
    return Clip(path.stem, [j.name for j in joints], offsets * unit, local, parents, root * unit, fps)


def _hierarchy(words: Iterator[str]) -> Iterator[_Joint]:
    """Joints in file order, until the word MOTION; end sites are joints called NAME_end."""
    stack: list[int] = []
    joints: list[_Joint] = []
    for word in words:
        if word == "MOTION":
            yield from joints
            return
        if word in ("ROOT", "JOINT", "End"):
            parent = stack[-1] if stack else -1
            name = next(words)
            joints.append(_Joint(name if word != "End" else f"{joints[parent].name}_end", parent))
        elif word == "{":
            stack.append(len(joints) - 1)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            joints[-1].offset = tuple(float(next(words)) for _ in range(3))
        elif word == "CHANNELS":
            joints[-1].channels = tuple(next(words) for _ in range(int(next(words))))


def _motion_head(path: Path, words: Iterator[str]) -> tuple[int, float]:
    """Number of frames and frames per second from 'Frames: N' and 'Frame Time: T'."""
    head = [next(words) for _ in range(5)]
    if head[0] != "Frames:" or head[2:4] != ["Frame", "Time:"]:
        raise UserError(f"{path}: found '{' '.join(head)}' after MOTION; wanted 'Frames: N Frame Time: T'")
    return int(head[1]), 1 / float(head[4])


def _unit(root: NDArray) -> float:
    """Metres per unit: the one that lifts the hips to where a person's are."""
    height = float(np.median(np.abs(root[:, 1])))
    likely = [u for u in BVH_UNITS.values() if HIP_HEIGHT[0] <= height * u <= HIP_HEIGHT[1]]
    return likely[0] if likely else 0.95 / max(height, 1e-6)
