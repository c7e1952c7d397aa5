"""Parametric bodies behind one 24-joint rig."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from recon.types import BodyPose, Mesh, PosedBody, UserError


@runtime_checkable
class Body(Protocol):
    """What every body answers to: batched, differentiable in shape, pose and translation."""

    name: str
    faces: Tensor
    weights: Tensor
    shape_dirs: Tensor
    regions: Tensor
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    region_names: tuple[str, ...]

    @property
    def n_shape(self) -> int: ...
    def neutral(self, batch: int = 1) -> BodyPose: ...
    def rest(self, shape: Tensor) -> Mesh: ...
    def rest_joints(self, shape: Tensor) -> Tensor: ...
    def skeleton(self, body: BodyPose, rotations: Tensor | None = None) -> tuple[Tensor, Tensor]: ...
    def pose(self, body: BodyPose) -> PosedBody: ...
    def landmarks(self, posed: PosedBody) -> Tensor: ...
    def region_mask(self, *names: str) -> Tensor: ...


BODIES = {
    "anny": "recon.bodies.anny:build",
    "smpl": "recon.bodies.smpl:smpl",
    "smplh": "recon.bodies.smpl:smplh",
    "smplx": "recon.bodies.smpl:smplx",
}
"""Body name -> module:builder, called with (path, device)."""


def load_body(name: str = "anny", path: str | Path | None = None, device: str | torch.device = "cpu") -> Body:
    """The named body on ``device``: ``anny`` is embedded; smpl, smplh and smplx need the ``path`` of a user's file."""
    if name not in BODIES:
        raise UserError(f"body: found {name!r}, wanted one of {', '.join(BODIES)}")
    module, builder = BODIES[name].split(":")
    return getattr(import_module(module), builder)(path, device)
