"""Space around a body that moves as one: what it takes along does not pass through itself.

Each garment's own skinning takes its cloth a little differently from the next one's, and five layers a few millimetres
apart pass through each other. Here all cloth around one place of the body moves with that place.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from recon.bodies import Body
from recon.draping.binding import JOINTS, METHODS, BodyField


class Space:
    """The motion of a body, from the T pose on, extended around it."""

    def __init__(self, body: Body, first: NDArray, transforms: NDArray):
        """``first``: (B, 3) the body in the T pose [m]; ``transforms``: (T, 24, 4, 4) of its joints, from there on."""
        self.transforms = transforms
        self.weights: NDArray | None = None
        features = torch.cat([body.weights, body.shape_dirs.flatten(1)], 1)
        self.field = BodyField(torch.from_numpy(first).float(), features.cpu())

    def __call__(self, k: int, x: NDArray) -> NDArray:
        """Cloth (V, 3) beside the body of frame ``k - 1`` taken along to frame ``k``; asked frame by frame, for the
        same cloth, from when the body still is in the T pose [m]."""
        if self.weights is None:
            found = METHODS["gaps"](self.field, torch.from_numpy(x).float(), None)[:, :JOINTS].double().numpy()
            self.weights = found / found.sum(1, keepdims=True)
        step = self.transforms[k] @ np.linalg.inv(self.transforms[k - 1])
        moves = np.einsum("vj,jab->vab", self.weights, step)
        return np.einsum("vab,vb->va", moves[:, :3, :3], x) + moves[:, :3, 3]
