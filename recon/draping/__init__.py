"""Drapers: a rest-pose garment onto a posed body."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, runtime_checkable

from recon.types import Garment, Mesh, PosedBody, UserError


@runtime_checkable
class Draper(Protocol):
    """What every draper answers to."""

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on the posed bodies, (B, N, 3); ``under``: the layers beneath, already draped."""
        ...


DRAPERS = {
    "skinning": "recon.draping.skinning:load_skinning",
    "isp": "recon.draping.isp:load_isp_draper",
    "drapenet": "recon.draping.drapenet:load_drapenet",
}
"""Draper name -> ``module:function`` of (body, folder)."""


def load_draper(name: str, body, folder: str | Path | None = None) -> Draper:
    """The named draper for a ``recon.bodies`` body; ``folder``: the user's own weights, None = those that ship.

    UserError: no such draper, weights missing or corrupt.
    """
    if name not in DRAPERS:
        raise UserError(f"draper: found {name!r}, wanted one of {', '.join(DRAPERS)}")
    module, _, function = DRAPERS[name].partition(":")
    return getattr(import_module(module), function)(body, folder)
