"""Closed forms of unsigned distance fields, and integrals over their surfaces."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Field = Callable[[Tensor], Tensor]
TURN = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, -0.2], [-0.3, 0, 0.5], [0.2, -0.5, 0]]))
MIDDLE = torch.tensor([0.01, 0.02, -0.013])


def placed(field: Field) -> Field:
    """The field turned and moved, so that nothing lies along the grid."""
    return lambda x: field((x - MIDDLE) @ TURN)


def _ring(x: Tensor, radius) -> Tensor:
    """Signed distance from a circular cylinder round y."""
    return (x[:, [0, 2]].square().sum(1) + 1e-12).sqrt() - radius


def _length(*parts: Tensor) -> Tensor:
    return (sum(p.square() for p in parts) + 1e-14).sqrt()


def disc(radius) -> Field:
    """A flat disc."""
    return placed(lambda x: _length(torch.relu(_ring(x, radius)), x[:, 1]))


def cylinder(radius, half) -> Field:
    """A cylinder without lids, 2 ``half`` long."""
    return placed(lambda x: _length(_ring(x, radius), torch.relu(x[:, 1].abs() - half)))


def hemisphere(radius) -> Field:
    """The upper half of a sphere."""

    def distance(x: Tensor) -> Tensor:
        ball = (x.square().sum(1) + 1e-12).sqrt() - radius
        return torch.where(x[:, 1] >= 0, _length(ball), _length(_ring(x, radius), x[:, 1]))

    return placed(distance)


def integral(vertices: Tensor, faces: Tensor) -> Tensor:
    """A number that depends on the surface alone, not on its mesh: the integral of a smooth function."""
    a, b, c = vertices[faces].unbind(1)
    m = (a + b + c) / 3
    value = 1 + 3 * m[:, 0] + 4 * m[:, 1].square() + 2 * m[:, 2]
    return (torch.linalg.cross(b - a, c - a).norm(dim=1) / 2 * value).sum()
