"""Meshes on disk: OBJ with panel coordinates, GLB scenes, and reading what others wrote."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.files.atomic import write_whole
from recon.types import Garment, Mesh, UserError

Colour = tuple[float, float, float]

_KIND = "# garment"
"""Begins the comment by which a garment's OBJ file says its kind."""
_READABLE = ("obj", "ply", "stl", "off", "glb", "gltf")


def finite_vertices(mesh: Mesh, name: str) -> np.ndarray:
    """(V, 3) float64 vertices of one mesh; a ValueError where what is no place in space would be written."""
    vertices = mesh.vertices.detach().cpu().double()
    if vertices.ndim == 3 and vertices.shape[0] == 1:
        vertices = vertices[0]
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"{name}: vertices are {tuple(vertices.shape)}; wanted (V, 3)")
    bad = int((~torch.isfinite(vertices).all(dim=1)).sum())
    if bad:
        raise ValueError(f"{name}: {bad} of {len(vertices)} vertices are NaN or infinite; nothing was written")
    faces = mesh.faces
    if len(faces) and (int(faces.min()) < 0 or int(faces.max()) >= len(vertices)):
        raise ValueError(f"{name}: faces name vertices outside 0..{len(vertices) - 1}; nothing was written")
    return vertices.numpy()


def write_obj(thing: Mesh | Garment, path: str | Path, name: str = "") -> None:
    """Write one named object in metres, y up; vertices stay welded.

    A garment's texture coordinates are its panel coordinates in metres, one per corner: the sewing pattern is the UV
    map; one without panels has none. ``name`` defaults to the file's stem. NaN, infinities and bad indices are a
    ValueError before anything is written.
    """
    path = Path(path)
    name = name or path.stem
    mesh = thing.mesh if isinstance(thing, Garment) else thing
    vertices = finite_vertices(mesh, name)
    panels = isinstance(thing, Garment) and thing.has_panels
    lines = [f"# {name}: metres, y up" + (", vt = panel coordinates in metres" if panels else "")]
    if isinstance(thing, Garment):
        lines.append(f"{_KIND} {thing.kind}")
    lines.append(f"o {name}")
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    corners = (mesh.faces.cpu() + 1).tolist()
    if isinstance(thing, Garment) and thing.has_panels:
        points = thing.panel_points.detach().cpu()
        if not torch.isfinite(points).all():
            raise ValueError(f"{name}: panel coordinates are NaN or infinite; nothing was written")
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in points.tolist()]
        for (a, b, c), (i, j, k) in zip(corners, (thing.panel_faces.cpu() + 1).tolist(), strict=True):
            lines.append(f"f {a}/{i} {b}/{j} {c}/{k}")
    else:
        lines += [f"f {a} {b} {c}" for a, b, c in corners]
    write_whole(path, "\n".join(lines) + "\n")


def write_ply(mesh: Mesh, path: str | Path, name: str = "") -> None:
    """Write a binary PLY in metres, y up; vertices stay welded. Errors as in ``write_obj``."""
    import trimesh

    vertices = finite_vertices(mesh, name or Path(path).stem)
    shape = trimesh.Trimesh(vertices, mesh.faces.cpu().numpy(), process=False)
    write_whole(path, trimesh.exchange.ply.export_ply(shape, vertex_normal=False))


def write_mesh(thing: Mesh | Garment, path: str | Path, colour: Colour = (0.75, 0.75, 0.78)) -> None:
    """Write OBJ, PLY or GLB, as the path's ending says; OBJ keeps a garment's panels. UserError: another ending."""
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind == "obj":
        write_obj(thing, path)
    elif kind == "ply":
        write_ply(thing.mesh if isinstance(thing, Garment) else thing, path)
    elif kind == "glb":
        write_glb({path.stem: (thing, colour)}, path)
    else:
        raise UserError(f"{path}: ends in {path.suffix!r}; wanted .obj, .ply or .glb")


