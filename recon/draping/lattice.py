"""GAPS' participation sampled once on a lattice around the neutral body: bindings of moving vertices, quickly."""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse as sp
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from recon.draping.binding import BodyField, gaps

SPACING = 0.025
"""Distance of lattice nodes [m]."""
BAND = 0.15
"""Nodes up to so far from the body [m] have features of their own; further ones share those of the nearest that has."""
MARGIN = 0.30
"""The lattice reaches this far around the body's box [m]; further points take the border's values."""


class Lattice:
    """Features of a body field on a regular lattice, read by trilinear interpolation."""

    def __init__(self, field: BodyField):
        """Sample ``binding.gaps`` of a body field; takes a few seconds."""
        vertices = field.vertices.cpu().double().numpy()
        low = vertices.min(0) - MARGIN
        counts = np.ceil((vertices.max(0) + MARGIN - low) / SPACING).astype(int) + 1
        axes = [low[k] + SPACING * np.arange(counts[k]) for k in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        near = np.isfinite(field.cells[0].tree.query(nodes, distance_upper_bound=BAND)[0])
        nearest = distance_transform_edt(~near.reshape(counts), return_distances=False, return_indices=True)
        row = (np.cumsum(near) - 1)[np.ravel_multi_index(tuple(nearest.reshape(3, -1)), counts)]
        device = field.vertices.device
        self.low = torch.as_tensor(low, dtype=torch.float32, device=device)
        self.last = torch.as_tensor(counts - 1, device=device)
        self.stride = torch.as_tensor([counts[1] * counts[2], counts[2], 1], device=device)
        self.row = torch.as_tensor(row, device=device)
        """(nodes,) which row of features each node reads."""
        self.features = gaps(field, torch.as_tensor(nodes[near], dtype=torch.float32, device=device))

    def __call__(self, points: Tensor) -> Tensor:
        """(N, 3) points [m] -> (N, C) features, differentiable in the points."""
        last = self.last.to(points)
        at = ((points - self.low.to(points)) / SPACING).clamp(torch.zeros_like(last), last - 1e-3)
        base = at.detach().floor()
        part = at - base
        first = (base.long() * self.stride).sum(1)
        steps = torch.tensor(list(itertools.product((0, 1), repeat=3)), device=points.device)  # (8, 3)
        share = torch.where(steps.bool(), part[:, None], 1 - part[:, None]).prod(2)  # (N, 8)
        rows = self.row[first[:, None] + (steps * self.stride).sum(1)]
        if not points.is_cuda and not (torch.is_grad_enabled() and points.requires_grad):
            starts = np.arange(0, rows.numel() + 1, 8)  # one sparse product: a quarter of the time
            entries = share.float().numpy().ravel(), rows.numpy().ravel(), starts
            read = sp.csr_matrix(entries, shape=(len(points), len(self.features)))
            return torch.from_numpy(read @ self.features.numpy()).to(points)
        return (self.features.to(points)[rows] * share[..., None]).sum(1)
