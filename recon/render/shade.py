"""Pictures for people: soft light from a sky and a large lamp, with shadows, on smooth two-sided surfaces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.render.hits import Merged, merge, scene_of
from recon.render.rays import RayScene
from recon.render.view import Grid, View, view_of
from recon.types import Camera, Mesh

Colour = tuple[float, float, float] | Tensor
"""sRGB in [0, 1]: one for the mesh, or (V, 3) one per vertex."""


@dataclass(frozen=True)
class Look:
    """How a picture is lit and sampled."""

    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    """sRGB in [0, 1]; None = transparent: pictures get a fourth channel, alpha."""
    samples: int = 9
    """Camera rays per pixel, a square number."""
    sky_rays: int = 6
    """Rays to the sky per camera ray: smoother shade in folds, slower."""
    lamp_rays: int = 2
    """Rays to the lamp per camera ray: smoother shadow borders, slower."""
    lamp: tuple[float, float, float] = (-0.85, 0.75, 0.55)
    """Direction to the lamp, seen from the camera: right, up, towards the camera."""
    lamp_radius: float = 0.25
    """Half width of the lamp at distance one: larger = softer shadows."""
    lamp_light: float = 0.95
    """Strength of the lamp; with ``sky_light`` about 1.3 for a surface that faces both: whites may clip."""
    sky_light: float = 0.55
    """Strength of the sky."""
    ground_light: float = 0.28
    """Strength of the light from below."""
    inside: float = 0.7
    """Brightness of surfaces seen from their inner side."""


def picture(
    meshes: Sequence[Mesh],
    colours: Sequence[Colour],
    camera: Camera,
    size: tuple[int, int] | None = None,
    look: Look | None = None,
) -> Tensor:
    """A shaded picture (h, w, 3) uint8 of the meshes, (h, w, 4) with a transparent background.

    The same meshes give the same picture, bit for bit. size (h, w) defaults to the camera's.
    """
    look = look or Look()
    if len(meshes) != len(colours):
        raise ValueError(f"render: found {len(meshes)} meshes and {len(colours)} colours; wanted as many of each")
    grid = math.isqrt(look.samples)
    view, merged = view_of(camera, size), merge(meshes)
    scene = scene_of(merged, view)
    hits = scene.hits(view.grid(grid))
    rows = torch.nonzero(hits.face >= 0)[:, 0]
    surface = _surface(merged, hits.face[rows], hits.uv[rows], camera)
    light = _light(scene, view, surface, _dither(rows, view.grid(grid)), camera, look)
    albedo = _albedo(merged, meshes, colours, hits.face[rows], hits.uv[rows])
    tone = torch.where(surface.inner, look.inside, 1.0)[:, None]
    fine = light.new_zeros(len(hits.face), 4)
    fine[rows] = torch.cat([albedo * tone * light[:, None], torch.ones_like(light)[:, None]], 1)
    h, w = view.size
    return _develop(fine.reshape(grid**2, h, w, 4).mean(0), look.background)


def orbit_camera(
    meshes: Sequence[Mesh], azimuth: float = 0.0, elevation: float = 0.0, size: tuple[int, int] = (768, 512)
) -> Camera:
    """A camera that looks at the meshes' middle from around, at a distance from which every azimuth fits the picture.

    Args:
        azimuth: [rad] 0 = in front (from +z), positive towards the wearer's left (+x).
        elevation: [rad] positive = from above.
        size: (h, w) pixels.
    """
    points = merge(meshes).vertices
    low, high = points.amin(0), points.amax(0)
    middle = (low + high) / 2
    radius = float((points - middle)[:, [0, 2]].norm(dim=1).max())
    half = float(high[1] - low[1]) / 2
    (sa, ca), (se, ce) = ((math.sin(a), math.cos(a)) for a in (azimuth, elevation))
    right, back = [ca, 0.0, -sa], [sa * ce, se, ca * ce]  # back: from the meshes to the camera
    up = [-sa * se, ce, -ca * se]
    rotation = points.new_tensor([right, [-c for c in up], [-c for c in back]])
    h, w = size
    focal = 0.5 * max(h, w) / math.tan(math.radians(13.0))  # 26 degrees: close to how garments are photographed
    turn = torch.linspace(0, 2 * math.pi, 33, device=points.device)[:-1]
    ring = torch.stack([radius * turn.cos(), torch.full_like(turn, half), radius * turn.sin()], 1).to(points)
    corners = torch.cat([ring, ring * ring.new_tensor([1, -1, 1])]) @ rotation.T
    reach = corners[:, :2].abs() * focal / (0.46 * corners.new_tensor([w, h])) - corners[:, 2:]
    distance = float(reach.max())
    offset = points.new_tensor([0, 0, distance]) - rotation @ middle
    intrinsics = points.new_tensor([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]])
    return Camera(intrinsics, rotation, offset, size)


def turntable(
    meshes: Sequence[Mesh],
    colours: Sequence[Colour],
    n: int = 8,
    size: tuple[int, int] = (512, 384),
    look: Look | None = None,
) -> list[Tensor]:
    """n pictures from evenly spread azimuths, the first from the front, slightly from above."""
    cameras = (orbit_camera(meshes, 2 * math.pi * i / n, math.radians(8.0), size) for i in range(n))
    return [picture(meshes, colours, camera, size, look) for camera in cameras]


@dataclass(frozen=True)
class _Surface:
    """Points to be lit, (N, 3) each, world; normals point to the viewer's side."""

    points: Tensor
    smooth: Tensor
    flat: Tensor
    inner: Tensor
    """(N,) bool: seen from the side that the faces turn away."""


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(V, 3) unit normals: of the faces around, weighted by their angle at the vertex (Thürmer and Wüthrich 1998)."""
    corners = vertices[faces]
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=1
    )
    out = torch.zeros_like(vertices)
    for i in range(3):
        one, two = (torch.nn.functional.normalize(corners[:, (i + j) % 3] - corners[:, i], dim=1) for j in (1, 2))
        angle = torch.acos((one * two).sum(1, keepdim=True).clamp(-1, 1))
        out.index_add_(0, faces[:, i], angle * normal)
    return torch.nn.functional.normalize(out, dim=1)


def _surface(merged: Merged, face: Tensor, uv: Tensor, camera: Camera) -> _Surface:
    normals = vertex_normals(merged.vertices, merged.faces)
    corners = merged.faces[face]
    weights = torch.cat([1 - uv.sum(1, keepdim=True), uv], 1)[..., None].to(merged.vertices)
    points = (merged.vertices[corners] * weights).sum(1)
    smooth = torch.nn.functional.normalize((normals[corners] * weights).sum(1), dim=1)
    a, b, c = merged.vertices[corners].unbind(1)
    flat = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    eye = -(camera.R.T @ camera.t).detach().to(points)
    inner = ((eye - points) * flat).sum(1) < 0
    side = torch.where(inner, -1.0, 1.0)[:, None]
    return _Surface(points, smooth * side, flat * side, inner)


def _light(scene: RayScene, view: View, surface: _Surface, turn: Tensor, camera: Camera, look: Look) -> Tensor:
    """(N,) light that reaches each point: lamp and sky, less what is in the way; turn (N, 2) shifts the rays."""
    up = camera.R.detach().to(surface.points) * surface.points.new_tensor([[1.0], [-1.0], [-1.0]])
    axis = torch.nn.functional.normalize(surface.points.new_tensor(look.lamp), dim=0) @ up  # camera's axes -> world
    origins = view.traced(view.points(surface.points + 2e-3 * surface.flat))
    total = torch.zeros_like(surface.points[:, 0])
    for i in range(look.sky_rays):
        ray = _cosine_direction(surface.smooth, _shifted(i, look.sky_rays, turn))
        above = 0.5 + 0.5 * ray[:, 1]
        open_sky = ~scene.blocked(origins, view.traced(view.directions(ray)))
        sky = look.ground_light + (look.sky_light - look.ground_light) * above
        total += torch.where(open_sky, sky, 0.12 * sky) / look.sky_rays  # what blocks the sky reflects some
    for i in range(look.lamp_rays):
        u, v = (_shifted(i, look.lamp_rays, turn.flip(1)) * 2 - 1).unbind(1)
        ray = torch.nn.functional.normalize(axis + look.lamp_radius * (u[:, None] * up[0] + v[:, None] * up[1]), dim=1)
        facing = (ray * surface.smooth).sum(1).clamp_min(0) * ((ray * surface.flat).sum(1) > 0)
        lit = ~scene.blocked(origins, view.traced(view.directions(ray)))
        total += look.lamp_light * facing * lit / look.lamp_rays
    return total


def _dither(rows: Tensor, grid: Grid) -> Tensor:
    """(N, 2) shifts in the unit square, evenly spread among neighbours in the fine image, alike in each picture.

    Interleaved gradient noise (Jimenez 2014) at two far places.
    """
    (h, w), n = grid.size, grid.n
    part, pixel = rows // (h * w), rows % (h * w)
    x = (pixel % w * n + part % n).double()
    y = (pixel // w * n + part // n).double()
    noise = [(52.9829189 * ((0.06711056 * (x + s) + 0.00583715 * (y + s)) % 1.0)) % 1.0 for s in (0.0, 47.31)]
    return torch.stack(noise, 1).float()


def _shifted(i: int, n: int, turn: Tensor) -> Tensor:
    """Point i of n of Roberts' R2 sequence in the unit square, shifted by (N, 2) and wrapped."""
    point = turn.new_tensor([(i + 0.5) / n, (0.5 + i * 0.5698402909980532) % 1.0])
    return (turn + point) % 1.0


