"""A binding sampled once on a lattice around the neutral body: bindings for moving vertices in milliseconds."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from recon.draping.binding import BodyField, rbf

SPACING = 0.03
"""Distance of lattice nodes [m]."""
MARGIN = 0.30
"""The lattice reaches this far around the body's box [m]; further points take the border's values."""
PARTICIPANTS = 1600
"""Body vertices that take part; the participation of Eq. 6 is a smooth average, so a part of them says the same."""
FAR = 0.25
"""Nodes further than this from the body [m] make do with a tenth of the participants: no cloth hangs there."""


class Lattice:
    """Features of a body field on a regular lattice, read by trilinear interpolation."""

    def __init__(self, field: BodyField):
        """Sample GAPS' participation (``binding.rbf``) of a body field; takes a few seconds."""
        order = torch.randperm(len(field.vertices), generator=torch.Generator().manual_seed(0)).to(
            field.vertices.device
        )
        self.low = field.vertices.min(0).values - MARGIN
        high = field.vertices.max(0).values + MARGIN
        self.counts = ((high - self.low) / SPACING).ceil().long() + 1
        axes = [self.low[k] + SPACING * torch.arange(int(self.counts[k]), device=self.low.device) for k in range(3)]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        body = cKDTree(field.vertices.cpu().numpy())
        distance, _ = body.query(nodes.cpu().numpy(), distance_upper_bound=FAR)
        near = torch.as_tensor(distance < FAR, device=nodes.device)
        self.features = nodes.new_zeros(len(nodes), field.features.shape[1])
        for where, count in ((near, PARTICIPANTS), (~near, PARTICIPANTS // 10)):
            some = order[:count]
            self.features[where] = rbf(BodyField(field.vertices[some], field.features[some]), nodes[where])

    def __call__(self, points: Tensor) -> Tensor:
        """(N, 3) points [m] -> (N, C) features, differentiable in the points."""
        last = (self.counts - 1).to(points)
        at = ((points - self.low) / SPACING).clamp(torch.zeros_like(last), last - 1e-3)
        cell = at.detach().floor()
        part = at - cell
        base = cell.long()
        stride = torch.stack([self.counts[1] * self.counts[2], self.counts[2], torch.ones_like(self.counts[2])])
        total: Tensor | None = None
        for corner in range(8):
            step = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=points.device)
            share = torch.where(step.bool(), part, 1 - part).prod(1, keepdim=True)
            value = self.features[((base + step) * stride).sum(1)] * share
            total = value if total is None else total + value
        assert total is not None
        return total
