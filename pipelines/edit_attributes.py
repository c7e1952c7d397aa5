"""Edit a garment by what it has more or less of (DrapeNet §4.2): ``recon edit top:3 --attributes sleeves=-1 ...``.

What tells the learned garments that have much of it from the others is found by logistic regression on their codes; the
entries of the code that have nothing to do with it stay. It needs no panels: either decoder's codes can be edited.
"""

from __future__ import annotations

import torch
from torch import Tensor

from recon.garments import GarmentDecoder
from recon.garments.attributes import MEASURES, labels_of, learn_attribute
from recon.types import UserError

MOST = 5.0
"""Largest amount of an edit [standard deviations]: further away no decoder knows anything."""


def read_amounts(attributes: tuple[str, ...]) -> dict[str, float]:
    """Attribute -> amount, of words such as ``sleeves=-1``.

    Raises:
        UserError: a word of another form, an unknown attribute, one named twice, or an amount out of range.
    """
    amounts: dict[str, float] = {}
    for word in attributes:
        name, _, number = word.partition("=")
        if name not in MEASURES or name in amounts:
            how = "twice " if name in amounts else ""
            raise UserError(f"--attributes: found {how}{word!r}; wanted some of {', '.join(MEASURES)}, as in length=-1")
        try:
            amounts[name] = float(number)
        except ValueError:
            raise UserError(f"--attributes: found {word!r}; wanted a number, as in {name}=-1") from None
        if not abs(amounts[name]) <= MOST:
            raise UserError(f"--attributes: found {word!r}; wanted an amount from {-MOST:g} to {MOST:g}")
    return amounts


def with_attributes(
    decoder: GarmentDecoder, latent: Tensor, amounts: dict[str, float]
) -> tuple[Tensor, dict[str, dict[str, float]]]:
    """The edited code (z,), and of each attribute what the regression found.

    Args:
        decoder: whose codes tell.
        latent: (z,) the code to edit.
        amounts: attribute -> how much more of it, in standard deviations of the entries that change.

    Returns:
        The code, and ``accuracy`` (share of the learned garments that the regression tells right) and ``entries``
        (how many of the code change) of each attribute.

    Raises:
        UserError: no learned garment has the attribute, or all have.
    """
    found: dict[str, dict[str, float]] = {}
    edited = latent.clone()
    for name, amount in amounts.items():
        rows, labels = labels_of(decoder.parameters, name)
        try:
            attribute = learn_attribute(decoder.codes[rows], labels)
        except ValueError:
            raise UserError(
                f"--attributes: {name}: all known garments of kind {decoder.kind} are alike in it"
            ) from None
        edited = attribute.edit(edited, amount)
        found[name] = {"accuracy": round(attribute.accuracy, 3), "entries": int((attribute.way != 0).sum())}
    return edited, found


def extent(vertices: Tensor) -> list[float]:
    """Width, height and depth of a garment (V, 3) [m]."""
    size: Tensor = vertices.amax(0) - vertices.amin(0)
    return [round(v, 3) for v in torch.as_tensor(size).tolist()]
