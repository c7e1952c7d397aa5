"""How far a reconstruction is from the truth: the papers' figures, and the same in millimetres."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from recon.cloth.beneath import Beneath
from recon.cloth.contact import BodyContact
from recon.types import Garment, Mesh


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """``count`` area-uniform points of a mesh (count, 3) [m] and the unit normals there (count, 3)."""
    corners = mesh.vertices.detach()[mesh.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = normal.norm(dim=1)
    face = torch.multinomial(area / area.sum(), count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator, dtype=corners.dtype)
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    a, b, c = corners[face].unbind(1)
    return a + u * (b - a) + v * (c - a), normal[face] / area[face, None].clamp_min(1e-12)


def surface_distance(points: Tensor, mesh: Mesh) -> tuple[Tensor, Tensor]:
    """(N,) exact distances [m] of points (N, 3) to a mesh, and (N,) the faces they are closest to."""
    corners = mesh.vertices.detach().double()[mesh.faces]
    middle = corners.mean(1)
    reach = (corners - middle[:, None]).norm(dim=2).max()
    tree = cKDTree(middle.numpy())
    at = points.detach().double()
    best = torch.full((len(at),), torch.inf, dtype=torch.float64)
    face = torch.zeros(len(at), dtype=torch.long)
    asked, count = np.arange(len(at)), min(8, len(middle))
    while len(asked):
        far, index = tree.query(at[asked].numpy(), k=count)
        far, index = np.atleast_2d(far.T).T, np.atleast_2d(index.T).T
        distance = _to_triangles(at[asked], corners[torch.as_tensor(index)])
        least, which = distance.min(1)
        best[asked] = least
        face[asked] = torch.as_tensor(index)[torch.arange(len(asked)), which]
        # Faces further than these can be nearer only if their middle is within reach of the best distance.
        open_ = (far[:, -1] - float(reach) < least.numpy()) & (count < len(middle))
        asked, count = asked[open_], min(4 * count, len(middle))
    return best.to(points.dtype), face


def _to_triangles(points: Tensor, triangles: Tensor) -> Tensor:
    """(N, K) distances of points (N, 3) to triangles (N, K, 3, 3)."""
    a, b, c = triangles.unbind(2)
    p = points[:, None]
    inside = _to_plane(p, a, b, c)
    edges = [_to_segment(p, u, v) for u, v in ((a, b), (b, c), (c, a))]
    return torch.stack([inside, *edges]).amin(0)


def _to_segment(p: Tensor, u: Tensor, v: Tensor) -> Tensor:
    d = v - u
    t = ((p - u) * d).sum(-1) / d.square().sum(-1).clamp_min(1e-18)
    return (p - u - t.clamp(0, 1)[..., None] * d).norm(dim=-1)


def _to_plane(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Distance to the triangle's plane where the foot lies inside it, else infinity."""
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u).sum(-1), (w * v).sum(-1)
    det = (uu * vv - uv * uv).clamp_min(1e-24)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    off = (w - s[..., None] * u - t[..., None] * v).norm(dim=-1)
    return torch.where((s >= 0) & (t >= 0) & (s + t <= 1), off, torch.inf)


def compare_meshes(found: Mesh, truth: Mesh, generator: torch.Generator, count: int = 10000) -> dict[str, float]:
    """Chamfer distance, surface distances and normal consistency of two meshes.

    Returns:
        ``chd``: ISP's Chamfer distance (Eq. 24 per point), mean squared nearest-neighbour distances between ``count``
        random points of each surface, both ways added, with coordinates divided by half the larger side of the truth's
        bounding box; ISP's tables give it in 1e-4. It has a floor of its own, the spacing of the points;
        ``chd_surface`` is the same with exact distances to the other surface. ``chamfer_mm``: mean nearest-neighbour
        distance, both ways averaged. ``surface_mm``, ``surface_p95_mm``: exact distances to the other surface.
        ``normals``: mean cosine between normals at closest points, both ways averaged (ISP's NC).
    """
    p, pn = sample_surface(found, count, generator)
    q, qn = sample_surface(truth, count, generator)
    scale = 0.5 * float((truth.vertices.amax(0) - truth.vertices.amin(0)).max())
    near_p = torch.as_tensor(cKDTree(q.numpy()).query(p.numpy())[0])
    near_q = torch.as_tensor(cKDTree(p.numpy()).query(q.numpy())[0])
    dp, fp = surface_distance(p, truth)
    dq, fq = surface_distance(q, found)
    both = torch.cat([dp, dq])
    cosine = torch.cat([(pn * face_normals(truth)[fp]).sum(1), (qn * face_normals(found)[fq]).sum(1)])
    exact = (dp / scale).square().mean() + (dq / scale).square().mean()
    return {
        "chd_surface": float(exact),
        "chd": float((near_p / scale).square().mean() + (near_q / scale).square().mean()),
        "chamfer_mm": float(near_p.mean() + near_q.mean()) * 500,
        "surface_mm": float(both.mean()) * 1e3,
        "surface_p95_mm": float(both.quantile(0.95)) * 1e3,
        "normals": float(cosine.mean()),
    }


def face_normals(mesh: Mesh) -> Tensor:
    """(F, 3) unit normals."""
    a, b, c = mesh.vertices.detach()[mesh.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    return normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-12)


