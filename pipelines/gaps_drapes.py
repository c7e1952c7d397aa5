"""Drapes to learn GAPS from: a network's own, after projective steps, on windows of motion.

Physics alone costs a search and all energies for every frame of every step. Here each frame is draped once (a network's
guess, then ``recon.cloth.projective``), and learned from many times: towards the drape, towards the template's lengths,
and out of the planes of the body that the steps found beside each vertex. The network begins as the linear map from the
first network's states that suits the drapes best; what the last layer mixes are the drapes' principal components where
edges count more than places.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from rich.progress import track
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from pipelines.drape_training import ARMS
from recon.bodies import Body
from recon.cloth.energies import Cloth
from recon.cloth.projective import Projecting, Projective
from recon.draping.dress import held_vertices
from recon.draping.gaps import Bound, GapsDraper, GapsNet, GapsShape, motion_features
from recon.types import BodyPose, Mesh, Motion, UserError

CHUNK = 25
"""Windows draped between two times that they are kept."""
OUTLIER = 0.03
"""What a linear map misses by more than this counts as this much [m]."""
PLACE = 0.05
"""Displacement that counts as much as a doubled edge [m]."""


@dataclass(frozen=True)
class Teaching:
    """How drapes are made and learned from."""

    frames: int = 60
    """Frames of a window."""
    burn_in: int = 24
    """Frames of it that are not draped: they bring the hidden state where it is in the midst of a motion."""
    every: int = 3
    """Frames from one that is draped to the next."""
    swap: float = 0.3
    """Share of windows whose arms move as in another clip."""
    spread: float = 0.9
    """Deviation of the shape coefficients, times a random factor up to one: neutral bodies are frequent, too."""
    steps: int = 8
    """Projective steps."""
    offset: float = 0.004
    """Distance from the body that vertices are brought to [m]."""
    rank: int = 96
    """Drapes that the last layer mixes."""
    windows: int = 16
    """Windows of one step of learning."""
    drapes: int = 3
    """Drapes of each window that count in that step."""
    rate: float = 5e-4
    """Adam's learning rate at the start."""
    likeness: float = 0.3
    """Weight of being like the drape, against that of lengths."""
    contact: float = 1.0
    """Weight of staying out of the body: of the mean square of what lacks to ``margin``, in units of 3 mm."""
    margin: float = 0.004
    """Distance from the body at which contact begins [m]."""


@dataclass(frozen=True)
class Drapes:
    """N windows of T frames, R of them draped."""

    features: Tensor
    """(N, T, FEATURES)."""
    shape: Tensor
    """(N, S)."""
    pose: Tensor
    """(N, R, 24, 3) of the draped frames [rad]."""
    place: Tensor
    """(N, R, 3) [m]."""
    moved: Tensor
    """(N, R, V, 3) displacements in the unposed space [m]."""
    normal: Tensor
    """(N, R, V, 3) of the body beside each vertex, zero where there is none."""
    gap: Tensor
    """(N, R, V) distance of each vertex from that plane [m]."""

    @staticmethod
    def rows(teaching: Teaching) -> Tensor:
        """(R,) which frames of a window are draped."""
        return torch.arange(teaching.burn_in, teaching.frames, teaching.every)


def drapes(
    draper: GapsDraper, motions: Sequence[Motion], body: Body, count: int, teaching: Teaching, kept: Path
) -> Drapes:
    """``count`` windows draped; ``kept``: files named so and a number hold what is done: a killed run goes on.

    Raises:
        UserError: what is kept is of other settings.
    """
    rest = draper.garment if isinstance(draper.garment, Mesh) else draper.garment.mesh
    settings = Projecting(steps=teaching.steps, offset=teaching.offset)
    steps = Projective(Cloth.from_mesh(rest), draper.bound.weights, held_vertices(draper.garment), settings)
    told = json.dumps(
        {"teaching": str(teaching), "frames": sum(len(m.pose) for m in motions), "rest": len(rest.vertices)}
    )
    chunks = []
    for first in track(range(0, count, CHUNK), "drapes"):
        file = kept.with_name(f"{kept.name}-{first:05d}.safetensors")
        if not file.is_file():
            generator = torch.Generator().manual_seed(first)
            many = [
                _window(draper, steps, motions, body, teaching, generator) for _ in range(min(CHUNK, count - first))
            ]
            kept.parent.mkdir(parents=True, exist_ok=True)
            whole = {f.name: torch.stack([w[f.name] for w in many]).contiguous() for f in fields(Drapes)}
            save_file(whole, file.with_suffix(".tmp"), {"made": told})
            file.with_suffix(".tmp").replace(file)
        with safe_open(file, "pt") as data:
            if data.metadata().get("made") != told:
                raise UserError(f"{file}: drapes of other settings; delete them to make new ones")
            chunks.append({f.name: data.get_tensor(f.name) for f in fields(Drapes)})
    return Drapes(**{f.name: torch.cat([c[f.name] for c in chunks]) for f in fields(Drapes)})


