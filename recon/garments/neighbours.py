"""The largest feature among each point's neighbours, with gradient (edge convolutions, DrapeNet §6.1.1)."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR
wp.init()


@wp.kernel
def _largest(
    features: wp.array2d(dtype=float),
    near: wp.array2d(dtype=int),
    best: wp.array2d(dtype=float),
    which: wp.array2d(dtype=int),
):
    i, c = wp.tid()  # type: ignore[misc]
    row = near[i, 0]
    top = features[row, c]
    for k in range(1, near.shape[1]):
        other = near[i, k]
        value = features[other, c]
        if value > top:
            top = value
            row = other
    best[i, c] = top
    which[i, c] = row


class LargestOf(torch.autograd.Function):
    """``apply(features (N, C), near (N, K) int32) -> (N, C)``: the largest of each channel among the rows ``near``."""

    @staticmethod
    def forward(ctx, features: Tensor, near: Tensor) -> Tensor:
        """See the class."""
        features = features.float().contiguous()
        shape = (len(near), features.shape[1])
        best, which = features.new_empty(shape), torch.empty(shape, dtype=torch.int32, device=features.device)
        arrays = [wp.from_torch(t.detach()) for t in (features, near, best, which)]
        wp.launch(_largest, shape, inputs=arrays, device=str(features.device))
        ctx.save_for_backward(which)
        ctx.rows = len(features)
        return best

    @staticmethod
    def backward(ctx, *grads: Tensor):
        """Each output's gradient goes to the row that it was taken from."""
        (which,) = ctx.saved_tensors
        grad = grads[0]
        out = grad.new_zeros(ctx.rows, grad.shape[1])
        return out.scatter_add_(0, which.long(), grad), None


def largest(features: Tensor, near: Tensor) -> Tensor:
    """(N, C) the largest of each channel among the rows ``near`` (N, K) of features (M, C); differentiable."""
    if torch.is_grad_enabled() and features.requires_grad:
        best = LargestOf.apply(features, near)
        assert isinstance(best, Tensor)
        return best
    best = features.index_select(0, near[:, 0])
    for k in range(1, near.shape[1]):  # row by row: several times as fast where no gradient needs to know the winner
        torch.maximum(best, features.index_select(0, near[:, k]), out=best)
    return best