def largest_stretch(garment: Garment) -> Tensor:
    """(F,) how many times longer the cloth is in space than on its panel, in each triangle's worst direction."""
    flat = garment.panel_points.detach()[garment.panel_faces]
    space = garment.mesh.vertices.detach()[garment.mesh.faces]
    edges = torch.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], -1)
    spans = torch.stack([space[:, 1] - space[:, 0], space[:, 2] - space[:, 0]], -1)
    sound = edges.det().abs() > 1e-9
    deformation = spans[sound] @ torch.linalg.inv(edges[sound])
    gram = deformation.mT @ deformation
    half, off = (gram[:, 0, 0] + gram[:, 1, 1]) / 2, (gram[:, 0, 0] - gram[:, 1, 1]) / 2
    return (half + (off.square() + gram[:, 0, 1].square()).sqrt()).sqrt()


def boundary_loops(faces: Tensor) -> int:
    """How many open borders a mesh has: 4 for a T-shirt (neck, hem, two cuffs), 3 for an open jacket."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    unique, count = edges.unique(dim=0, return_counts=True)
    rim = unique[count == 1]
    if not len(rim):
        return 0
    vertices, index = rim.unique(return_inverse=True)
    i, j = index.numpy().T
    graph = coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(len(vertices), len(vertices)))
    return int(connected_components(graph, directed=False)[0])


def panel_iou(found: Garment, truth: Garment, cell: float = 0.004) -> float:
    """Intersection over union of two garments' flat panels, all together, on a raster of ``cell`` [m]."""
    both = torch.cat([found.panel_points.detach(), truth.panel_points.detach()])
    low, high = both.amin(0) - cell, both.amax(0) + cell
    shape = [int(n) for n in ((high - low) / cell).ceil()]
    inter = union = 0
    for panel in range(len(truth.panel_names)):
        a, b = (_raster(g, panel, low.numpy(), cell, shape) for g in (found, truth))
        inter += int((a & b).sum())
        union += int((a | b).sum())
    return inter / max(union, 1)


def _raster(garment: Garment, panel: int, low: NDArray, cell: float, shape: list[int]) -> NDArray:
    import cv2

    points = garment.panel_points.detach().numpy()
    triangles = points[garment.panel_faces[garment.panel_of_face == panel].numpy()]
    image = np.zeros((shape[0], shape[1]), np.uint8)
    fixed = np.round((triangles - low) / cell * 256)[..., ::-1].astype(np.int32)
    for triangle in fixed:
        cv2.fillConvexPoly(image, triangle, 1, shift=8)
    return image > 0


def drape_errors(template: Mesh, x: Tensor, inside: Tensor) -> dict[str, float]:
    """GAPS' figures of a motion (§5), in percent.

    Args:
        template: the garment at rest, vertices (V, 3).
        x: (F, V, 3) the draped frames.
        inside: (F, V) bool, which vertices are in the body.

    Returns:
        ``eps_e``, ``eps_a``: mean absolute change of edge lengths and of triangle areas against the template;
        ``eps_c``: share of vertices in the body, ``eps_c_std`` its deviation over the frames.
    """
    ends = torch.cat([template.faces[:, [0, 1]], template.faces[:, [1, 2]], template.faces[:, [2, 0]]])
    ends = ends.sort(1).values.unique(dim=0)

    def lengths(points: Tensor) -> Tensor:
        return (points[..., ends[:, 0], :] - points[..., ends[:, 1], :]).norm(dim=-1)

    def areas(points: Tensor) -> Tensor:
        a, b, c = points[..., template.faces, :].unbind(-2)
        return torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2

    errors = {}
    for name, measure in (("eps_e", lengths), ("eps_a", areas)):
        rest = measure(template.vertices.detach()).clamp_min(1e-12)
        errors[name] = 100 * float(((measure(x) - rest).abs() / rest).mean())
    share = 100 * inside.float().mean(1)
    return errors | {"eps_c": float(share.mean()), "eps_c_std": float(share.std(unbiased=False))}


def areas_and_middles(mesh: Mesh) -> tuple[Tensor, Tensor, Tensor]:
    """Of one mesh (V, 3): areas (F,), middles (F, 3) and unit normals (F, 3) of its faces."""
    a, b, c = mesh.vertices.detach()[mesh.faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=1)
    return length / 2, (a + b + c) / 3, normal / length.clamp_min(1e-12)[:, None]


def inside_pct(mesh: Mesh, body: BodyContact) -> float:
    """Percentage of a garment's area whose faces have their middle inside the body."""
    area, middle, _ = areas_and_middles(mesh)
    return 100 * float(area[body.penetrating(middle)].sum() / area.sum().clamp_min(1e-12))


def beneath_pct(outer: Mesh, inner: Beneath) -> float:
    """Percentage of an outer layer's area that lies beneath the layer that it should cover.

    A face counts if its middle is on the inner side of the inner layer's closest point, where that says something: not
    beside an open border, not further away than ``layering.REACH``, and both facing the same way.
    """
    area, middle, normal = areas_and_middles(outer)
    lack, _ = inner.lack(middle, normal, 0.0)
    return 100 * float(area[lack > 0].sum() / area.sum().clamp_min(1e-12))
