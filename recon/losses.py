"""Losses of fitting: unitless, independent of the image's size, one function each."""

from __future__ import annotations

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor


def soft_iou_loss(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """One minus the soft intersection over union, label by label (ISP Eq. 11; DrapeNet Eq. 12).

    Args:
        image: (L, h, w) rendered coverage in [0, 1].
        target: (L, h, w) wanted coverage in [0, 1].
        weight: (h, w) or (L, h, w) in [0, 1]; pixels of weight 0 count neither for nor against.

    Returns:
        (L,) losses in [0, 1]; a label without any wanted or rendered pixel gives 1.
    """
    w = torch.ones_like(image) if weight is None else weight.expand_as(image)
    both = (w * image * target).sum((-2, -1))
    either = (w * (image + target - image * target)).sum((-2, -1))
    return 1 - both / either.clamp_min(1e-6)


def hard_iou(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """(L,) intersection over union at threshold 0.5, over pixels whose weight is above 0.5."""
    a, b = image > 0.5, target > 0.5
    on = torch.ones_like(a) if weight is None else (weight > 0.5).expand_as(a)
    return (a & b & on).sum((-2, -1)) / ((a | b) & on).sum((-2, -1)).clamp_min(1)


def outside_distance(mask: Tensor) -> Tensor:
    """(h, w) bool mask -> (h, w) float distance to the mask in units of the image's height, 0 inside."""
    if not mask.any():
        return torch.zeros(mask.shape, device=mask.device)
    free = (~mask).to(torch.uint8).cpu().numpy()
    distance = torch.from_numpy(cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
    return distance.to(mask.device) / mask.shape[0]


def sample_field(field: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values of an (h, w) field at (N, 2) pixel positions (pixel centres at .5), clamped at the border."""
    h, w = field.shape
    grid = pixels / pixels.new_tensor([w, h]) * 2 - 1
    return F.grid_sample(field[None, None], grid[None, None], align_corners=False, padding_mode="border")[0, 0, 0]


def chamfer_pull(pixels: Tensor, field: Tensor, targets: Tensor) -> Tensor:
    """The pull without overlap: projected points into the mask, and mask points to the nearest projected points.

    Args:
        pixels: (N, 2) projected points.
        field: (h, w) distance to the mask (:func:`outside_distance`).
        targets: (M, 2) pixel positions drawn from the mask.

    Returns:
        Scalar, in units of the image's height.
    """
    height = field.shape[0]
    nearest = torch.cdist(targets, pixels.detach()).argmin(1)
    back = (targets - pixels[nearest]).norm(dim=1).mean() / height
    return sample_field(field, pixels).mean() + back


def robust_distance(found: Tensor, wanted: Tensor, weight: Tensor, scale: float) -> Tensor:
    """Weighted Geman-McClure mean of point distances.

    Args:
        found, wanted: (..., N, D) points.
        weight: (..., N) confidence.
        scale: the distance at which a point stops pulling harder, in the points' unit.
    """
    d2 = (found - wanted).square().sum(-1) / scale**2
    return (weight * d2 / (1 + d2)).sum(-1) / weight.sum(-1).clamp_min(1e-6)


def depth_penalty(signed_distance: Tensor, margin: float) -> Tensor:
    """Mean squared lack of clearance in units of the margin (ISP Eq. 8's body term): 0 where distance >= margin."""
    return (F.relu(margin - signed_distance) / margin).square().mean()
