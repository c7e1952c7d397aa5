"""Labelled scans: point clouds and meshes with a label per vertex or per face, brought to metres and y up."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from recon.files.masks import parse_labels
from recon.types import Scan, UserError

READABLE = ("ply", "obj", "glb", "gltf", "stl", "off", "npz")
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Unit -> metres."""
UPS = ("x", "y", "z", "-x", "-y", "-z")
TALL = (0.6, 2.6)
"""Heights that a scan of a person can have [m]: a unit is guessed only where it makes this true."""
PROPERTIES = ("label", "labels", "segment", "segmentation", "class", "scalar_label", "scalar_labels", "scalar_Label")
"""Names under which a PLY file may hold its labels, where --labels does not name one."""
FEWEST = 100
"""Fewer points of a garment than this don't show its shape."""
SAMPLES = 60_000
"""Points drawn from a scan that is a mesh."""
UPPER, LOWER = ("jacket", "top", "tank", "tshirt", "shirt"), ("trousers", "shorts", "skirt")


@dataclass(frozen=True)
class ScanSource:
    """Where a scan lies and how it is to be understood."""

    path: Path
    """PLY, OBJ, GLB, STL, OFF (mesh or points), or npz with ``points`` or ``vertices`` (and ``faces``, ``labels``)."""
    labels: str = ""
    """npz (array ``labels``), npy, or the name of a property of the PLY file; "" looks in the scan's own file."""
    values: str = ""
    """What the numbers mean, e.g. ``0=body,3=top,5=trousers``; "" = 0 body, then the garments as they were named.
    Other numbers are unlabelled."""
    unit: str = "auto"
    """m, cm, mm, in, or auto: the one that makes a person of it."""
    up: str = "auto"
    """Which axis points up: x, y, z, -x, -y, -z, or auto."""


@dataclass
class _Raw:
    """A scan as it stands in its file."""

    vertices: NDArray
    faces: NDArray
    """(F, 3), empty for a point cloud."""
    properties: dict[str, NDArray] = field(default_factory=dict)
    """Labels that the file itself carries, by name."""


def read_scan(source: ScanSource, named: Sequence[str], order: Sequence[str]) -> Scan:
    """Read a labelled scan.

    Args:
        source: see :class:`ScanSource`.
        named: the garments as the user named them: what 1, 2 ... mean unless ``source.values`` says otherwise.
        order: the same, outermost first: the order of the result's names.

    Returns:
        Points in metres with y up; guesses are told in its notes. Meshes are sampled evenly by area.

    Raises:
        UserError: one line about a file that is missing or broken, labels that don't fit it, a garment without points,
            a size or direction that can't be a person's.
    """
    _choice("--unit", source.unit, ("auto", *UNITS))
    _choice("--up", source.up, ("auto", *UPS))
    raw = _read(source.path)
    numbers = _labels(source, raw)
    meaning = parse_labels(source.values) or {0: "body", **{k + 1: name for k, name in enumerate(named)}}
    strangers = sorted(set(meaning.values()) - {"body", *named})
    if strangers:
        raise UserError(f"--values: found {', '.join(strangers)}; wanted body and {', '.join(named)}")
    names = ("body", *order)
    index = np.full(len(numbers), -1)
    for number, name in meaning.items():
        index[numbers == number] = names.index(name)
    notes: list[str] = []
    points, index = _sound(*_points(raw, index), source.path, notes)
    _enough(index, names, meaning, source.path)
    up = source.up if source.up != "auto" else _guess_up(points, index, names, source.path, notes)
    points = _turned(points, up)
    scale = UNITS[source.unit] if source.unit != "auto" else _guess_unit(points, source.path, notes)
    return Scan(torch.tensor(points * scale, dtype=torch.float32), torch.as_tensor(index), names, tuple(notes))


def _choice(flag: str, found: str, wanted: Sequence[str]) -> None:
    if found not in wanted:
        raise UserError(f"{flag}: found {found!r}; wanted one of {', '.join(wanted)}")


