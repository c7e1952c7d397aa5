"""Fit GAPS' last layer to the network's own drapes after projective steps, in closed form.

Physics is learned frame by frame, and what it leaves is local: stretch of a few per cent, which projective steps
(``recon.cloth.projective``) take away in 30 ms a drape. Draped once on some thousand frames, the network is its own
teacher: of its states s, which stay as they are, the linear map to the drapes is a least squares problem. The map then
becomes two layers, for the states fill few directions (:func:`narrowed`): less memory to read in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from pipelines.gaps_drapes import Drapes, Teaching, Window, drapes
from pipelines.low_rank import low_rank
from recon.bodies import Body
from recon.cloth.energies import Cloth
from recon.draping.gaps import Bound, GapsDraper, GapsNet
from recon.types import BodyPose, Mesh, Motion

OUTLIER = 0.03
"""What a linear map misses by more than this counts as this much [m]."""
PLACE = 0.3
"""Moving by this counts as much as edges that change by their length, where drapes are left out [m]."""
DEEPEST = 0.02
"""Vertices that are to be pushed out further than this are pushed this far in one round [m]."""


def taught(draper: GapsDraper, motions: Sequence[Motion], body: Body, teaching: Teaching, kept: Path) -> GapsNet:
    """The whole of it: draped, fitted, narrowed. ``kept`` as in :func:`drapes`; its files go at the end."""
    rest = draper.garment if isinstance(draper.garment, Mesh) else draper.garment.mesh
    if not teaching.fit:
        return narrowed(draper.net, states_on(draper.net, motions, body, teaching), rest, teaching.rank)
    known = drapes(draper, motions, body, teaching, kept)
    problem = LinearMap.of(draper.net, known, teaching)
    net = refitted(draper.net, problem, unposed_planes(known, draper.bound, body), teaching)
    net = narrowed(net, problem.states[:, :-1], rest, teaching.rank)
    for file in kept.parent.glob(f"{kept.name}-*.safetensors"):
        file.unlink()
    return net


@torch.no_grad()
def states_on(net: GapsNet, motions: Sequence[Motion], body: Body, teaching: Teaching) -> Tensor:
    """(N, W) states of a network on random windows."""
    generator = torch.Generator().manual_seed(0)
    many = [Window.drawn(motions, body, teaching, generator) for _ in range(teaching.windows)]
    rows = Drapes.rows(teaching)
    return torch.cat([net.remember(w.features[None], w.shape[None])[0][0, rows] for w in many])


@dataclass
class LinearMap:
    """The least squares problem: from states and one, (R, W + 1), to displacements (R, 3 V)."""

    states: Tensor
    wanted: Tensor
    inverse: Tensor
    """(W + 1, R) from misses to the map's change."""

    @staticmethod
    @torch.no_grad()
    def of(net: GapsNet, known: Drapes, teaching: Teaching) -> LinearMap:
        """Of the states that a network has in the frames that were draped."""
        rows = Drapes.rows(teaching)
        pairs = zip(known.features.split(64), known.shape.split(64), strict=True)
        states = torch.cat([net.remember(f, s)[0][:, rows] for f, s in pairs]).flatten(0, 1).double()
        states = torch.cat([states, states.new_ones(len(states), 1)], 1)
        square = states.T @ states + teaching.ridge * len(states) * torch.eye(states.shape[1], dtype=torch.float64)
        wanted = known.moved.flatten(0, 1).flatten(1).float()
        return LinearMap(states.float(), wanted, torch.linalg.solve(square, states.T).float())


@torch.no_grad()
def refitted(net: GapsNet, problem: LinearMap, planes: tuple[Tensor, Tensor], teaching: Teaching) -> GapsNet:
    """The network (without basis and few drapes) whose last layer suits the drapes, and stays out of the body.

    ``planes``: see :func:`unposed_planes`.
    """
    found = net.shape.scale * torch.cat([net.out.weight.T, net.out.bias[None]])
    for _ in range(2):  # the second knows which drapes are outliers
        miss = problem.wanted - problem.states @ found
        found = found + problem.inverse @ miss.clamp_(-OUTLIER, OUTLIER)
    normal, gap = planes
    for _ in range(teaching.pushes):
        moved = (problem.states @ found - problem.wanted).unflatten(1, (-1, 3))
        lack = (teaching.margin - gap - (normal * moved).sum(-1)).clamp_(0, DEEPEST)
        found = found + problem.inverse @ (lack[..., None] * normal).flatten(1)
    fitted = GapsNet(net.shape)
    fitted.gru.load_state_dict(net.gru.state_dict())
    fitted.out.weight.copy_(found[:-1].T / net.shape.scale)
    fitted.out.bias.copy_(found[-1] / net.shape.scale)
    return fitted


def unposed_planes(known: Drapes, bound: Bound, body: Body) -> tuple[Tensor, Tensor]:
    """The body's planes beside the drapes as displacements see them: normals (R, V, 3), distances (R, V) [m]."""
    normals = []
    for shape, pose, place, normal in zip(known.shape, known.pose, known.place, known.normal, strict=True):
        transforms = body.skeleton(BodyPose(shape.expand(len(pose), -1), pose, place))[0]
        normals.append(bound.unposed(normal.float(), transforms))
    return torch.cat(normals), known.gap.flatten(0, 1).float()


@torch.no_grad()
def narrowed(net: GapsNet, states: Tensor, rest: Mesh, rank: int) -> GapsNet:
    """The nearest network whose last layer mixes ``rank`` drapes, near in edges by their length and in places.

    Lengths count because a tenth of a millimetre is nothing for a place, but not for an edge of a fine mesh.

    Args:
        net: without a basis and few drapes, of V vertices.
        states: (N, W) that it has on motions.
        rest: the garment (V, 3).
        rank: drapes, at most W.
    """
    cloth = Cloth.from_mesh(rest)
    few, out = low_rank(net.out, states, rank, lambda moved: _counted(moved.unflatten(0, (-1, 3)), cloth))
    found = GapsNet(replace(net.shape, rank=few.out_features))
    found.gru.load_state_dict(net.gru.state_dict())
    found.few.load_state_dict(few.state_dict())
    found.out.load_state_dict(out.state_dict())
    return found


def _counted(moved: Tensor, cloth: Cloth) -> Tensor:
    """Displacements (V, 3, N) -> (3 E + 3 V, N), whose squares add up."""
    one, other = cloth.edges.unbind(1)
    length = cloth.edge_lengths.to(moved).clamp_min(1e-9) * len(one) ** 0.5
    edges = (moved[one] - moved[other]) / length[:, None, None]
    return torch.cat([edges.flatten(0, 1), moved.flatten(0, 1) / (PLACE * len(moved) ** 0.5)])
