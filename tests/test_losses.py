"""Losses of fitting: values on cases known by hand, invariances, gradients."""

import torch

from recon.losses import (
    chamfer_pull,
    depth_penalty,
    hard_iou,
    outside_distance,
    robust_distance,
    sample_field,
    soft_iou_loss,
)


def box(x0: int, x1: int, size: int = 32) -> torch.Tensor:
    mask = torch.zeros(1, size, size)
    mask[:, 8:24, x0:x1] = 1
    return mask


def test_iou_of_half_overlapping_boxes_is_a_third():
    a, b = box(4, 12), box(8, 16)
    torch.testing.assert_close(soft_iou_loss(a, b), torch.tensor([2 / 3]))
    torch.testing.assert_close(hard_iou(a, b), torch.tensor([1 / 3]))


def test_ignored_pixels_count_neither_for_nor_against():
    a, b = box(4, 12), box(4, 16)
    weight = torch.ones(32, 32)
    weight[:, 12:16] = 0
    assert soft_iou_loss(a, b, weight).item() < 1e-6
    assert hard_iou(a, b, weight).item() == 1


def test_empty_labels_are_finite():
    zero = torch.zeros(2, 8, 8, requires_grad=True)
    loss = soft_iou_loss(zero, torch.zeros(2, 8, 8)).sum()
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(zero.grad).all()


def test_iou_does_not_depend_on_the_image_size():
    a, b = box(4, 12), box(8, 16)
    big = [m.repeat_interleave(3, 1).repeat_interleave(3, 2) for m in (a, b)]
    torch.testing.assert_close(soft_iou_loss(a, b), soft_iou_loss(*big))


def test_outside_distance_is_euclidean_in_image_heights():
    field = outside_distance(box(8, 16)[0] > 0)
    assert field[10, 10] == 0
    torch.testing.assert_close(field[10, 26], torch.tensor((26 - 15) / 32), atol=1e-3, rtol=0)


def test_field_is_sampled_at_pixel_centres():
    field = torch.arange(12.0).reshape(3, 4)
    points = torch.tensor([[0.5, 0.5], [2.5, 1.5], [1.0, 0.5]])
    torch.testing.assert_close(sample_field(field, points), torch.tensor([0.0, 6.0, 0.5]))


def test_pull_leads_to_a_mask_without_overlap():
    mask = box(20, 28)[0] > 0
    field, targets = outside_distance(mask), torch.nonzero(mask).flip(1) + 0.5
    points = torch.tensor([[3.0, 12.0], [6.0, 20.0]], requires_grad=True)
    chamfer_pull(points, field, targets).backward()
    assert (points.grad[:, 0] < 0).all(), "descending moves the points to the right"


def test_robust_distance_saturates():
    zero = torch.zeros(1, 2)
    near, far = (robust_distance(zero, torch.tensor([[d, 0.0]]), torch.ones(1), 1.0) for d in (0.1, 1e6))
    torch.testing.assert_close(near, torch.tensor(0.01 / 1.01))
    torch.testing.assert_close(far, torch.tensor(1.0))


def test_clearance_costs_nothing_beyond_the_margin():
    d = torch.tensor([0.004, 0.1, 0.002], requires_grad=True)
    loss = depth_penalty(d, 0.004)
    loss.backward()
    torch.testing.assert_close(loss, torch.tensor(0.25 / 3))
    assert d.grad[1] == 0 and d.grad[2] < 0
