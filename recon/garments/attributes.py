"""Editing garments by what they have or lack (DrapeNet §4.2): a regression tells which parts of a code matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

THRESHOLD = 0.5
"""Entries of a code whose weight, relative to the largest and smallest, is below this have nothing to do with it."""
MEASURES = {"sleeves": ("sleeve_x", 1.0), "length": ("hem_y", -1.0), "opening": ("opening", 1.0)}
"""Attribute -> the pattern parameter that it grows with, and in which direction."""


@dataclass(frozen=True)
class Attribute:
    """What a feature (long sleeves, an open front) is in code space."""

    weight: Tensor
    """(Z,) the regression's weights, for codes in units of their deviation."""
    way: Tensor
    """(Z,) direction of the edit in code units, zero where the weight is below the threshold."""
    accuracy: float
    """Share of the learned codes that the regression tells right."""

    def edit(self, latent: Tensor, amount: float) -> Tensor:
        """The code (Z,) with more of the feature (less: negative); 1 is a standard deviation of each entry changed."""
        return latent + amount * self.way


def labels_of(parameters: Sequence[dict[str, float]], name: str) -> tuple[Tensor, Tensor]:
    """Rows (K,) of the garments that have the measure of an attribute, and which of them have much of it (K,).

    The feature is binary as in the paper: above the median or not; an opening is there or not.
    """
    key, sign = MEASURES[name]
    if name == "opening":
        return torch.arange(len(parameters)), torch.tensor([p.get(key, 0.0) > 0 for p in parameters])
    rows = torch.tensor([k for k, p in enumerate(parameters) if key in p], dtype=torch.long)
    values = sign * torch.tensor([parameters[k][key] for k in rows.tolist()])
    return rows, values > (values.median() if len(values) else 0.0)


def learn_attribute(codes: Tensor, labels: Tensor, ridge: float = 1e-2) -> Attribute:
    """The attribute that labels (n,) bool describe on codes (n, Z), by linear logistic regression.

    Raises:
        ValueError: all labels are alike.
    """
    if bool(labels.all()) or not bool(labels.any()):
        raise ValueError("labels are all alike; wanted garments with and without the feature")
    spread = codes.std(0).clamp_min(1e-6)
    x, y = (codes - codes.mean(0)) / spread, labels.to(codes.dtype)
    weight = torch.zeros(codes.shape[1] + 1, dtype=codes.dtype, requires_grad=True)
    balance = torch.where(labels, (~labels).sum() / len(labels), labels.sum() / len(labels)).to(codes.dtype)
    lbfgs = torch.optim.LBFGS([weight], max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        lbfgs.zero_grad()
        entropy = F.binary_cross_entropy_with_logits(x @ weight[1:] + weight[0], y, balance)
        loss = entropy + ridge * weight[1:].square().mean()
        loss.backward()
        return loss

    lbfgs.step(closure)
    found = weight.detach()
    told = ((x @ found[1:] + found[0]) > 0) == labels
    size = found[1:].abs()
    share = (size - size.min()) / (size.max() - size.min()).clamp_min(1e-12)
    way = torch.where(share >= THRESHOLD, found[1:] / size.max().clamp_min(1e-12), 0.0) * spread
    return Attribute(found[1:], way, float(told.float().mean()))
