"""Pattern grading: panels cut for the neutral body made to fit another body, seams still matching.

Tailors grade a pattern by moving its points along smooth rules. Here the rule is one map of the panels' common plane, a
polynomial of low degree. Along seams front and back move alike, so that what matched in length still does; away from
them the front may grow where the back shrinks, by a second such map that fades out at the seams. A garment without
panels has one such map of the space that it lies in.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import comb

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from recon.cloth.solve import lbfgs
from recon.types import Garment

DEGREE = 3
"""Degree of the map along each axis of the plane."""
OUTLIERS = ((1.0, 0.25), (0.15, 0.75))
"""Green strain beyond which a triangle pulls no harder, and the share of iterations that are taken with it: first all
triangles pull, else those that start as outliers (on a much larger body nearly all) would not say where to."""
STIFFNESS = 1e-3
"""Weight of the map's own unevenness, against what the cloth does not need."""


SEAM_REACH = 0.08
"""Width of the band along seams in which front and back move nearly alike [m]."""


def grade(garment: Garment, worn: Tensor, iterations: int = 60) -> Garment:
    """The garment with panels that would lie over ``worn`` with the least strain.

    Args:
        garment: welded, its panels cut for the neutral body; or without panels, at rest on it.
        worn: (V, 3) the same garment's vertices on the body that it shall fit, unposed [m].
        iterations: L-BFGS iterations.

    Returns:
        The garment with new ``panel_points``, or ``unstrained`` where it has no panels (detached); mesh and topology
        are untouched.
    """
    points, faces = _as_cut(garment)
    low, high = points.min(0).values, points.max(0).values
    shared = basis = _bernstein((points - low) / (high - low))
    if garment.has_panels:
        basis = torch.cat([shared, _between_panels(garment, points)[:, None] * shared], 1)
    sides = _sides(worn.detach().double().cpu()[garment.mesh.faces.cpu()])
    metric = sides.transpose(1, 2) @ sides
    areas = torch.linalg.det(_flat_sides(points[faces])).abs() / 2
    sound = areas > 0.05 * areas.mean()  # slivers say more about the meshing than about the cloth
    faces, metric, weights = faces[sound], metric[sound], areas[sound] / areas[sound].sum()

    @torch.enable_grad()
    def energy(moves: np.ndarray, outlier: float) -> tuple[float, np.ndarray]:
        c = torch.from_numpy(moves).requires_grad_()
        inverse = torch.linalg.inv(_flat_sides((points + basis @ c)[faces]))
        green = 0.5 * (inverse.transpose(1, 2) @ metric @ inverse - torch.eye(2, dtype=points.dtype))
        misfit = (weights * torch.log1p(green.square().sum((1, 2)) / outlier**2)).sum()
        alike, apart = c[: shared.shape[1]], c[shared.shape[1] :]
        uneven = torch.cat([alike - alike.mean(0), apart]).square().sum() / float((high - low).max()) ** 2
        loss = misfit + STIFFNESS * uneven
        (gradient,) = torch.autograd.grad(loss, c)
        return loss.item(), gradient.numpy()

    moves = np.zeros((basis.shape[1], points.shape[1]))
    for outlier, share in OUTLIERS:
        moves = lbfgs(partial(energy, outlier=outlier), moves, round(share * iterations))
    graded = points + basis @ torch.from_numpy(moves)
    if garment.has_panels:
        return replace(garment, panel_points=graded.to(garment.panel_points))
    return replace(garment, unstrained=graded.to(garment.mesh.vertices))


def _as_cut(garment: Garment) -> tuple[Tensor, Tensor]:
    """Points (P, 2) and faces of the panels, or without panels the unstrained shape's (V, 3); doubles on the CPU."""
    if garment.has_panels:
        points, faces = garment.panel_points, garment.panel_faces
    else:
        points = garment.mesh.vertices if garment.unstrained is None else garment.unstrained
        faces = garment.mesh.faces
    return points.detach().double().cpu(), faces.cpu()


def _between_panels(garment: Garment, points: Tensor) -> Tensor:
    """(P,) 1 on what lies before the body and -1 behind it, fading to 0 where the two are sewn together."""
    vertex = garment.vertex_of_point.cpu()
    side = 1.0 - 2.0 * garment.side_of_point.cpu().to(points.dtype)
    level = torch.zeros(int(vertex.max()) + 1, dtype=points.dtype).index_add(0, vertex, side)
    sewn = level[vertex].abs() < torch.bincount(vertex)[vertex]  # its points are not all on one side
    if not sewn.any():
        return side
    distance = torch.from_numpy(cKDTree(points[sewn].numpy()).query(points.numpy())[0])
    return side * (1 - torch.exp(-((distance / SEAM_REACH) ** 2)))


def _sides(corners: Tensor) -> Tensor:
    """(F, 3, D) triangles -> (F, D, 2) two of their sides as columns."""
    return torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)


def _flat_sides(corners: Tensor) -> Tensor:
    """(F, 3, D) triangles -> (F, 2, 2) two of their sides as columns, each triangle laid into its own plane."""
    sides = _sides(corners)
    if sides.shape[1] == 2:
        return sides
    a, b = sides.unbind(-1)
    length = a.norm(dim=1)
    along = (a * b).sum(1) / length
    across = torch.linalg.cross(a, b).norm(dim=1) / length
    return torch.stack([torch.stack([length, along], 1), torch.stack([torch.zeros_like(along), across], 1)], 1)


def _bernstein(at: Tensor) -> Tensor:
    """(P, D) points of the unit cube -> (P, (DEGREE + 1)^D) values of the tensor product basis."""
    powers = torch.arange(DEGREE + 1, dtype=at.dtype)
    factor = torch.tensor([comb(DEGREE, k) for k in range(DEGREE + 1)], dtype=at.dtype)
    axes = (factor * at[..., None] ** powers * (1 - at[..., None]) ** (DEGREE - powers)).unbind(1)
    product = axes[0]
    for one in axes[1:]:
        product = (product[:, :, None] * one[:, None]).flatten(1)
    return product
