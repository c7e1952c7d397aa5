"""Linear blend skinning: the one matmul that bodies and garments share."""

from __future__ import annotations

import torch
from torch import Tensor


def skin(vertices: Tensor, transforms: Tensor, weights: Tensor) -> Tensor:
    """v' = sum_j w_j (T_j [v; 1]), SMPL's Eq. 4 and GAPS' S.

    vertices (B, V, 3), transforms (B, J, 4, 4), weights (V, J) or (B, V, J) -> (B, V, 3). The transforms are blended by
    one matmul per call (dense weights beat sparse gathers up to some 10^5 vertices on a CPU).
    """
    flat = transforms[:, :, :3].flatten(2)  # (B, J, 12)
    if weights.dim() == 2:
        blended = torch.einsum("vj,bjk->bvk", weights, flat)
    else:
        blended = weights @ flat
    blended = blended.unflatten(-1, (3, 4))
    return (blended[..., :3] @ vertices[..., None])[..., 0] + blended[..., 3]
