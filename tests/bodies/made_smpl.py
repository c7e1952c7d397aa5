"""Made files in the formats of SMPL, SMPL-H and SMPL-X: true keys, shapes and joint tree, made numbers."""

from __future__ import annotations

import pickle
import sys
import types
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from recon.bodies.rig import PARENTS
from recon.bodies.smpl import FAMILIES

COLUMNS = {"smpl": 10, "smplh": 16, "smplx": 400}


def tree(name: str) -> list[int]:
    """Parents of a family's joints."""
    if name == "smpl":
        return list(PARENTS)
    out = list(PARENTS[:22]) + ([15, 15, 15] if name == "smplx" else [])
    for wrist in (20, 21):
        for _ in range(5):
            first = len(out)
            out += [wrist, first, first + 1]
    return out


def made_model(name: str, seed: int = 0) -> dict[str, np.ndarray]:
    """A model's arrays, deterministic."""
    rng = np.random.default_rng(seed)
    family = FAMILIES[name]
    n, k = family.vertices, family.joints
    weights = np.zeros((n, k))
    np.put_along_axis(weights, rng.integers(0, k, (n, 4)), rng.random((n, 4)) + 0.1, 1)
    weights /= weights.sum(1, keepdims=True)
    regressor = np.zeros((k, n))
    np.put_along_axis(regressor, rng.integers(0, n, (k, 6)), 1.0, 1)
    regressor /= regressor.sum(1, keepdims=True)
    parents = np.array(tree(name), np.int64)
    parents[0] = 2**32 - 1  # as the files have it
    return {
        "v_template": rng.normal(0, 0.4, (n, 3)),
        "shapedirs": rng.normal(0, 0.01, (n, 3, COLUMNS[name])),
        "posedirs": rng.normal(0, 0.002, (n, 3, 9 * (k - 1))),
        "J_regressor": regressor,
        "weights": weights,
        "f": rng.integers(0, n, (500, 3)).astype(np.uint32),
        "kintree_table": np.stack([parents, np.arange(k)]),
    }


def write_npz(path: Path, model: dict[str, np.ndarray]) -> Path:
    """As AMASS' SMPL-H and SMPL-X come, unreadable extra members included."""
    np.savez(path, **model, joint2num=np.array({"Pelvis": 0}, dtype=object), bs_style=np.array("lbs"))
    return path


def write_pickle(path: Path, model: dict[str, np.ndarray]) -> Path:
    """As SMPL comes: a Python 2 pickle with a sparse regressor and chumpy arrays (whose library is not installed)."""
    chumpy, reordering = types.ModuleType("chumpy.ch"), types.ModuleType("chumpy.reordering")

    class Ch:
        pass

    class Select(Ch):
        pass

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    Select.__module__, Select.__qualname__ = "chumpy.reordering", "Select"
    chumpy.Ch, reordering.Select = Ch, Select  # type: ignore[attr-defined]
    whole, template, dirs = Ch(), Ch(), Select()
    whole.x = np.concatenate([model["shapedirs"], model["shapedirs"][..., :2]], 2)
    template.x = model["v_template"]
    keep = np.arange(whole.x.size).reshape(whole.x.shape)[..., : model["shapedirs"].shape[2]]
    dirs.a, dirs.idxs, dirs.preferred_shape = whole, keep.ravel(), model["shapedirs"].shape
    data = dict(model, J_regressor=sp.csc_matrix(model["J_regressor"]), v_template=template, shapedirs=dirs)
    data |= {"bs_style": "lbs", "bs_type": "lrotmin"}
    names = {"chumpy": types.ModuleType("chumpy"), "chumpy.ch": chumpy, "chumpy.reordering": reordering}
    sys.modules.update(names)
    try:
        path.write_bytes(pickle.dumps(data, protocol=2))
    finally:
        for key in names:
            del sys.modules[key]
    return path


def slow_twin(model: dict[str, np.ndarray], shape: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SMPL's formulas one joint and one vertex at a time, all of the file's joints, fingers and face at rest.

    shape (S,), pose (22 or 24, 3) -> vertices (V, 3), joints (J, 3).
    """
    from scipy.spatial.transform import Rotation

    count = len(model["weights"][0])
    full = np.zeros((count, 3))
    full[: len(pose)] = pose
    rotation = Rotation.from_rotvec(full).as_matrix()
    v = model["v_template"] + model["shapedirs"][..., : len(shape)] @ shape
    joints = model["J_regressor"] @ v
    v = v + model["posedirs"] @ (rotation[1:] - np.eye(3)).ravel()
    parents = [-1] + [int(p) for p in model["kintree_table"][0, 1:]]
    to_world = []
    for j, p in enumerate(parents):
        step = np.eye(4)
        step[:3, :3] = rotation[j]
        step[:3, 3] = joints[j] - (joints[p] if p >= 0 else 0)
        to_world.append(step if p < 0 else to_world[p] @ step)
    out = np.zeros_like(v)
    for j, g in enumerate(to_world):
        out += model["weights"][:, j : j + 1] * ((v - joints[j]) @ g[:3, :3].T + g[:3, 3])
    return out, np.array([g[:3, 3] for g in to_world])