def write_glb(parts: Mapping[str, tuple[Mesh | Garment, Colour]], path: str | Path) -> None:
    """Write a binary glTF scene: one named node per part, in its sRGB colour (each channel in [0, 1]).

    Garments are open surfaces, hence double-sided; bodies are closed and are not.
    """
    import trimesh

    scene = trimesh.Scene()
    for name, (thing, colour) in parts.items():
        garment = isinstance(thing, Garment)
        mesh = thing.mesh if isinstance(thing, Garment) else thing
        vertices, faces = finite_vertices(mesh, name), mesh.faces.cpu().numpy()
        shape = trimesh.Trimesh(vertices, faces, vertex_normals=_normals(vertices, faces), process=False)
        material = trimesh.visual.material.PBRMaterial(
            name=name,
            baseColorFactor=np.round([255 * c for c in (*linear_colour(colour), 1.0)]).astype(np.uint8),
            metallicFactor=0.0,
            roughnessFactor=0.9,
            doubleSided=garment,
        )
        shape.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(shape, node_name=name, geom_name=name)
    write_whole(path, trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def write_textured_glb(mesh: Mesh, coordinates: Tensor, texture: Tensor, path: str | Path) -> None:
    """Write one open, two-sided surface with its texture inside the file.

    Args:
        mesh: one vertex for each texture coordinate.
        coordinates: (V, 2) in [0, 1], from left and top of the image.
        texture: (h, w, 3) sRGB in [0, 1].
        path: the .glb file.
    """
    import trimesh
    from PIL import Image

    name = Path(path).stem
    vertices, faces = finite_vertices(mesh, name), mesh.faces.cpu().numpy()
    picture = Image.fromarray((texture.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
    material = trimesh.visual.material.PBRMaterial(
        name=name, baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True
    )
    uv = coordinates.cpu().double().numpy() * [1, -1] + [0, 1]  # trimesh counts from below
    shape = trimesh.Trimesh(vertices, faces, vertex_normals=_normals(vertices, faces), process=False)
    shape.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    scene = trimesh.Scene()
    scene.add_geometry(shape, node_name=name, geom_name=name)
    write_whole(path, trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def linear_colour(colour: Colour) -> list[float]:
    """sRGB -> linear: glTF wants colour factors linear, people name colours in sRGB."""
    return [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, area-weighted; up where no area meets a vertex (glTF allows no zero normals)."""
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, faces[:, corner], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 1.0, 0.0))


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh: OBJ (welded as written), PLY, STL, OFF, GLB or glTF; polygons are cut into fans.

    Objects of one file are joined. Vertices (V, 3) float32 as they stand in the file, faces (F, 3) long, on the CPU.
    UserError: missing file, another format, unreadable, no triangles, NaN or infinite vertices, indices out of range.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if not path.is_file():
        raise UserError(f"{path}: no such file; wanted a mesh ({', '.join(_READABLE)})")
    if kind not in _READABLE:
        raise UserError(f"{path}: a .{kind} file; wanted a mesh ({', '.join(_READABLE)})")
    try:
        vertices, faces = _read_obj(path) if kind == "obj" else _read_with_trimesh(path, kind)
    except UserError:
        raise
    except Exception as error:  # whatever a parser raises on a broken file is the file's fault
        raise UserError(f"{path}: cannot be read as {kind} ({type(error).__name__}); wanted a mesh") from None
    if len(faces) == 0:
        raise UserError(f"{path}: {len(vertices)} vertices without a triangle; wanted a surface")
    if not torch.isfinite(vertices).all():
        raise UserError(f"{path}: has vertices that are NaN or infinite; wanted numbers in metres")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise UserError(f"{path}: has faces that name missing vertices; wanted indices of its {len(vertices)} vertices")
    return Mesh(vertices, faces)


def _read_obj(path: Path) -> tuple[Tensor, Tensor]:
    """Vertices and fan triangles of an OBJ file, vertices neither split at texture seams nor reordered."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for line in path.read_text(errors="replace").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            vertices.append([float(number) for number in rest.split()[:3]])
        elif word == "f":
            at = [int(corner.split("/")[0]) for corner in rest.split()]
            at = [i - 1 if i > 0 else len(vertices) + i for i in at]
            faces += [(at[0], at[i], at[i + 1]) for i in range(1, len(at) - 1)]
    return torch.tensor(vertices, dtype=torch.float32).reshape(-1, 3), torch.tensor(faces, dtype=torch.long).reshape(
        -1, 3
    )


def read_garment(path: str | Path) -> Garment | Mesh:
    """Read a garment, with its panels where it has some, from an OBJ file of ``write_obj``; a mesh from any other.

    Seams have lost their names: border labels are 0 at open edges and 1 ("seam") at seams.
    UserError: as :func:`read_mesh`, or corners without panel coordinates.
    """
    path = Path(path)
    mesh = read_mesh(path)
    lines = path.read_text(errors="replace").splitlines() if path.suffix.lower() == ".obj" else []
    kind = next((line.removeprefix(_KIND).strip() for line in lines if line.startswith(_KIND)), "")
    if not kind:
        return mesh
    if not any(line.startswith("vt ") or (line.startswith("f ") and "/" in line) for line in lines):
        return Garment.bare(kind, mesh)
    flat = [[float(n) for n in line.split()[1:3]] for line in lines if line.startswith("vt ")]
    corners = [[c.split("/") for c in line.split()[1:]] for line in lines if line.startswith("f ")]
    try:
        points = torch.tensor(flat, dtype=torch.float32).reshape(-1, 2)
        panel_faces = torch.tensor([[int(c[1]) - 1 for c in face] for face in corners]).reshape(-1, 3)
        sound = bool(points.isfinite().all()) and 0 <= int(panel_faces.min()) and int(panel_faces.max()) < len(points)
    except (ValueError, IndexError, RuntimeError):
        sound = False
    if not sound or len(panel_faces) != len(mesh.faces):
        raise UserError(f"{path}: a garment's file without sound panel coordinates; wanted three v/vt corners a face")
    return _with_panels(kind, mesh, points, panel_faces)


def _with_panels(kind: str, mesh: Mesh, points: Tensor, panel_faces: Tensor) -> Garment:
    """The garment of a mesh and its panels (P, 2); triangles that turn the other way are the back panel's."""
    a, b, c = points[panel_faces].unbind(1)
    u, v = b - a, c - a
    vertex_of_point = torch.zeros(len(points), dtype=torch.long)
    vertex_of_point[panel_faces.flatten()] = mesh.faces.flatten()
    edges = torch.cat([panel_faces[:, [0, 1]], panel_faces[:, [1, 2]], panel_faces[:, [2, 0]]]).sort(1).values
    unique, count = edges.unique(dim=0, return_counts=True)
    labels = torch.full((len(points),), -1)
    labels[unique[count == 1].flatten()] = 0
    sewn = torch.bincount(vertex_of_point, minlength=len(mesh.vertices))[vertex_of_point] > 1
    labels[(labels == 0) & sewn] = 1
    return Garment(
        kind=kind,
        mesh=mesh,
        panel_points=points,
        panel_faces=panel_faces,
        panel_of_face=(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0).long(),
        vertex_of_point=vertex_of_point,
        border_labels=labels,
        seam_names=("open", "seam"),
    )


def _read_with_trimesh(path: Path, kind: str) -> tuple[Tensor, Tensor]:
    """The same through trimesh, every node of a scene in its place."""
    import trimesh

    loaded = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type=kind, process=False).to_geometry()
    if not isinstance(loaded, trimesh.Trimesh):
        return torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    if kind == "stl":  # the one format in which triangles cannot share vertices
        loaded.merge_vertices()
    vertices = torch.as_tensor(np.array(loaded.vertices), dtype=torch.float32)
    return vertices, torch.as_tensor(np.array(loaded.faces), dtype=torch.long)
