"""Meshes with a value and a colour per vertex on disk: what a measurement on a surface is shown as."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from torch import Tensor

from recon.files.atomic import write_whole
from recon.files.meshes import finite_vertices
from recon.types import Mesh

NO_VALUE = -1.0
"""Written where a value is infinite or NaN: nothing was measured."""


def write_coloured(parts: Mapping[str, tuple[Mesh, Tensor, Tensor]], path: str | Path, value: str) -> None:
    """Write meshes coloured per vertex: PLY (one mesh, with the values as property ``value``) or GLB (a node a mesh,
    with the values as attribute ``_VALUE``).

    Args:
        parts: name -> mesh (V, 3), values (V,), sRGB colours (V, 3) in [0, 1].
        path: .ply or .glb.
        value: what the values are called. Where they are infinite ``NO_VALUE`` is written.
    """
    import trimesh

    path, ply = Path(path), Path(path).suffix.lower() == ".ply"
    shapes = {name: _shape(name, *part, value, linear=not ply) for name, part in parts.items()}
    if ply:
        joined = trimesh.util.concatenate(list(shapes.values()))
        colours = np.concatenate([s.visual.vertex_colors for s in shapes.values()])
        joined.visual = trimesh.visual.ColorVisuals(joined, vertex_colors=colours)
        joined.vertex_attributes[value] = np.concatenate([s.vertex_attributes[value] for s in shapes.values()])
        write_whole(path, joined.export(file_type="ply"))
        return
    scene = trimesh.Scene()
    for name, shape in shapes.items():
        scene.add_geometry(shape, node_name=name, geom_name=name)
    write_whole(path, trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def _shape(name: str, mesh: Mesh, values: Tensor, colours: Tensor, value: str, linear: bool):
    import trimesh

    srgb = colours.cpu().double().numpy()
    rgb = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4) if linear else srgb  # glTF's rule
    shape = trimesh.Trimesh(finite_vertices(mesh, name), mesh.faces.cpu().numpy(), process=False)
    shape.visual = trimesh.visual.ColorVisuals(shape, vertex_colors=np.round(255 * rgb).astype(np.uint8))
    known = values.detach().cpu().float().nan_to_num(NO_VALUE, NO_VALUE, NO_VALUE).numpy()
    shape.vertex_attributes[value if not linear else f"_{value.upper()}"] = known
    return shape
