"""Linear blend skinning: the one product that bodies and garments share, with its gradients written out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _Skin(torch.autograd.Function):
    """One body after another, so that the blended transforms (V, 12) of each stay in the processor's cache.

    Written as plain batched tensor operations the same sum moves B V 12 numbers through memory five times over, and
    takes four to six times as long for 16 bodies.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, transforms: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(vertices, transforms, weights)
        columns = _columns(transforms)
        out = torch.empty_like(vertices)
        for b, v in enumerate(vertices):
            blended = (weights if weights.dim() == 2 else weights[b]) @ columns[b]  # x, y, z column and offset
            torch.addcmul(blended[:, 9:], blended[:, :3], v[:, :1], out=out[b])
            out[b].addcmul_(blended[:, 3:6], v[:, 1:2]).addcmul_(blended[:, 6:9], v[:, 2:])
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        (grad,) = grads
        vertices, transforms, weights = ctx.saved_tensors
        of_vertices, of_transforms, of_weights = ctx.needs_input_grad
        columns = _columns(transforms)
        to_vertices = torch.empty_like(vertices) if of_vertices else None
        to_transforms = torch.zeros_like(transforms) if of_transforms else None
        to_weights = torch.zeros_like(weights) if of_weights else None
        for b, (v, g) in enumerate(zip(vertices, grad, strict=True)):
            w = weights if weights.dim() == 2 else weights[b]
            if to_vertices is not None:
                turned = (w @ columns[b, :, :9]).unflatten(1, (3, 3))
                torch.sum(turned * g[:, None], -1, out=to_vertices[b])
            if to_transforms is None and to_weights is None:
                continue
            spread = torch.cat([g * v[:, :1], g * v[:, 1:2], g * v[:, 2:], g], 1)  # d loss / d blended, (V, 12)
            if to_transforms is not None:
                to_transforms[b, :, :3] = (w.T @ spread).unflatten(1, (4, 3)).transpose(1, 2)
            if to_weights is not None:
                (to_weights if weights.dim() == 2 else to_weights[b]).addmm_(spread, columns[b].T)
        return to_vertices, to_transforms, to_weights


def _columns(transforms: Tensor) -> Tensor:
    """(B, J, 4, 4) -> (B, J, 12): the three columns of the rotation, then the offset."""
    return transforms[:, :, :3].transpose(2, 3).flatten(2)


def skin(vertices: Tensor, transforms: Tensor, weights: Tensor) -> Tensor:
    """v' = sum_j w_j (T_j [v; 1]), the skinning of SMPL's Eq. 2-4 and GAPS' S.

    vertices (B, V, 3) or one of them (1, V, 3), transforms (B, J, 4, 4), weights (V, J) or (B, V, J) -> (B, V, 3);
    differentiable in all three, once (no second derivatives).
    """
    return _Skin.apply(vertices.expand(len(transforms), -1, -1), transforms, weights)


def shaped(rest: Tensor, directions: Tensor, shape: Tensor) -> Tensor:
    """Rest vertices (V, 3), shape directions (V, 3, S), shapes (B, S) -> vertices at rest on those bodies (B, V, 3).

    One product with columns side by side: several times faster than a sum over indices.
    """
    return rest + (directions.flatten(0, 1) @ shape.T).T.unflatten(1, (-1, 3))
