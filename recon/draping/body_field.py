"""The body's skinning carried into the space around it: W and dx of DrapeNet (De Luigi et al. 2023, §3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from recon.draping.mlp import layers_of, mlp, quickly, waves

JOINTS = 24


class BodyFieldNet(nn.Module):
    """W(x) and dx(x, beta): the body's skinning weights and shape directions carried into the space around it."""

    def __init__(self, n_shape: int, width: int = 160, depth: int = 4, octaves: int = 4):
        super().__init__()
        self.shape = {"n_shape": n_shape, "width": width, "depth": depth, "octaves": octaves}
        self.octaves = octaves
        self.net = mlp(3 + 6 * octaves, width, depth, JOINTS + 3 * n_shape)

    def forward(self, x: Tensor, quick: bool = False) -> tuple[Tensor, Tensor]:
        """(N, 3) points in the neutral body's T-pose space -> weights (N, 24), sum 1; directions (N, 3, S) [m].

        ``quick``: see :func:`quickly`.
        """
        seen = waves(x - x.new_tensor([0.0, 1.0, 0.0]), self.octaves)
        out = quickly(self.net, seen) if quick else self.net(seen)
        return out[:, :JOINTS].softmax(1), 0.01 * out[:, JOINTS:].unflatten(1, (3, -1))

    def on(self, x: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) points, shapes (B, S) -> weights (N, 24) and dx (N, B, 3) [m], quickly; see ``Displacements.on``."""
        *inner, (weight, bias) = layers_of(self.net)
        by_joint, shift = weight[:JOINTS], bias[:JOINTS]
        weight, bias = (
            0.01 * torch.einsum("bs,csw->bcw", shape, t[JOINTS:].view(3, shape.shape[1], -1)).flatten(0, 1)
            for t in (weight, bias[:, None])
        )
        last = torch.cat([by_joint, weight]), torch.cat([shift, bias[:, 0]])
        out = quickly([*inner, last], waves(x - x.new_tensor([0.0, 1.0, 0.0]), self.octaves))
        return out[:, :JOINTS].softmax(1), out[:, JOINTS:].unflatten(1, (-1, 3))