@torch.no_grad()
def _window(
    draper: GapsDraper,
    steps: Projective,
    motions: Sequence[Motion],
    body: Body,
    teaching: Teaching,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """One window, as the fields of ``Drapes``."""
    (pose, place), (arms, _) = (_stretch(motions, teaching, generator) for _ in range(2))
    if torch.rand((), generator=generator) < teaching.swap:
        pose = torch.where(ARMS[:, None], arms, pose)
    factor = teaching.spread * torch.rand((), generator=generator)
    shape = factor * torch.randn(1, body.n_shape, generator=generator).clamp(-2, 2)
    features = motion_features(pose[None, 1:], place[None, 1:], motions[0].fps, (pose[None, 0], place[None, 0]))
    rows = Drapes.rows(teaching)
    pose, place = pose[1:][rows], place[1:][rows]
    moved = draper.net(features, shape)[0][0, rows]
    posed = body.pose(BodyPose(shape.expand(len(rows), -1), pose, place))
    guess = draper.bound.place(moved, posed.transforms, posed.shape)
    x = steps(guess, posed)
    normal, gap = steps.planes(x, posed)
    moved = moved + draper.bound.unposed(x - guess, posed.transforms)
    half = {"moved": moved.half(), "normal": normal.half(), "gap": gap.half()}
    return {"features": features[0], "shape": shape[0], "pose": pose, "place": place, **half}


def _stretch(motions: Sequence[Motion], teaching: Teaching, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A random stretch of motion and the frame before it: pose (T + 1, 24, 3), translation (T + 1, 3)."""
    lengths = torch.tensor([len(m.pose) for m in motions])
    motion = motions[int(torch.multinomial(lengths.float(), 1, generator=generator))]
    last = int(torch.randint(teaching.burn_in, len(motion.pose) + teaching.frames // 2, (), generator=generator))
    rows = torch.arange(last - teaching.frames, last + 1).clamp(0, len(motion.pose) - 1)  # people stand still beyond
    return motion.pose[rows], motion.translation[rows]


class Edges:
    """The edges of a template."""

    def __init__(self, rest: Mesh):
        ends = torch.cat([rest.faces[:, [0, 1]], rest.faces[:, [1, 2]], rest.faces[:, [2, 0]]])
        self.first, self.last = ends.sort(1).values.unique(dim=0).T.contiguous()
        self.length = self(rest.vertices.detach()[None])[0].norm(dim=-1).clamp_min(1e-9)

    def __call__(self, x: Tensor) -> Tensor:
        """Vertices (B, V, 3) -> edges (B, E, 3)."""
        return x.index_select(1, self.first) - x.index_select(1, self.last)

    def metric(self, moved: Tensor) -> Tensor:
        """Displacements (B, V, 3) -> (B, 3 E + 3 V), whose squares add up: of edges by their lengths, of places."""
        edges = self(moved) / self.length[:, None] / len(self.length) ** 0.5
        return torch.cat([edges, moved / (PLACE * moved.shape[1] ** 0.5)], 1).flatten(1)


@torch.no_grad()
def pupil(teacher: GapsNet, known: Drapes, edges: Edges, teaching: Teaching, seed: int) -> GapsNet:
    """A network with the teacher's GRU whose last layers are fitted to the drapes; those modes are not learned on."""
    rows, chosen = Drapes.rows(teaching), torch.Generator().manual_seed(seed)
    states = [teacher.remember(f, s)[0][:, rows] for f, s in zip(known.features.split(64), known.shape.split(64))]
    found = torch.cat(states).flatten(0, 1).double()
    found = torch.cat([found, found.new_ones(len(found), 1)], 1)
    wanted, scale = known.moved.flatten(0, 1).flatten(1), teacher.shape.scale
    inputs = torch.cat([torch.eye(teacher.shape.width), torch.zeros(1, teacher.shape.width)])
    linear = teacher.displaced(inputs[None])[0].flatten(1)
    linear[:-1] -= linear[-1]
    normal = found.T @ found + 1e-5 * len(found) * torch.eye(found.shape[1], dtype=torch.float64)
    for _ in range(2):
        pull = torch.zeros(linear.shape, dtype=torch.float64)
        for a, y in zip(found.split(500), wanted.split(500)):
            pull += a.T @ (y.float() - a.float() @ linear).clamp(-OUTLIER, OUTLIER).double()
        linear = linear + torch.linalg.solve(normal, pull).float()
    some = torch.randperm(len(found), generator=chosen)[:1500]
    guess = found[some].float() @ linear
    drape = guess + (wanted[some].float() - guess).clamp(-OUTLIER, OUTLIER)
    mean = drape.mean(0)
    lifted = edges.metric((drape - mean).unflatten(1, (-1, 3)))
    values, vectors = torch.linalg.eigh((lifted @ lifted.T).double())
    values, vectors = values.flip(0)[: teaching.rank], vectors.flip(1)[:, : teaching.rank]
    modes = (vectors / values.clamp_min(1e-12).sqrt()).T.float() @ (drape - mean)
    known_modes = edges.metric(modes.unflatten(1, (-1, 3)))
    few = torch.cat([edges.metric(w.unflatten(1, (-1, 3))) @ known_modes.T for w in linear[:-1].split(32)])
    offset = edges.metric((linear[-1:] - mean).unflatten(1, (-1, 3))) @ known_modes.T
    net = GapsNet(GapsShape(**{**vars(teacher.shape), "rank": len(modes)}))
    net.gru.load_state_dict(teacher.gru.state_dict())
    assert isinstance(net.few, torch.nn.Linear)
    net.few.weight.copy_(few.T)
    net.few.bias.copy_(offset[0])
    net.out.weight.copy_(modes.T / scale)
    net.out.bias.copy_(mean / scale)
    net.out.requires_grad_(False)
    return net


class DrapeLoss:
    """Lengths, likeness to the drapes, and contact with planes, on random windows."""

    def __init__(self, known: Drapes, edges: Edges, bound: Bound, body: Body, teaching: Teaching):
        self.known, self.edges, self.bound, self.body, self.teaching = known, edges, bound, body, teaching
        self.rows = Drapes.rows(teaching)

    def __call__(self, net: GapsNet, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one random batch, and its terms."""
        t, k = self.teaching, self.known
        some = torch.randint(len(k.shape), (min(t.windows, len(k.shape)),), generator=generator)
        drawn = torch.randperm(len(self.rows), generator=generator)[: t.drapes]
        shape = k.shape[some].repeat_interleave(len(drawn), 0)

        def taken(values: Tensor) -> Tensor:
            return values[some[:, None], drawn].flatten(0, 1).float()

        with torch.no_grad():
            transforms = self.body.skeleton(BodyPose(shape, taken(k.pose), taken(k.place)))[0]
            wanted = self.bound.place(taken(k.moved), transforms, shape)
        states = net.remember(k.features[some], k.shape[some])[0][:, self.rows[drawn]]
        x = self.bound.place(net.displaced(states).flatten(0, 1), transforms, shape)
        off, edges = x - wanted, self.edges(x)
        strain = edges.square().sum(-1).clamp_min(1e-10).sqrt() / self.edges.length - 1
        # Roots with a soft tip: what few edges do, in folds that no network foretells, must not outweigh the rest.
        lengths = (strain.square() + 4e-4).sqrt().mean()
        other = (edges - self.edges(wanted)) / self.edges.length[:, None]
        like = (other.square().sum(-1) + 2.5e-3).sqrt().mean()
        like = like + (off.square().sum(-1) + 1e-6).sqrt().mean() / PLACE
        lack = t.margin - taken(k.gap) - (off * taken(k.normal)).sum(-1)
        near = taken(k.normal).square().sum(-1) > 0.5
        contact = ((lack.clamp(0, 0.016) * near) / 0.003).square().mean()
        loss = lengths + t.likeness * like + t.contact * contact
        inside = (near & (lack > t.margin)).float().mean()
        terms = {"strain": strain.abs().mean(), "like": like, "contact": contact, "inside": inside}
        return loss, {"loss": loss.item(), **{name: float(v.detach()) for name, v in terms.items()}}
