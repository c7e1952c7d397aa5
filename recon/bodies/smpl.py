"""SMPL, SMPL-H and SMPL-X from the user's own file (npz or pkl), folded into the common 24-joint rig.

Loper et al. 2015 (SMPL), Romero et al. 2017 (SMPL-H), Pavlakos et al. 2019 (SMPL-X). The files are licensed to the user
and never shipped. Zero pose, shape and pose blend shapes are the file's own; fingers stay flat and ride on the hands,
jaw and eyes on the head, expressions at zero. The body is lifted so that its feet stand at y = 0 (``card["lift"]``).
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon.bodies.landmarks import front_point, landmark_table
from recon.bodies.linear_body import LinearBody
from recon.bodies.rig import JOINT_NAMES, PARENTS, REGION_NAMES
from recon.files.pickles import read_pickle
from recon.types import UserError

N_SHAPE = 10
"""Shape coefficients in use: the first of the file's; SMPL-X appends expressions to its shapes."""
KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "f", "kintree_table")
REGION_OF_JOINT = {"head": "head", "neck": "neck", "shoulder": "upper_arms", "elbow": "forearms", "wrist": "hands",
                   "hand": "hands", "hip": "legs", "knee": "legs", "ankle": "feet", "foot": "feet"}  # fmt: skip


@dataclass(frozen=True)
class Family:
    """One of the three file formats."""

    name: str
    vertices: int
    joints: int
    face_joints: tuple[int, ...]
    """Joints that ride on the head."""
    hands: tuple[int, int]
    """First finger joint of the left and right hand: index, middle, pinky, ring, thumb, three joints each; or the
    hand joints themselves where there are no fingers."""
    points: dict[int, int]
    """BlazePose landmark -> vertex of the published mesh."""

    @property
    def fingers(self) -> bool:
        """Whether the file has finger joints."""
        return self.joints > 24


_SMPL_POINTS = {0: 332, 2: 2800, 5: 6260, 7: 583, 8: 4071, 29: 3387, 30: 6787, 31: 3216, 32: 6617}
_SMPL_TIPS = {17: 2673, 18: 6133, 19: 2319, 20: 5782, 21: 2746, 22: 6191}
"""Finger tips of SMPL's mesh: pinky, index and thumb, left and right."""
_SMPLX_POINTS = {0: 9120, 2: 9448, 5: 9929, 7: 6, 8: 616, 29: 8846, 30: 8635, 31: 5770, 32: 8463}
FAMILIES = {
    "smpl": Family("SMPL", 6890, 24, (), (22, 23), _SMPL_POINTS),
    "smplh": Family("SMPL-H", 6890, 52, (), (22, 37), _SMPL_POINTS),
    "smplx": Family("SMPL-X", 10475, 55, (22, 23, 24), (25, 40), _SMPLX_POINTS),
}