def _cosine_direction(normal: Tensor, square: Tensor) -> Tensor:
    """(N, 3) directions around normals with density cosine / pi, from (N, 2) points of the unit square (Malley)."""
    radius, angle = square[:, 0].sqrt(), 2 * math.pi * square[:, 1]
    sign = torch.where(normal[:, 2] < 0, -1.0, 1.0)  # a frame without branches: Duff et al. 2017
    a = -1.0 / (sign + normal[:, 2])
    b = normal[:, 0] * normal[:, 1] * a
    one = torch.stack([1 + sign * normal[:, 0] ** 2 * a, sign * b, -sign * normal[:, 0]], 1)
    two = torch.stack([b, sign + normal[:, 1] ** 2 * a, -normal[:, 1]], 1)
    height = (1 - square[:, 0]).clamp_min(0).sqrt()
    return (radius * angle.cos())[:, None] * one + (radius * angle.sin())[:, None] * two + height[:, None] * normal


def _albedo(merged: Merged, meshes: Sequence[Mesh], colours: Sequence[Colour], face: Tensor, uv: Tensor) -> Tensor:
    """(N, 3) linear reflectance at the hit points."""
    like = merged.vertices
    rows = []
    for mesh, colour in zip(meshes, colours, strict=True):
        value = torch.as_tensor(colour).to(like)
        rows.append(value.expand(mesh.vertices.shape[-2], 3))
    corners = _to_linear(torch.cat(rows))[merged.faces[face]]
    weights = torch.cat([1 - uv.sum(1, keepdim=True), uv], 1)[..., None].to(like)
    return (corners * weights).sum(1)


def _to_linear(srgb: Tensor) -> Tensor:
    """IEC 61966-2-1."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def _develop(image: Tensor, background: tuple[float, float, float] | None) -> Tensor:
    """(h, w, 4) linear light times coverage, and coverage -> uint8 sRGB over the background, or with alpha."""
    light, alpha = image[..., :3], image[..., 3:]
    if background is None:
        light = light / alpha.clamp_min(1e-6)
    else:
        light = light + (1 - alpha) * _to_linear(image.new_tensor(background))
    light = light.clamp(0, 1)
    srgb = torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
    channels = srgb if background is not None else torch.cat([srgb, alpha], 2)
    return (channels * 255 + 0.5).to(torch.uint8)
