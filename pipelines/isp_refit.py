"""Fit the last layer of ISP's D_s to its own drapes after projective steps: a linear least squares problem.

As in :mod:`pipelines.gaps_refit`, what physics leaves is local, and projective steps take it away. Here one map from
states to the cosines' coefficients serves all garments, so it is found by conjugate gradients: of garments g with what
their vertices read from the cosines, Phi_g, of states S_g and displacements Y_g after the steps, least

    sum_g |A_g (Phi_g C S_g - Y_g)|^2 + ridge |C - C_0|^2,    A: edges by their length at rest, and places.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from rich.progress import track
from torch import Tensor, nn

from pipelines.drape_garments import Wardrobe
from pipelines.drape_training import BodySampler
from pipelines.low_rank import low_rank
from recon.bodies import Body
from recon.cloth.projective import Projecting, Projective
from recon.draping.isp import DisplacementNet, Worn

PLACE = 0.3
"""Moving by this counts as much as edges that change by their length [m]."""
DEEPEST = 0.02
"""Vertices that are to be pushed out further than this are pushed this far in one round [m]."""
OUTLIER = 0.05
"""Drapes further than this from the network's own count as if they were so far [m]."""


@dataclass(frozen=True)
class IspTeaching:
    """How drapes are made and learned from."""

    bodies: int = 40
    """Bodies that each garment is draped on; 0 = the last layer stays as physics left it."""
    steps: int = 8
    """Projective steps."""
    offset: float = 0.004
    """Distance from the body that vertices are brought to [m]."""
    rounds: int = 40
    """Of conjugate gradients, the first time."""
    ridge: float = 1e-3
    """Pull to the map that physics left, by that of a mean garment."""
    pushes: int = 3
    """Times that vertices beneath ``margin`` are pushed out, each followed by a third of the rounds."""
    margin: float = 0.003
    """Distance from the body below which vertices are pushed [m]."""


@dataclass
class Dressed:
    """One garment on B bodies, draped."""

    states: Tensor
    """(B, W + 1), the last one 1."""
    reads: Tensor
    """(V, 2 M) what its vertices read of the cosines, panels first."""
    metric: Tensor
    """(2 M, 2 M) of the coefficients: reads' A' A reads."""
    weigh: Tensor
    """(2 M, V) reads' A' A."""
    moved: Tensor
    """(B, V, 3) displacements after the steps [m]."""
    normal: Tensor
    """(B, V, 3) of the body beside each vertex, as displacements see it; zero where there is none."""
    gap: Tensor
    """(B, V) [m]."""


@torch.no_grad()
def retaught(
    net: DisplacementNet, worn: list[Worn], wardrobe: Wardrobe, sampler: BodySampler, body: Body, teaching: IspTeaching
) -> None:
    """Fit ``net.narrow`` and ``net.out`` in place."""
    generator = torch.Generator().manual_seed(1)
    basis = net.cosines(torch.eye(net.shape.modes)).flatten(1).T
    dressed = []
    for k in track(range(len(worn)), "drapes"):
        pose = sampler(teaching.bodies, generator)
        dressed.append(_dressed(net, worn[k], (wardrobe, k), body.pose(pose), teaching, basis))
    out = nn.Linear(net.shape.width, net.out.out_features)
    out.weight.copy_(net.out.weight @ net.narrow.weight)
    out.bias.copy_(net.out.bias + net.out.weight @ net.narrow.bias)
    start = net.shape.scale * torch.cat([out.weight.T, out.bias[None]])
    found = _fitted(start, dressed, teaching) / net.shape.scale
    out.weight.copy_(found[:-1].T)
    out.bias.copy_(found[-1])
    size, axes = torch.linalg.eigh(_mean_metric(dressed).double())
    root = size.clamp_min(0).sqrt()[:, None] * axes.T

    def counted(columns: Tensor) -> Tensor:
        return (root @ columns.unflatten(0, (-1, 3)).flatten(1)).unflatten(1, (3, -1)).flatten(0, 1)

    states = torch.cat([d.states[:, :-1] for d in dressed])
    few, last = low_rank(out, states, net.shape.rank, counted)
    net.narrow.load_state_dict(few.state_dict())
    net.out.load_state_dict(last.state_dict())


def _mean_metric(dressed: list[Dressed]) -> Tensor:
    return torch.stack([d.metric for d in dressed]).mean(0)


