"""Drapers: a rest-pose garment onto a posed body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from recon.types import Garment, Mesh, PosedBody


@runtime_checkable
class Draper(Protocol):
    """What every draper answers to."""

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on the posed bodies, (B, N, 3); ``under``: the layers beneath, already draped."""
        ...