def _read(path: Path) -> _Raw:
    kind = path.suffix.lower().lstrip(".")
    if not path.is_file():
        raise UserError(f"{path}: no such file; wanted a scan ({', '.join(READABLE)})")
    if kind not in READABLE:
        raise UserError(f"{path}: a .{kind} file; wanted a scan ({', '.join(READABLE)})")
    try:
        raw = _read_npz(path) if kind == "npz" else _read_mesh_or_points(path, kind)
    except UserError:
        raise
    except Exception as error:  # whatever a parser raises on a broken file is the file's fault
        raise UserError(f"{path}: cannot be read as {kind} ({type(error).__name__}); wanted a scan") from None
    if raw.vertices.ndim != 2 or raw.vertices.shape[1] != 3 or not len(raw.vertices):
        raise UserError(f"{path}: found no points; wanted (N, 3) coordinates")
    if len(raw.faces) and (raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices)):
        raise UserError(f"{path}: has faces that name missing vertices; wanted indices of its {len(raw.vertices)}")
    return raw


def _read_npz(path: Path) -> _Raw:
    with np.load(path, allow_pickle=False) as file:
        name = next((n for n in ("points", "vertices") if n in file.files), None)
        if name is None:
            raise UserError(f"{path}: holds {', '.join(file.files) or 'nothing'}; wanted points or vertices (N, 3)")
        faces = file["faces"].astype(np.int64) if "faces" in file.files else np.zeros((0, 3), np.int64)
        own = {"labels": file["labels"]} if "labels" in file.files else {}
        return _Raw(file[name].astype(np.float64), faces.reshape(-1, 3), own)


def _read_mesh_or_points(path: Path, kind: str) -> _Raw:
    import trimesh

    data = io.BytesIO(path.read_bytes())
    if kind in ("glb", "gltf"):
        shape = trimesh.load_scene(data, file_type=kind, process=False).to_geometry()
    elif kind == "obj":  # its own reader keeps vertices as they are numbered
        return _read_obj(path)
    else:
        shape = trimesh.load(data, file_type=kind, process=False)
    own: dict[str, NDArray] = {}
    for element in shape.metadata.get("_ply_raw", {}).values():
        table = element.get("data")
        names = getattr(getattr(table, "dtype", None), "names", None) or (table if isinstance(table, dict) else ())
        own |= {str(n): np.asarray(table[n]).reshape(-1) for n in names if n not in ("x", "y", "z", "vertex_indices")}
    faces = np.asarray(getattr(shape, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)
    return _Raw(np.asarray(shape.vertices, np.float64), faces, own)


def _read_obj(path: Path) -> _Raw:
    from recon.files.meshes import read_mesh

    lines = path.read_text(errors="replace").splitlines()
    if any(line.startswith("f ") for line in lines):
        mesh = read_mesh(path)
        return _Raw(mesh.vertices.double().numpy(), mesh.faces.numpy())
    rows = [[float(v) for v in line.split()[1:4]] for line in lines if line.startswith("v ")]
    return _Raw(np.array(rows, np.float64).reshape(-1, 3), np.zeros((0, 3), np.int64))


def _labels(source: ScanSource, raw: _Raw) -> NDArray:
    """A whole number per vertex, or per face of a mesh."""
    given, wanted = source.labels, "wanted --labels with an npz (labels), an npy, or a property of the PLY file"
    if not given:
        name = next((n for n in PROPERTIES if n in raw.properties), None)
        if name is None:
            raise UserError(f"{source.path}: holds no labels; {wanted}")
        found, where = raw.properties[name], f"{source.path}: {name}"
    elif given in raw.properties:
        found, where = raw.properties[given], f"{source.path}: {given}"
    else:
        found, where = _label_file(Path(given), wanted), given
    found = found.reshape(-1)
    if not np.issubdtype(found.dtype, np.number) or not np.isfinite(found.astype(np.float64)).all():
        raise UserError(f"{where}: holds {found.dtype} that are no numbers; wanted a whole number per vertex or face")
    if len(found) not in {len(raw.vertices), len(raw.faces)} - {0}:
        counts = f"{len(raw.vertices)} vertices" + (f" or {len(raw.faces)} faces" if len(raw.faces) else "")
        raise UserError(f"{where}: found {len(found)} labels; wanted one for each of {counts}")
    return np.round(found.astype(np.float64)).astype(np.int64)


def _label_file(path: Path, wanted: str) -> NDArray:
    if not path.is_file():
        raise UserError(f"{path}: no such file; {wanted}")
    try:
        with open(path, "rb") as file:
            data = np.load(file, allow_pickle=False)
            if isinstance(data, np.ndarray):
                return data
            if "labels" in data.files:
                return data["labels"]
            raise UserError(f"{path}: holds {', '.join(data.files) or 'nothing'}; wanted an array named labels")
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read ({type(error).__name__}); {wanted}") from None


def _points(raw: _Raw, index: NDArray) -> tuple[NDArray, NDArray]:
    """Points and their labels: the cloud itself, or even samples of the mesh."""
    if not len(raw.faces):
        return raw.vertices, index
    corners = raw.vertices[raw.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area = np.where(np.isfinite(area), area, 0)
    if area.sum() <= 0:
        return raw.vertices, index if len(index) == len(raw.vertices) else np.full(len(raw.vertices), -1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), SAMPLES, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), SAMPLES)
    nearest = raw.faces[face, share.argmax(1)]
    own = index[face] if len(index) == len(raw.faces) != len(raw.vertices) else index[nearest]
    return (corners[face] * share[..., None]).sum(1), own


