"""Train DrapeNet's draping networks: ``recon train drape-drapenet --part field|top|bottom|solver --motions FOLDER``.

The field is learned from the body alone, the others from physics alone (DrapeNet Eq. 7, 8, 10): random garments on
random bodies in random poses. The parts share one weights file; each goes on from what the folder holds of the others,
in the order field, top and bottom, solver.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.drape_garments import Wardrobe, garments_of
from pipelines.drape_training import CLIP_TERMS, HELD_OUT, BodySampler, Sampling, read_motions
from pipelines.training import Budget, Training, settings_of
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearance
from recon.cloth.frames import FrameWeights
from recon.draping.binding import JOINTS, METHODS, BodyField
from recon.draping.drapenet import GROUPS, DrapeNets, DrapeShape, Prepared, under_top
from recon.draping.skinning import SkinningDraper
from recon.files.weights import read_manifest, read_weights, write_weights
from recon.garments import load_decoder
from recon.types import Garment, Mesh, PosedBody, UserError

PARTS = ("field", "top", "bottom", "solver")
COVERED = 0.08
"""A body point further than this from a garment at rest is not covered by it [m]."""
OVER = 0.7
"""Nor is one that has the garment beside it: cosine between the way there and its normal."""


@dataclass(frozen=True)
class TrainDrapenet:
    """Settings of one training."""

    part: str
    """field, top, bottom or solver."""
    motions: Path
    """Folder of motion clips (npz or bvh)."""
    holdout: tuple[str, ...] = HELD_OUT
    """Clips not learned from, by their files' stems."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 8.0
    """Training time [minutes]."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of garments, initialisation and sampling."""
    threads: int = 1
    """CPU threads."""
    garments: int = 60
    """Garments to learn on, of the shipped decoders: half learned codes, half between them."""
    vertices: int = 1200
    """About so many vertices has each."""
    bodies: int = 8
    """Bodies per step."""
    worn: int = 2
    """Garments per step (pairs, for the solver), each on all of its bodies."""
    skinning: str = "settled"
    """Where W and dx come from: settled or field (see ``DrapeShape``); the field part says it for all."""
    points: int = 60_000
    """Points around the body that the field is learned from."""
    shape_spread: float = 1.0
    """Standard deviation of the shape coefficients of training bodies, cut at two; the population's is 1."""
    rate: float = 1.5e-3
    """Adam's learning rate at the start; decays along a cosine."""
    collision: float = 2e4
    """Stiffness of contact with the body [J/m³ per vertex]."""
    margin: float = 0.005
    """Distance from the body at which contact begins [m]."""
    pin: float = 50.0
    """Weight of L_pin [J/m² per vertex]."""
    pin_side: float = 0.1
    """lambda of Eq. 8: share of it that sideways displacements pay."""
    layer: float = 200.0
    """Weight of L_layer [J per metre of its mean over the covered body points]."""
    gamma: float = 0.8
    """gamma of Eq. 11."""


def train_drapenet(config: TrainDrapenet) -> Path:
    """Train one part and write the weights with their card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no such part, no motions, or parts that this one needs are not learned yet.
    """
    torch.set_num_threads(config.threads)
    if config.part not in PARTS:
        raise UserError(f"--part: found {config.part!r}; wanted one of {', '.join(PARTS)}")
    body = load_body()
    nets, card = begun(config, body)
    loss = FieldLoss(config, body, nets) if config.part == "field" else DrapeLoss(config, body, nets)
    learner = {"field": nets.field, "solver": nets.solver}.get(config.part) or nets.drape[config.part]
    adam = torch.optim.Adam(learner.parameters(), config.rate, fused=True)
    training = Training(f"drapenet-{config.part}", learner, adam, settings_of(config), config.out)
    training.resume()
    generator = torch.Generator().manual_seed(config.seed + training.step)
    training.run(Budget(config.minutes, config.steps), lambda share: loss(generator))
    return store(nets, card, config, training)


def begun(config: TrainDrapenet, body: Body) -> tuple[DrapeNets, dict]:
    """The networks with the parts that the folder holds, and their card; codes are known once the field is learned."""
    torch.manual_seed(config.seed)
    if "drapenet" not in read_manifest(config.out):
        if config.part != "field":
            raise UserError(f"{config.out}: holds no drapenet; wanted --part field to be learned first")
        shape = DrapeShape(body.n_shape, skinning=config.skinning)
        nets = DrapeNets(shape)
        garments = [g for kinds in GROUPS.values() for g in coarse(kinds, config, config.garments)]
        nets.code.know([g.mesh for g in garments], torch.Generator().manual_seed(config.seed))
        return nets, {"shape": asdict(shape), "body": body.name, "parts": {}}
    weights = read_weights("drapenet", config.out)
    nets = DrapeNets(DrapeShape(**weights.card["shape"]))
    nets.load_state_dict(weights.tensors)
    missing = [p for p in ("top", "bottom") if config.part == "solver" and p not in weights.card["parts"]]
    if missing:
        raise UserError(f"{config.out}: --part solver needs {' and '.join(missing)} to be learned first")
    return nets, weights.card