def _dressed(net: DisplacementNet, worn: Worn, owner: tuple[Wardrobe, int], posed, teaching, basis) -> Dressed:
    """Drape a garment on posed bodies, by the network and then by steps."""
    wardrobe, k = owner
    garment = wardrobe.garments[k]
    moved = worn.displaced(net(posed.transforms, posed.shape, worn.code))
    guess = worn.bound.place(moved, posed.transforms, posed.shape)
    settings = Projecting(steps=teaching.steps, offset=teaching.offset)
    steps = Projective(wardrobe.cloths[k], worn.bound.weights, wardrobe.held[k].numpy(), settings)
    x = steps(guess, posed)
    normal, gap = steps.planes(x, posed)
    change = worn.bound.unposed(x - guess, posed.transforms).clamp(-OUTLIER, OUTLIER)
    nodes = worn.sampling.shape[1] // 2
    reads = torch.cat(
        [torch.from_numpy(worn.sampling[:, side * nodes :][:, :nodes] @ basis.numpy()) for side in (0, 1)], 1
    )
    weigh, metric = _metric(reads, garment.mesh.vertices, garment.mesh.faces)
    states = net.states(posed.transforms, posed.shape, worn.code)
    return Dressed(
        torch.cat([states, states.new_ones(len(states), 1)], 1),
        reads,
        metric,
        weigh,
        moved + change,
        worn.bound.unposed(normal, posed.transforms),
        gap,
    )


def _metric(reads: Tensor, x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """reads' A' A, and that times reads."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values.unique(dim=0)
    length = (x[ends[:, 0]] - x[ends[:, 1]]).norm(dim=1).clamp_min(1e-9)
    apart = (reads[ends[:, 0]] - reads[ends[:, 1]]) / (length.square() * len(ends))[:, None]
    weigh = reads / (PLACE**2 * len(x))
    weigh = weigh.index_add(0, ends[:, 0], apart).index_add(0, ends[:, 1], -apart)
    return weigh.T, weigh.T @ reads


def _fitted(start: Tensor, dressed: list[Dressed], teaching: IspTeaching) -> Tensor:
    """The map (W + 1, 2 M 3) of least misfit, pushed out of the body."""
    states = torch.cat([d.states for d in dressed]).double()
    root = torch.linalg.cholesky(states.T @ states / len(states) + 1e-7 * torch.eye(states.shape[1]))
    white = torch.linalg.inv(root).T.float()  # of whitened states all directions count alike
    for d in dressed:
        d.states = d.states @ white
    first = torch.linalg.solve(white, start)
    level = teaching.ridge * float(_mean_metric(dressed).diagonal().mean()) * len(dressed) * teaching.bodies

    def slope(c: Tensor) -> Tensor:
        out = level * c
        for d in dressed:
            out += d.states.T @ _times(d.metric, d.states @ c)
        return out

    def wanted() -> Tensor:
        return level * first + sum(d.states.T @ _times(d.weigh, d.moved.flatten(1)) for d in dressed)

    c, rounds = first.clone(), teaching.rounds
    for push in track(range(teaching.pushes + 1), "fit"):
        if push:
            for d in dressed:
                _pushed(d, c, teaching)
        c = _descended(slope, wanted(), c, rounds)
        rounds = teaching.rounds // 3
    for d in dressed:
        d.states = torch.linalg.solve(white, d.states, left=False)
    return white @ c


def _times(matrix: Tensor, rows: Tensor) -> Tensor:
    """matrix (O, I) on rows (B, I 3) of I triples -> (B, O 3)."""
    columns = rows.unflatten(1, (-1, 3)).permute(1, 0, 2).flatten(1)
    return (matrix @ columns).unflatten(1, (-1, 3)).permute(1, 0, 2).flatten(1)


def _pushed(d: Dressed, c: Tensor, teaching: IspTeaching) -> None:
    """Move what is wanted of vertices that the map leaves beneath the margin out by what they lack."""
    found = _times(d.reads, d.states @ c).unflatten(1, (-1, 3))
    lack = (teaching.margin - d.gap - (d.normal * (found - d.moved)).sum(-1)).clamp(0, DEEPEST)
    d.moved = d.moved + lack[..., None] * d.normal
    d.gap = d.gap + lack * d.normal.square().sum(-1)


def _descended(slope, wanted: Tensor, c: Tensor, rounds: int) -> Tensor:
    """Conjugate gradients for slope(c) = wanted from c."""
    rest = wanted - slope(c)
    way, size = rest.clone(), rest.square().sum()
    for _ in range(rounds):
        bent = slope(way)
        step = size / (way * bent).sum()
        c = c + step * way
        rest = rest - step * bent
        way, size = rest + way * (rest.square().sum() / size), rest.square().sum()
    return c