def _sound(points: NDArray, index: NDArray, path: Path, notes: list[str]) -> tuple[NDArray, NDArray]:
    good = np.isfinite(points).all(1)
    if not good.all():
        if good.mean() < 0.5:
            raise UserError(f"{path}: {int((~good).sum())} of {len(good)} points are NaN or infinite; wanted numbers")
        notes.append(f"{int((~good).sum())} points that are NaN or infinite were left out")
    return points[good], index[good]


def _enough(index: NDArray, names: Sequence[str], meaning: dict[int, str], path: Path) -> None:
    for k, name in enumerate(names):
        count, numbers = int((index == k).sum()), [str(n) for n, m in meaning.items() if m == name]
        if name != "body" and count < FEWEST:
            said = ", ".join(numbers) or "none"
            raise UserError(
                f"{path}: found {count} points of {name} (label {said}); wanted {FEWEST} at least (see --values)"
            )


def _guess_up(points: NDArray, index: NDArray, names: Sequence[str], path: Path, notes: list[str]) -> str:
    """The axis along which upper garments lie above lower ones; with one garment only, the longer of y and z."""
    above = [k for k, n in enumerate(names) if n in UPPER]
    below = [k for k, n in enumerate(names) if n in LOWER]
    if above and below:
        away = np.median(points[np.isin(index, above)], 0) - np.median(points[np.isin(index, below)], 0)
        axis = int(np.abs(away).argmax())
        up = ("-" if away[axis] < 0 else "") + "xyz"[axis]
    else:
        span = np.quantile(points, 0.995, 0) - np.quantile(points, 0.005, 0)
        if max(span[1], span[2]) < 1.25 * min(span[1], span[2]):
            raise UserError(f"{path}: is as long in y as in z; wanted --up y or --up z")
        up = "y" if span[1] > span[2] else "z"
    if up != "y":
        notes.append(f"taken to stand along {up}; say --up if that is wrong")
    return up


def _turned(points: NDArray, up: str) -> NDArray:
    """The points with ``up`` turned to y; a rotation, so that left stays left."""
    axis, sign = "xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0
    rows = np.eye(3)
    vertical = sign * rows[axis]
    side = rows[(axis + 1) % 3]
    return points @ np.stack([np.cross(vertical, side), vertical, side]).T


def _guess_unit(points: NDArray, path: Path, notes: list[str]) -> float:
    height = float(np.subtract(*np.quantile(points[:, 1], (0.999, 0.001))))
    for unit in ("m", "mm", "cm"):
        if TALL[0] <= height * UNITS[unit] <= TALL[1]:
            if unit != "m":
                notes.append(f"taken to be in {unit} ({height:.0f} high); say --unit if that is wrong")
            return UNITS[unit]
    raise UserError(f"{path}: is {height:.3g} high; wanted a person in m, cm or mm (or say --unit)")
