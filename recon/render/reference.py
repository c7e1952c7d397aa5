"""The slow twin of ``labels``: the same images, their gradients by projective sampling (Zhang et al. 2023).

Here Mitsuba finds, samples and differentiates the silhouettes; of our own there is only a light transport without
light: the radiance of a ray is the label of what it hits first. So nothing depends on emitters (one-sided in Mitsuba),
on normals, or on texture seams, and both sides of open meshes count. Random, slow, and written to be compared with:
tests do, the product never calls it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from recon.render import backend
from recon.types import Camera, Mesh

CHANNELS = 3
"""Labels per pass: the colours of a picture."""


def reference_labels(
    meshes: Sequence[Mesh], labels: Sequence[int], camera: Camera, size: tuple[int, int], samples: int = 256
) -> Tensor:
    """Coverage (L, h, w) of each label with occlusion, as ``LabelRenderer``; differentiable in vertices, K, R and t.

    Args:
        meshes: (V, 3) world vertices each; none may reach behind the camera.
        labels: per mesh its row in the image, -1 = only hides others.
        camera: where from.
        size: (h, w) output pixels.
        samples: random rays per pixel for the image, and points on silhouettes per pixel for its gradient.
    """
    moved = [_before_fixed_sensor(mesh.vertices, camera, size) for mesh in meshes]
    groups = []
    for first in range(0, max(labels) + 1, CHANNELS):
        colours = [label - first if first <= label < first + CHANNELS else -1 for label in labels]
        setup = ([mesh.faces for mesh in meshes], colours, size, samples)
        groups.append(_Projective.apply(setup, *moved))
    return torch.cat(groups)[: max(labels) + 1]


def _before_fixed_sensor(vertices: Tensor, camera: Camera, size: tuple[int, int]) -> Tensor:
    """World vertices moved to where a fixed sensor of 90 degrees at the origin sees them as the camera does."""
    h, w = size
    x, y, depth = ((vertices @ camera.R.T + camera.t) @ camera.K.T).unbind(-1)
    x = x * (w / camera.size[1]) - w / 2 * depth
    y = y * (h / camera.size[0]) - h / 2 * depth
    focal = w / 2
    return torch.stack([-x / focal, -y / focal, depth], -1)  # Mitsuba's sensors look along +z with x to the left


class _Projective(torch.autograd.Function):
    """Vertices before the fixed sensor -> (3, h, w)."""

    @staticmethod
    def forward(ctx, setup: tuple, *vertices: Tensor) -> Tensor:
        mi, _ = backend.load(vertices[0].device)
        ctx.setup = setup
        ctx.save_for_backward(*(v.detach() for v in vertices))
        samples = setup[-1]
        image = mi.render(_scene(setup, vertices), spp=samples, seed=0)
        shape = (*setup[2], CHANNELS)
        out = backend.to_torch(image.array, vertices[0].device).reshape(shape)
        return out.permute(2, 0, 1).to(vertices[0])

    @staticmethod
    def backward(ctx, gradient: Tensor):
        mi, dr = backend.load(gradient.device)
        vertices, samples = ctx.saved_tensors, ctx.setup[-1]
        scene = _scene(ctx.setup, vertices)
        params = mi.traverse(scene)
        names = [f"mesh{i}.vertex_positions" for i in range(len(vertices))]
        for name in names:
            dr.enable_grad(params[name])
        params.update()
        grad_in = mi.TensorXf(gradient.permute(1, 2, 0).contiguous().cpu().numpy().astype("float32"))
        scene.integrator().render_backward(scene, params, grad_in, seed=1, spp=samples)
        grads = [backend.to_torch(dr.grad(params[name]), gradient.device).reshape(-1, 3) for name in names]
        return None, *(g.to(v) for g, v in zip(grads, vertices, strict=True))


def _scene(setup: tuple, vertices: Sequence[Tensor]) -> Any:
    faces, channels, (h, w), _ = setup
    mi, _ = backend.load(vertices[0].device)
    _register(mi.variant())
    film = {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}, "component_format": "float32"}
    sensor = {"type": "perspective", "fov": 90.0, "fov_axis": "x", "near_clip": 1e-3, "film": film}
    scene = {"type": "scene", "integrator": {"type": "label_projective"}, "sensor": sensor}
    for i, (triangles, channel, points) in enumerate(zip(faces, channels, vertices, strict=True)):
        mesh = mi.Mesh(f"mesh{i}", len(points), len(triangles))
        params = mi.traverse(mesh)
        params["vertex_positions"] = backend.to_dr(mi.Float, points.detach().float().reshape(-1))
        params["faces"] = backend.to_dr(mi.UInt32, triangles.to(torch.int32).reshape(-1))
        params.update()
        one_hot = torch.zeros(len(triangles), CHANNELS)
        if channel >= 0:
            one_hot[:, channel] = 1.0
        mesh.add_attribute("face_label", CHANNELS, one_hot.reshape(-1).tolist())
        scene[f"mesh{i}"] = mesh
    return mi.load_dict(scene, parallel=False)


@cache
def _register(variant: str) -> None:
    """Make the integrator known to Mitsuba, once per variant (its base class differs by variant)."""
    mi, dr = backend.load("cuda" if variant.startswith("cuda") else "cpu")
    from mitsuba.python.ad.integrators.common import PSIntegrator

    class LabelProjective(PSIntegrator):
        """Labels for radiance: only what is primarily visible can jump, and nothing varies between jumps."""

        def __init__(self, props):
            super().__init__(props)
            self.sppc, self.sppi = 0, 0
            self.radiative_backprop = False
            self.sample_border_warning = False

        def sample(self, mode, scene, sampler, ray, active=True, **_):
            hit = scene.ray_intersect(ray, active=active)
            return _label(hit, hit.shape, hit.is_valid()), hit.is_valid(), [], None

        def sample_radiance_difference(self, scene, ss, curr_depth, sampler, wavelengths, active):
            behind = scene.ray_intersect(ss.spawn_ray(wavelengths), active=active)
            before = dr.zeros(mi.SurfaceInteraction3f)
            before.prim_index, before.shape = ss.prim_index, ss.shape
            jump = _label(before, ss.shape, active) - _label(behind, behind.shape, active & behind.is_valid())
            return jump, active & (dr.max(dr.abs(jump)) > 0)

    def _label(hit, shape, active):
        return mi.Color3f(dr.select(active, shape.eval_attribute_3("face_label", hit, active), 0))

    mi.register_integrator("label_projective", lambda props: LabelProjective(props))