def read_model(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a model file, npz or pkl."""
    if path.suffix.lower() == ".npz":
        try:
            with np.load(path, allow_pickle=False) as file:
                # Some members of these files are pickled objects (names, dates); they are never touched.
                data: Any = {k: file[k] for k in KEYS if k in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            what = " ".join(str(error).split())
            raise UserError(f"{path}: found no readable npz ({what}), wanted a SMPL, SMPL-H or SMPL-X model") from None
    else:
        data = read_pickle(path)
    missing = [k for k in KEYS if k not in data] if isinstance(data, dict) else list(KEYS)
    if missing:
        raise UserError(f"{path}: found no {', '.join(missing)}, wanted a SMPL, SMPL-H or SMPL-X model")
    return {k: np.asarray(data[k]) for k in KEYS}


def check(data: dict[str, np.ndarray], family: Family, path: Path) -> None:
    """One line of complaint where the file is of another family, or its tables do not fit each other."""
    n, joints = len(data["v_template"]), data["weights"].shape[-1]
    if (n, joints) != (family.vertices, family.joints):
        known = next((f.name for f in FAMILIES.values() if (f.vertices, f.joints) == (n, joints)), "a model")
        raise UserError(
            f"{path}: found {known} with {n} vertices and {joints} joints, "
            f"wanted {family.name} with {family.vertices} and {family.joints}"
        )
    wanted = {"v_template": (n, 3), "weights": (n, joints), "J_regressor": (joints, n),
              "posedirs": (n, 3, 9 * (joints - 1)), "kintree_table": (2, joints)}  # fmt: skip
    for key, shape in wanted.items():
        if data[key].shape != shape:
            raise UserError(f"{path}: found {key} of shape {data[key].shape}, wanted {shape}")
    dirs = data["shapedirs"]
    if dirs.ndim != 3 or dirs.shape[:2] != (n, 3) or dirs.shape[2] < N_SHAPE:
        raise UserError(f"{path}: found shapedirs of shape {dirs.shape}, wanted ({n}, 3, {N_SHAPE} or more)")
    for key in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights"):
        if not np.isfinite(data[key].astype(np.float64)).all():
            raise UserError(f"{path}: found NaN or infinite numbers in {key}, wanted finite ones")
    tree = tuple(int(p) for p in data["kintree_table"].astype(np.int64)[0, 1:22])
    if tree != PARENTS[1:22]:
        raise UserError(f"{path}: found another order of joints in kintree_table, wanted {family.name}'s")
    faces = data["f"].astype(np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= n:
        raise UserError(
            f"{path}: found faces that name no vertex or are no triangles, wanted triangles over {n} vertices"
        )


def fold(family: Family) -> tuple[np.ndarray, np.ndarray]:
    """Weights (J, 24) and joints (24, J) from the file's J joints to the rig's 24.

    Fingers go to the hand joint, the thumb stays with the palm (wrist); the hand joint sits amid the four knuckles.
    """
    weights, joints = np.zeros((family.joints, 24)), np.zeros((24, family.joints))
    for j in range(22):
        weights[j, j] = joints[j, j] = 1
    for j in family.face_joints:
        weights[j, JOINT_NAMES.index("head")] = 1
    for hand, wrist, first in ((22, 20, family.hands[0]), (23, 21, family.hands[1])):
        if not family.fingers:
            weights[first, hand] = joints[hand, first] = 1
            continue
        weights[first : first + 12, hand] = 1
        weights[first + 12 : first + 15, wrist] = 1
        joints[hand, first : first + 12 : 3] = 0.25
    return weights, joints


def targets(family: Family, vertices: np.ndarray, joints: np.ndarray) -> dict[int, np.ndarray]:
    """Places of BlazePose's skin landmarks on the neutral body; joints are the file's own (J, 3)."""
    out = {k: vertices[v] for k, v in family.points.items()}
    for eye, side in ((2, 0), (5, 3)):
        for i, step in ((1 + side, -0.015), (3 + side, 0.015)):
            out[i] = out[eye] + [step if side == 0 else -step, 0, 0]
    for i, x in ((9, 0.025), (10, -0.025)):
        out[i] = front_point(vertices, out[0][0] + x, out[0][1] - 0.036)
    for side in (0, 1):
        if family.fingers:
            first = family.hands[side]
            out[17 + side], out[19 + side], out[21 + side] = joints[first + 6], joints[first], joints[first + 13]
        else:
            wrist = joints[20 + side]
            for finger in (17, 19, 21):  # knuckles lie half way from the wrist to the tips
                out[finger + side] = wrist + 0.5 * (vertices[_SMPL_TIPS[finger + side]] - wrist)
    return out


def build(path: str | Path | None = None, device: str | torch.device = "cpu", name: str = "smpl") -> LinearBody:
    """Read the user's SMPL, SMPL-H or SMPL-X file (``name``: smpl, smplh or smplx) onto ``device``, float32.

    Raises:
        UserError: no file given, unreadable, of another kind, or damaged.
    """
    family = FAMILIES[name]
    if path is None:
        raise UserError(f"body {name}: found no file, wanted the path of your own {family.name} model (npz or pkl)")
    path = Path(path)
    data = read_model(path)
    check(data, family, path)
    real = {k: data[k].astype(np.float64) for k in ("v_template", "posedirs", "J_regressor", "weights")}
    shapes = data["shapedirs"][..., :N_SHAPE].astype(np.float64)
    lift = -real["v_template"][:, 1].min()
    template = real["v_template"] + [0, lift, 0]
    own_joints = real["J_regressor"] @ template
    to_weights, to_joints = fold(family)
    weights = real["weights"] @ to_weights
    weights /= weights.sum(1, keepdims=True)
    bends = np.zeros((family.vertices, 3, 9 * 23))  # fingers stay at rest: their blend shapes are never called for
    kept = 9 * (23 if not family.fingers else 21)
    bends[..., :kept] = real["posedirs"][..., :kept]
    index, weight = landmark_table(template, targets(family, template, own_joints))
    of_joint = np.array([REGION_NAMES.index(REGION_OF_JOINT.get(j.split("_")[-1], "torso")) for j in JOINT_NAMES])

    def tensor(value: np.ndarray) -> torch.Tensor:
        kind = torch.float32 if value.dtype.kind == "f" else torch.int64
        return torch.as_tensor(np.ascontiguousarray(value), dtype=kind, device=device)

    return LinearBody(
        template=tensor(template),
        shape_dirs=tensor(shapes),
        joints=tensor(to_joints @ own_joints),
        joint_dirs=tensor(np.einsum("jk,kv,vds->jds", to_joints, real["J_regressor"], shapes, optimize=True)),
        weights=tensor(weights),
        faces=tensor(data["f"].astype(np.int64)),
        regions=tensor(of_joint[weights.argmax(1)]),
        landmark_index=tensor(index),
        landmark_weight=tensor(weight),
        name=name,
        pose_dirs=tensor(bends),
        card={"name": name, "source": path.name, "lift": float(lift)},
    )


smpl = partial(build, name="smpl")
smplh = partial(build, name="smplh")
smplx = partial(build, name="smplx")
