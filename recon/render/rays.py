"""Rays against one merged triangle mesh: the fixed camera of ``view`` on Mitsuba's scene (Embree or OptiX)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from recon.render import backend
from recon.render.view import Grid


@dataclass(frozen=True)
class Hits:
    """Where rays first hit, flat (N,)."""

    face: Tensor
    """(N,) long, row of the faces last set; -1 = nothing."""
    uv: Tensor
    """(N, 2) barycentric weights of the face's second and third corner."""
    depth: Tensor
    """(N,) ray parameter: for rays (u, v, 1) the depth [m]; infinite where nothing was hit."""


class RayScene:
    """One Mitsuba scene with one mesh, whose vertices and faces are set anew before each use.

    Setting costs one build of the ray structure (about 2 µs of CPU time a triangle, in parallel over cores), whether
    faces change or not. There is one scene per device.
    """

    def __init__(self, device: torch.device):
        self.device = device
        mi, _ = backend.load(device)
        mesh = mi.Mesh("merged", 3, 1)
        params = mi.traverse(mesh)
        params["faces"] = mi.UInt32([0, 1, 2])
        params["vertex_positions"] = mi.Float([0.0, 0, 1, 1, 0, 1, 0, 1, 1])
        params.update()
        self._scene: Any = mi.load_dict({"type": "scene", "merged": mesh}, parallel=False)
        self._params: Any = mi.traverse(self._scene)
        self._empty = True
        self._grids: dict[Grid, Any] = {}  # the last images' rays

    def set(self, vertices: Tensor, faces: Tensor) -> None:
        """Trace against these from now on. vertices (V, 3) float, faces (F, 3) int; F = 0 is an empty scene."""
        self._empty = len(faces) == 0
        if self._empty:
            return
        mi, _ = backend.load(self.device)
        self._params["merged.vertex_positions"] = backend.to_dr(mi.Float, vertices.float())
        self._params["merged.faces"] = backend.to_dr(mi.UInt32, faces.to(torch.int32))
        self._params.update()

    def values(self, directions: Tensor | Grid, value_of_face: Tensor) -> Tensor:
        """What rays (u, v, 1) from the origin see: (F,) integers > 0 -> (N,) int32, 0 = nothing.

        directions: (N, 2) slopes u, v, or a whole image's.
        """
        if self._empty or len(directions) == 0:
            return torch.zeros(len(directions), dtype=torch.int32, device=self.device)
        mi, dr = backend.load(self.device)
        table = backend.to_dr(mi.UInt32, value_of_face.to(torch.int32))
        hit = self._trace(mi.Point3f(0), self._slopes(directions))
        seen = hit.is_valid()
        return backend.to_torch(dr.select(seen, dr.gather(mi.UInt32, table, hit.prim_index, seen), 0), self.device)

    def hits(self, directions: Tensor | Grid) -> Hits:
        """Faces, barycentrics and depths that rays (u, v, 1) from the origin first hit; directions as in ``values``."""
        if self._empty or len(directions) == 0:
            n = len(directions)
            nothing = torch.full((n,), -1, dtype=torch.long, device=self.device)
            far = torch.full((n,), torch.inf, device=self.device)
            return Hits(nothing, torch.zeros(n, 2, device=self.device), far)
        mi, dr = backend.load(self.device)
        hit = self._trace(mi.Point3f(0), self._slopes(directions))
        seen = hit.is_valid()
        face = dr.select(seen, mi.Int32(hit.prim_index), -1)
        depth = dr.select(seen, hit.t, dr.inf)
        u, v = dr.select(seen, hit.prim_uv.x, 0), dr.select(seen, hit.prim_uv.y, 0)
        dr.eval(face, depth, u, v)
        out = [backend.to_torch(array, self.device) for array in (face, u, v, depth)]
        return Hits(out[0].long(), torch.stack(out[1:3], 1), out[3])

    def blocked(self, origins: Tensor, directions: Tensor, reach: float = torch.inf) -> Tensor:
        """Is something within ``reach`` (in lengths of the direction)? origins, directions (N, 3) -> (N,) bool."""
        if self._empty or len(origins) == 0:
            return torch.zeros(len(origins), dtype=torch.bool, device=self.device)
        mi, _ = backend.load(self.device)
        origin, direction = (mi.Point3f(*self._columns(origins)), mi.Vector3f(*self._columns(directions)))
        ray = mi.Ray3f(origin, direction, mi.Float(min(reach, 1e30)), 0.0, mi.Color0f())
        hit = self._scene.ray_test(ray, coherent=False)
        return backend.to_torch(mi.UInt32(hit), self.device).bool()

    def _trace(self, origin, direction):
        mi, _ = backend.load(self.device)
        return self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=True)

    def _columns(self, rows: Tensor) -> list:
        mi, _ = backend.load(self.device)
        return [backend.to_dr(mi.Float, column) for column in rows.float().T.contiguous()]

    def _slopes(self, directions: Tensor | Grid):
        mi, _ = backend.load(self.device)
        if not isinstance(directions, Grid):
            return mi.Vector3f(*self._columns(directions), 1)
        if directions not in self._grids:
            self._grids = dict(list(self._grids.items())[-7:])
            columns = directions.slopes().to(self.device).T.contiguous()
            self._grids[directions] = mi.Vector3f(*(backend.to_dr(mi.Float, column) for column in columns), 1)
        return self._grids[directions]


@cache
def _scene_on(device: torch.device) -> RayScene:
    return RayScene(device)


def scene_on(device: torch.device) -> RayScene:
    """The device's scene, made at first use. Set it before each use: others may have set it since."""
    return _scene_on(torch.device(device))
