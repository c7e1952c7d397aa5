"""Differentiable label images: which mesh a pixel shows, with occlusion.

The image counts, per pixel and label, the share of a regular sub-pixel grid whose rays hit that label first (box
filter). Its gradient is exact boundary calculus instead of a smoothed image: only where a silhouette moves does
coverage change, by (label behind - label in front) x normal velocity x length (Li et al. 2018). Candidate edges are
open borders and folds; what is seen a hair to either side of each point tells the labels; a point that sees the same
label twice counts for nothing. Rasterised (see ``raster``), since building a ray structure took most of the time.

Known blind spots: the curve along which two surfaces pass through each other carries no gradient, and a label that
is nowhere seen has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from recon.render.edges import lines_of, topology
from recon.render.jumps import jumps
from recon.render.raster import Raster
from recon.render.view import View, Window, outcodes, view_of
from recon.types import Camera, Mesh


class LabelRenderer:
    """Label images of several meshes that occlude each other.

    Making one is cheap (a hash per known mesh, a sort per new one), so make another when a mesh's faces change.

    Args:
        faces: per mesh (F_i, 3) long; open meshes are two-sided, closed ones are counter-clockwise from outside.
        labels: per mesh its row in the image, shared by meshes at will; None or -1 = only hides others.
        n_vertices: per mesh the number of vertices.
        step: length of the pieces that silhouettes are cut into [output px], up to 1; smaller = more exact, slower.
    """

    def __init__(
        self,
        faces: Sequence[Tensor],
        labels: Sequence[int | None],
        n_vertices: Sequence[int],
        step: float = 0.5,
    ):
        if not len(faces) == len(labels) == len(n_vertices) > 0:
            found = f"{len(faces)} meshes, {len(labels)} labels, {len(n_vertices)} vertex counts"
            raise ValueError(f"render: found {found}; wanted as many of each")
        self.n_vertices = [int(n) for n in n_vertices]
        self.labels = [-1 if label is None else int(label) for label in labels]
        self.n_labels = max(self.labels) + 1
        self.step = step
        tops = [topology(f) for f in faces]
        first_vertex = [sum(self.n_vertices[:i]) for i in range(len(faces))]
        first_face = [sum(len(f) for f in faces[:i]) for i in range(len(faces))]
        self._faces = torch.cat([f.long() + at for f, at in zip(faces, first_vertex, strict=True)])
        sizes = torch.tensor([len(f) for f in faces])
        self._value = torch.tensor([label + 1 for label in self.labels]).repeat_interleave(sizes).to(self._faces)
        spans = zip(first_face, faces, tops, strict=True)
        self._closed = [slice(at, at + len(f)) for at, f, top in spans if top.closed]
        self._edges = torch.cat([top.edges + at for top, at in zip(tops, first_vertex, strict=True)])
        self._edge_faces = torch.cat([top.faces + at for top, at in zip(tops, first_face, strict=True)])
        self._always = torch.cat([top.always for top in tops])
        self._flipped = torch.cat([top.flipped for top in tops])

    def __call__(
        self,
        vertices: Sequence[Tensor],
        camera: Camera,
        size: tuple[int, int] | None = None,
        samples: int = 4,
        window: Window | None = None,
    ) -> Tensor:
        """Coverage (L, h, w) in [0, 1] of each label, differentiable in the vertices and the camera's K, R and t.

        Args:
            vertices: per mesh (V_i, 3) world [m].
            camera: its ``size`` is the original image's.
            size: (h, w) output pixels; None = the original image's.
            samples: rays per pixel, a square number (4 = 2 x 2).
            window: x0, y0, x1, y1 in original pixels to look at; None = the whole image.

        Raises:
            ValueError: shapes that do not fit the meshes, or vertices or camera that are not finite.
        """
        found = [tuple(v.shape) for v in vertices]
        if found != [(n, 3) for n in self.n_vertices]:
            raise ValueError(f"render: found vertices {found}; wanted {[(n, 3) for n in self.n_vertices]}")
        if math.isqrt(samples) ** 2 != samples or samples < 1:
            raise ValueError(f"render: found {samples} samples; wanted a square number")
        view = view_of(camera, size, window)
        points = view.points(torch.cat(list(vertices)))
        return _Coverage.apply(points, self, view, math.isqrt(samples))

    def _visible_faces(self, front: Tensor, volumes: Tensor, outside: Tensor) -> Tensor:
        """(F,) bool: not outside the image, and not the far side of a closed mesh."""
        keep = (outside[self._faces[:, 0]] & outside[self._faces[:, 1]] & outside[self._faces[:, 2]]) == 0
        for span in self._closed:
            if bool(volumes[span].sum() > 0):  # oriented outward, as agreed
                keep[span] &= front[span]
        return keep

    def _candidates(self, front: Tensor, outside: Tensor) -> Tensor:
        near, far = front[self._edge_faces].unbind(1)
        candidate = self._always | (near ^ far ^ self._flipped)
        return self._edges[candidate & ((outside[self._edges[:, 0]] & outside[self._edges[:, 1]]) == 0)]


_SAVED = ("ahead", "behind", "row", "column", "vertices")


class _Coverage(torch.autograd.Function):
    """(V, 3) homogeneous image points -> (L, h, w) coverage."""

    @staticmethod
    def forward(ctx, homogeneous: Tensor, renderer: LabelRenderer, view: View, grid: int) -> Tensor:
        points = homogeneous.detach().double()
        if not bool(torch.isfinite(points).all()):
            raise ValueError("render: found vertices or a camera that are not finite; wanted numbers")
        corners = points[renderer._faces]
        volumes = -(corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum(1)
        front, outside = volumes > 0, outcodes(points, view.size)
        keep = renderer._visible_faces(front, -volumes, outside)
        raster = Raster(points, renderer._faces[keep].int(), renderer._value[keep].int())
        image = raster.coverage(view.size, grid, renderer.n_labels)
        if ctx.needs_input_grad[0]:
            lines = lines_of(points, renderer._candidates(front, outside), view.size)
            found = jumps(raster, lines, view.size, renderer.step)
            ctx.save_for_backward(*(getattr(found, name) for name in _SAVED), found.motion.to(homogeneous.dtype))
            ctx.n_points = len(points)
        return image.to(homogeneous.dtype)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        ahead, behind, row, column, vertices, motion = ctx.saved_tensors
        worth = torch.cat([torch.zeros_like(gradient[:1]), gradient])  # row 0: the background and mere occluders
        swept = worth[behind, row, column] - worth[ahead, row, column]
        flow = (swept[:, None, None] * motion).reshape(-1, 3)
        out = motion.new_zeros(ctx.n_points, 3)
        if out.is_cuda:  # sorts before it adds: the same sum each time
            out = out.index_put_((vertices.reshape(-1),), flow, accumulate=True)
        else:
            out = out.index_add_(0, vertices.reshape(-1), flow)
        return out, None, None, None


def visible(
    layers: Sequence[Mesh],
    camera: Camera,
    size: tuple[int, int] | None = None,
    samples: int = 4,
    window: Window | None = None,
) -> Tensor:
    """(layers, h, w) coverage of each mesh with occlusion by the others: ``LabelRenderer`` with one label per mesh."""
    vertices = [layer.vertices for layer in layers]
    renderer = LabelRenderer([layer.faces for layer in layers], list(range(len(layers))), [len(v) for v in vertices])
    return renderer(vertices, camera, size, samples, window)