def coarse(kinds: tuple[str, ...], config: TrainDrapenet, count: int) -> list[Garment]:
    """``count`` garments of several kinds' shipped decoders, equally many of each."""
    out, generator = [], torch.Generator().manual_seed(config.seed)
    for kind in kinds:
        decoder = load_decoder(kind)
        out += garments_of(decoder, count // len(kinds), config.vertices, generator)
    return out


class FieldLoss:
    """The body's own features at points around it: skinning weights and shape directions spread by GAPS' kernel."""

    def __init__(self, config: TrainDrapenet, body: Body, nets: DrapeNets):
        self.net = nets.field
        field = BodyField.of(body)
        generator = torch.Generator().manual_seed(config.seed)
        at = torch.randint(len(field.vertices), (config.points,), generator=generator)
        reach = 0.25 * torch.rand(config.points, 1, generator=generator) ** 2
        away = torch.nn.functional.normalize(torch.randn(config.points, 3, generator=generator), dim=1)
        # Vertices crowd on head and hands: half of the points come from where garments are.
        some = min(16, config.garments)
        worn = torch.cat([g.mesh.vertices for kinds in GROUPS.values() for g in coarse(kinds, config, some)])
        near = worn[torch.randint(len(worn), (config.points,), generator=generator)]
        half = (torch.arange(config.points) % 2 == 0)[:, None]
        self.x = torch.where(half, near, field.vertices[at]) + torch.where(half, 0.3, 1.0) * reach * away
        features = METHODS["gaps"](field, self.x, None)
        self.weights = features[:, :JOINTS] / features[:, :JOINTS].sum(1, keepdim=True)
        self.directions = features[:, JOINTS:].unflatten(1, (3, -1))

    def __call__(self, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of 2048 points; shown: mean sum of absolute errors of the weights, and of directions [mm]."""
        some = torch.randint(len(self.x), (2048,), generator=generator)
        weights, directions = self.net(self.x[some])
        off, away = weights - self.weights[some], directions - self.directions[some]
        loss = 20 * off.square().sum(1).mean() + (away / 0.01).square().mean()
        shown = {
            "weights": float(off.detach().abs().sum(1).mean()),
            "mm": 1e3 * float(away.detach().norm(dim=1).mean()),
        }
        return loss, {"loss": loss.item(), **shown}


class DrapeLoss:
    """Eq. 7 for tops, Eq. 8 for bottoms, Eq. 10 for the solver, on random garments and bodies."""

    def __init__(self, config: TrainDrapenet, body: Body, nets: DrapeNets):
        """Decodes the garments and makes them ready: some seconds each."""
        self.config, self.body, self.nets = config, body, nets
        motions = read_motions(config.motions, config.holdout, body, 30.0)
        clearance = Clearance(body, body.neutral().shape)
        self.sampler = BodySampler(motions, body.n_shape, Sampling(shape_spread=config.shape_spread), clearance)
        self.group = "bottom" if config.part == "solver" else config.part
        weights = FrameWeights(collision=config.collision, margin=config.margin, inextensibility=0.0, deep_share=3)
        garments = coarse(GROUPS[self.group], config, config.garments)
        self.wardrobe = Wardrobe.of(garments, body, weights, config.bodies)
        with torch.no_grad():
            skinning = SkinningDraper(body)
            self.ready = [nets.prepare(g.mesh, self.group, nets.bound(g.mesh, skinning)) for g in garments]
            self.held = [trunk(g, body) if self.group == "bottom" else None for g in garments]
            self.tops = []
            if config.part == "solver":
                tops = coarse(GROUPS["top"][:1], config, config.garments // 2)
                self.tops = [(g, nets.prepare(g.mesh, "top", nets.bound(g.mesh, skinning))) for g in tops]

    def __call__(self, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one random batch, and its terms per drape [J]."""
        c, shown = self.config, dict[str, float]()
        with torch.no_grad():
            body = self.body.pose(self.sampler(c.bodies, generator))
        self.wardrobe.physics[0].pose(body.mesh.vertices)
        total = torch.zeros(())
        for k in torch.randperm(len(self.ready), generator=generator)[: c.worn].tolist():
            ready, above = self.ready[k], None
            if self.tops:
                garment, above = self.tops[int(torch.randint(len(self.tops), (), generator=generator))]
            moved = self._moved(ready, above, body)
            x = ready.place(moved, body)
            energy, terms = self.wardrobe.physics[k](x)
            loss = energy.mean()
            if self.held[k] is not None:
                loss = loss + c.pin * pinned(moved[:, self.held[k]], c.pin_side).mean()
            if above is not None:
                crossing = self._layer(k, x, garment, above, body)
                loss, shown["layer"] = loss + c.layer * crossing, 1e3 * float(crossing.detach())
            total = total + loss / c.worn
            for name, value in terms.items():
                shown[name] = shown.get(name, 0.0) + float(value.mean()) / c.worn
        return total, {"loss": total.item(), **shown}

    def _moved(self, ready: Prepared, above: Prepared | None, body: PosedBody) -> Tensor:
        """(B, N, 3): the part that learns anew, the others as they were made ready."""
        if above is None:
            net = self.nets.displacements(self.group)
            return net(net.matrix(ready.rest, ready.code), body)
        with torch.no_grad():
            fixed = self.nets.displacements("bottom")(ready.matrix, body)
        solver = self.nets.solver
        return fixed + solver(solver.matrix(ready.rest, torch.cat([above.code, ready.code])), body)

    def _layer(self, k: int, x: Tensor, garment: Garment, above: Prepared, body: PosedBody) -> Tensor:
        """() mean of Eq. 11 over bodies and covered points [m]."""
        with torch.no_grad():
            top = above.place(self.nets.displacements("top")(above.matrix, body), body)
        covered = Covered.of(self.body, garment.mesh, self.wardrobe.garments[k].mesh)
        points = body.mesh.vertices[:, covered.points]
        lower, upper = nearest(points, x, covered.bottom), nearest(points, top, covered.top)
        return (under_top(lower, upper, self.config.gamma) / max(len(covered.points), 1)).mean()


def pinned(moved: Tensor, side: float) -> Tensor:
    """L_pin of Eq. 8: displacements (B, V, 3) -> (B,); mostly the vertical ones pay."""
    return (moved.square() * moved.new_tensor([side, 1.0, side])).sum((1, 2))


def trunk(garment: Garment, body: Body) -> Tensor:
    """(V,) vertices whose closest body vertex belongs to the trunk (§7.2)."""
    rest = body.rest(body.neutral().shape).vertices[0]
    nearest_vertex = cKDTree(rest.numpy()).query(garment.mesh.vertices.detach().numpy())[1]
    return body.region_mask("torso")[torch.as_tensor(nearest_vertex)].nonzero().flatten()


@dataclass(frozen=True)
class Covered:
    """Body points under both garments (C of Eq. 11), and the garments' vertices over them at rest."""

    points: Tensor
    """(C,) body vertices."""
    top: Tensor
    """(C, K) vertices of the top."""
    bottom: Tensor
    """(C, K) vertices of the bottom."""

    @classmethod
    def of(cls, body: Body, top: Mesh, bottom: Mesh, neighbours: int = 8) -> Covered:
        """From both garments at rest on the neutral body."""
        rest = body.rest(body.neutral().shape).vertices[0]
        tried = body.region_mask("torso", "legs").nonzero().flatten()
        normal = _normals(rest, body.faces)[tried]
        over, chosen = [], torch.ones(len(tried), dtype=torch.bool)
        for mesh in (top, bottom):
            x = mesh.vertices.detach()
            distance, index = cKDTree(x.numpy()).query(rest[tried].numpy(), k=neighbours)
            at = torch.as_tensor(index)
            away = torch.nn.functional.normalize(x[at[:, 0]] - rest[tried], dim=1)
            chosen &= (torch.as_tensor(distance[:, 0]) < COVERED) & ((away * normal).sum(1) > OVER)
            over.append(at)
        return cls(tried[chosen], over[0][chosen], over[1][chosen])


def _normals(x: Tensor, faces: Tensor) -> Tensor:
    a, b, c = x[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0)
    return torch.nn.functional.normalize(torch.zeros_like(x).index_add(0, faces.reshape(-1), normal), dim=1)


def nearest(points: Tensor, x: Tensor, over: Tensor) -> Tensor:
    """(B, C) distance of points (B, C, 3) to the nearest of their vertices x[over], over (C, K) [m]."""
    return (x[:, over] - points[:, :, None]).square().sum(-1).amin(-1).clamp_min(1e-12).sqrt()


def store(nets: DrapeNets, card: dict, config: TrainDrapenet, done: Training) -> Path:
    """Write ``drapenet`` with its card; a part learned anew replaces its entry."""
    data = f"{config.garments} garments of the shipped decoders; motion clips of {config.motions.name} and their "
    data += f"mirror images (held out: {', '.join(config.holdout)}), random poses within the joints' limits"
    part = {
        "data": "the body's own weights and shape directions" if config.part == "field" else data,
        **done.card(config),
    }
    entry = {
        "what": "DrapeNet's draping networks: skinning field, displacements of tops and bottoms, intersection solver",
        "shape": card["shape"],
        "body": card["body"],
        "licence": CLIP_TERMS,
        "parts": {**card["parts"], config.part: part},
    }
    return write_weights("drapenet", dict(nets.state_dict()), entry, config.out, exact=("code.points",))
