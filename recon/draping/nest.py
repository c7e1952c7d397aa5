"""A garment put around all that is worn beneath it: where layers begin that are then led into a pose.

Where a narrow shirt goes over a wide jacket, where it would hang alone does not say how it could be around the jacket,
and a simulation that begins there presses one through the other. Here space itself is drawn outward: cloth moves along
the gradient of a soft distance from the body until all of it lies in a shell around what is beneath, cloth that is
further out still further out. Such a motion takes no two points to one place, so what hung clean stays clean up to its
facets. Cloth is stretched by it, up to several times at the arms: it is a beginning (``follow``), and no drape.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from recon.types import Mesh

SOFT = 0.03
"""Softness of the distance [m]: grooves narrower than this are as if they were filled."""
SAMPLES = 1500
"""Points in the body that the distance is from."""
SUNK = 0.02
"""Depth of these beneath the skin [m]: at the skin itself the distance has no slope."""
STEPS = 10
"""Steps of the motion, by Heun's rule."""
APART, THICK = 0.004, 0.008
"""Distance of a shell from what is in it and its thickness [m]: facets bulge by a millimetre or two."""
FOLDS = 0.03
"""Cloth this much further out than the rest is in the outer third of its shell [m]."""
STEEPEST = 5.0
"""Most metres that cloth moves for one of distance: between the legs the distance has no gradient."""
BESIDE = 0.05
"""What lies this far beyond the box of a garment is not beneath it [m]."""


class Shells:
    """Shells around a body in the T pose, by a distance that is smooth and has one way out nearly everywhere."""

    def __init__(self, body: Mesh):
        """``body``: (B, 3), closed, faces outward [m]."""
        shape = trimesh.Trimesh(body.vertices.detach().cpu().numpy(), body.faces.cpu().numpy(), process=False)
        points, face = trimesh.sample.sample_surface_even(shape, SAMPLES, seed=0)
        self.points = torch.from_numpy(np.asarray(points - SUNK * shape.face_normals[face])).float()
        self.share = float(np.log(shape.area / len(points) / SOFT**2))

    @torch.no_grad()
    def around(self, garment: NDArray, beneath: Sequence[NDArray]) -> NDArray:
        """Cloth (V, 3) moved around all layers beneath (V, 3) that its box covers; as it is, if it covers none [m]."""
        low, high = garment.min(0) - BESIDE, garment.max(0) + BESIDE
        near = [x[((x > low) & (x < high)).all(1)] for x in beneath]
        covered = np.concatenate(near) if near else np.zeros((0, 3))
        if not len(covered):
            return garment
        shell = APART + float(self.distance(torch.from_numpy(covered).float())[0].max())
        return self._shifted(torch.from_numpy(garment).float(), shell).double().numpy()

    def distance(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Soft distance (V,) [m] of points (V, 3) and its gradient (V, 3)."""
        away = x[:, None] - self.points
        r = away.norm(dim=2).clamp_min(1e-6)
        nearness = self.share - r / SOFT
        weights = torch.softmax(nearness, 1) / r
        return -SOFT * nearness.logsumexp(1), (weights[..., None] * away).sum(1)

    def _shifted(self, x: Tensor, shell: float) -> Tensor:
        """Cloth (V, 3) moved into the shell that begins at that distance [m]."""
        at, out = self.distance(x)
        goal = shell + THICK * (1 - torch.exp(-(at - at.min()) / FOLDS))
        step = (goal - at) / STEPS
        for _ in range(STEPS):
            ahead = self.distance(x + _along(out) * step[:, None])[1]
            x = x + 0.5 * (_along(out) + _along(ahead)) * step[:, None]
            out = self.distance(x)[1]
        return x


def _along(gradient: Tensor) -> Tensor:
    """Motion (V, 3) per metre of distance."""
    return gradient / gradient.square().sum(1, keepdim=True).clamp_min(1 / STEEPEST)
