"""Draping by ISP's displacement network D_s: skinning, corrected by a learned map over the panels (ISP §3.2, Eq. 7-8).

The network gives two displacement maps, front and back, for a pose, a shape and a garment; they are read at the points
of the panels, averaged at the seams and added to the garment at rest before it is skinned; at the end some rounds draw
edges to their lengths and cloth out of the body (:mod:`recon.draping.ending`). Its maps are sums of smooth cosines
instead of the paper's N x N numbers, and it knows a garment by its rest maps' principal components instead of by a
decoder's code: so it drapes whatever has panels of its kind, and still does when a decoder is trained anew.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import scipy.sparse as sp
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.bodies.rig import PARENTS
from recon.draping.ending import ROUNDS, Ending
from recon.draping.gaps import Bound
from recon.draping.skinning import SkinningDraper
from recon.draping.uv import Box, Cosines, Welding, around, map_size, modes, rest_features
from recon.files.weights import read_weights
from recon.types import Garment, Mesh, PosedBody, UserError

FARTHEST = 1.0
"""Garments further from the learned ones' mean than so many deviations (root mean square of the components) count as if
they were there: beyond, the network guesses (a wide jacket strained to six times skinning's)."""
KEPT = 4
"""So many garments stay prepared."""


@dataclass(frozen=True)
class DisplacementShape:
    """What is needed to rebuild the network of one kind of garment."""

    kind: str
    joints: tuple[int, ...]
    """Joints whose turning moves this kind of garment; the pelvis enters by the direction of gravity."""
    n_shape: int
    box: Box
    """Where the maps lie."""
    modes: int = 900
    """Cosines of each panel's maps."""
    rank: int = 96
    """Displacement maps that all others are sums of."""
    code: int = 32
    """Principal components of the rest maps."""
    cells: tuple[int, int] = (16, 16)
    """Nodes of the rest maps along x and y."""
    width: int = 224
    depth: int = 4
    scale: float = 0.05
    """Displacement [m] that an output of one means."""

    @property
    def features(self) -> int:
        """Numbers that the network sees."""
        return 6 * len(self.joints) + 3 + self.n_shape + self.code


def pose_features(transforms: Tensor, joints: Sequence[int]) -> Tensor:
    """(B, 6 J + 3): two columns of each joint's local rotation less the T pose's, and gravity as the pelvis feels it.

    ``transforms``: (B, 24, 4, 4) of a ``PosedBody``.
    """
    world = transforms[..., :3, :3]
    own, parent = world[:, list(joints)], world[:, [PARENTS[j] for j in joints]]
    local = parent.transpose(-1, -2) @ own - torch.eye(3).to(world)
    return torch.cat([local[..., :2].flatten(1), -world[:, 0, 1]], 1)


class DisplacementNet(nn.Module):
    """D_s: features of pose, shape and garment -> both panels' displacement maps."""

    mean: Tensor
    components: Tensor

    def __init__(self, shape: DisplacementShape):
        super().__init__()
        self.shape = shape
        rest = 8 * shape.cells[0] * shape.cells[1]
        self.register_buffer("mean", torch.zeros(rest))
        self.register_buffer("components", torch.zeros(rest, shape.code))
        self.cosines = Cosines(shape.box, modes(shape.box, shape.modes))
        self.first = nn.Linear(shape.features, shape.width)
        self.inner = nn.ModuleList(nn.Linear(shape.width, shape.width) for _ in range(shape.depth - 1))
        self.again = nn.Linear(shape.features, shape.width, bias=False)
        self.narrow = nn.Linear(shape.width, shape.rank)
        self.out = nn.Linear(shape.rank, 2 * shape.modes * 3)
        nn.init.normal_(self.out.weight, 0.0, 0.02)
        nn.init.zeros_(self.out.bias)

    def know(self, features: Tensor) -> None:
        """Take the code's meaning from rest features (N, R) of the garments to learn from: unit deviations."""
        with torch.no_grad():
            self.mean.copy_(features.mean(0))
            _, size, along = torch.linalg.svd(features - self.mean, full_matrices=False)
            count = min(self.shape.code, int((size > 1e-3 * size[0]).sum()))
            self.components.zero_()
            self.components[:, :count] = along[:count].T / (size[:count] / len(features) ** 0.5)

    def code(self, garment: Garment) -> Tensor:
        """(code,) what the network knows of a garment; differentiable in its vertices and panels."""
        found = rest_features(garment, self.shape.box, self.shape.cells).to(self.mean) - self.mean
        code = found @ self.components
        return code * (FARTHEST / code.square().mean().clamp_min(1e-12).sqrt()).clamp(max=1.0)

    def forward(self, transforms: Tensor, shape: Tensor, code: Tensor) -> Tensor:
        """Joints (B, 24, 4, 4), shapes (B, S), code (code,) -> displacement maps (B, 3, 2, nx, ny) [m], front and back.

        Their nodes cover ``shape.box``, x along the fourth axis.
        """
        pose = pose_features(transforms, self.shape.joints)
        x = torch.cat([pose, shape, code.expand(len(pose), -1)], 1)
        h = F.silu(self.first(x))
        for k, layer in enumerate(self.inner):
            h = h + F.silu(layer(h) + (self.again(x) if k == len(self.inner) // 2 else 0))
        found = self.shape.scale * self.out(self.narrow(h)).view(len(x), 2, self.shape.modes, 3)
        return self.cosines(found.permute(0, 3, 1, 2))


@dataclass(frozen=True)
class Worn:
    """A garment prepared for draping: all that does not depend on the body's pose and shape."""

    bound: Bound
    """How it rides on the body."""
    faces: Tensor
    rows: Tensor
    """(P, 4) the nodes of the maps around each panel point."""
    shares: Tensor
    """(P, 4)."""
    welding: Welding
    code: Tensor
    cells: tuple[int, int]
    """Nodes of a map along x and y."""
    ending: Ending

    @classmethod
    def of(cls, garment: Garment, net: DisplacementNet, skinning: SkinningDraper, rounds: int = ROUNDS) -> Worn:
        """Bind, read the rest maps, find the panel points' places on the displacement maps; ``rounds`` end a drape."""
        box = net.shape.box
        rows, shares = around(box, map_size(box), garment.panel_points.to(net.mean), garment.side_of_point)
        weights, directions = skinning.bind(garment.mesh.vertices, garment.mesh.faces)
        return cls(
            Bound(garment.mesh.vertices, weights, directions),
            garment.mesh.faces,
            rows,
            shares,
            Welding.of(garment),
            net.code(garment),
            map_size(box),
            Ending.of(garment, skinning.surface, rounds),
        )

    @cached_property
    def sampling(self) -> sp.csr_matrix:
        """(V, nodes) what reads maps at all vertices at once: several times faster than point by point."""
        points, vertices = len(self.rows), len(self.bound.rest)
        shares = self.shares.detach().cpu() * self.welding.share.cpu()[self.welding.vertex_of_point.cpu()]
        at = self.welding.vertex_of_point.cpu()[:, None].expand(points, 4)
        nodes = 2 * math.prod(self.cells)
        entries = shares.flatten().float().numpy(), (at.flatten().numpy(), self.rows.cpu().flatten().numpy())
        return sp.csr_matrix(entries, shape=(vertices, nodes))

    def displaced(self, maps: Tensor) -> Tensor:
        """Maps (B, 3, 2, nx, ny) -> displacements of the vertices at rest (B, V, 3) [m]."""
        learned = torch.is_grad_enabled() and (maps.requires_grad or self.shares.requires_grad)
        if not learned and not maps.is_cuda:
            columns = maps.detach().flatten(2).flatten(0, 1).numpy().T
            return torch.from_numpy(self.sampling @ columns).unflatten(1, (-1, 3)).transpose(0, 1)
        nodes = maps.flatten(2).flatten(0, 1).T.contiguous()
        at_points = (nodes[self.rows] * self.shares[..., None]).sum(1)
        return self.welding(at_points.unflatten(1, (-1, 3)).transpose(0, 1))

    def placed(self, moved: Tensor, body: PosedBody) -> Tensor:
        """Displacements (B, V, 3) [m] of the garment at rest -> where it is on B bodies (B, V, 3)."""
        return self.ending(self.bound.place(moved, body.transforms, body.shape), body)


class IspDraper:
    """A ``Draper``: skinning and D_s."""

    def __init__(self, nets: dict[str, DisplacementNet], body):
        """``nets``: one for each kind of garment; ``body``: a ``recon.bodies`` body."""
        self.nets = {kind: net.eval().requires_grad_(False) for kind, net in nets.items()}
        self.skinning = SkinningDraper(body)
        self._kept: OrderedDict[int, tuple[Tensor, Worn]] = OrderedDict()

    def knows(self, garment: Garment | Mesh) -> bool:
        """Whether it can drape it: a garment with panels, of a kind that it has learned."""
        return isinstance(garment, Garment) and garment.kind in self.nets and garment.has_panels

    def prepare(self, garment: Garment) -> Worn:
        """What only depends on the garment; kept for the last few that carry no gradient.

        Raises:
            UserError: no network for this kind of garment, or a garment without panels.
        """
        if not garment.has_panels:
            raise UserError("draper isp: found a garment without panels; wanted --draper drapenet or skinning")
        if garment.kind not in self.nets:
            known = ", ".join(self.nets) or "nothing"
            raise UserError(f"draper isp: found a {garment.kind}; it has learned {known}")
        vertices = garment.mesh.vertices
        kept = self._kept.get(id(vertices))
        if kept is not None and kept[0] is vertices:
            return kept[1]
        worn = Worn.of(garment, self.nets[garment.kind], self.skinning)
        if not vertices.requires_grad:
            self._kept[id(vertices)] = vertices, worn
            if len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return worn

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on B bodies: Mesh with (B, V, 3) vertices; layers beneath are the layering network's business.

        Differentiable in the garment's vertices and panels and in the body's shape, pose and translation.
        """
        worn, net = self.prepare(garment), self.nets[garment.kind]
        return Mesh(worn.placed(worn.displaced(net(body.transforms, body.shape, worn.code)), body), garment.mesh.faces)


def load_isp_draper(body, folder: str | Path | None = None, kinds: Sequence[str] | None = None) -> IspDraper:
    """The draper with the networks ``drape-isp-KIND`` of a weights folder, or else the packaged ones.

    Args:
        body: a ``recon.bodies`` body.
        folder: with a manifest.
        kinds: which are needed; None = those that there are.

    Raises:
        UserError: weights missing or corrupt, not of such a network, or learned on bodies of other shape coefficients.
    """
    from recon.files.weights import read_manifest

    if kinds is None:
        prefix = "drape-isp-"
        kinds = [name.removeprefix(prefix) for name in read_manifest(folder) if name.startswith(prefix)]
    nets = {}
    for kind in kinds:
        weights = read_weights(f"drape-isp-{kind}", folder)
        try:
            nets[kind] = build(weights.tensors, weights.card)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise UserError(f"drape-isp-{kind}: weights and card don't describe a draping network ({error})") from error
        if nets[kind].shape.n_shape != body.n_shape:
            raise UserError(
                f"drape-isp-{kind}: learned on bodies of {nets[kind].shape.n_shape} shape coefficients; "
                f"this body ({body.name}) has {body.n_shape}; wanted the same, or --draper skinning"
            )
    return IspDraper(nets, body)


def build(tensors: dict[str, Tensor], card: dict) -> DisplacementNet:
    """A network from its stored parts."""
    raw = dict(card["shape"])
    box = Box(*(tuple(raw["box"][k]) for k in ("low", "high")))
    net = DisplacementNet(
        DisplacementShape(**{**raw, "joints": tuple(raw["joints"]), "cells": tuple(raw["cells"]), "box": box})
    )
    net.load_state_dict({k: v.float() for k, v in tensors.items()})
    return net
