"""Train DrapeNet's draping networks: ``recon train drape-drapenet --part field|top|bottom|solver --motions FOLDER``.

The field is learned from the body alone, the others from physics alone (DrapeNet Eq. 7, 8, 10): random garments on
random bodies in random poses. The parts share one weights file; each goes on from what the folder holds of the others,
in the order field, top and bottom, solver.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from pipelines.drape_garments import Wardrobe, garments_of
from pipelines.drape_training import CLIP_TERMS, HELD_OUT, BodySampler, Sampling, read_motions
from pipelines.drapenet_terms import Covered, nearest, outside, pinned, trunk
from pipelines.training import Budget, Training, settings_of
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearance, Clearing
from recon.cloth.frames import FrameWeights
from recon.draping.binding import JOINTS, METHODS, BodyField
from recon.draping.drapenet import GROUPS, Displacements, DrapeNets, DrapeShape, Prepared, under_top, widened
from recon.draping.ending import Ending
from recon.draping.skinning import SkinningDraper
from recon.files.weights import read_manifest, read_weights, write_weights
from recon.garments import load_decoder
from recon.garments.isp_net import halves_are_fast
from recon.types import Garment, Mesh, PosedBody, UserError

CLEAR = 0.03
"""Room between the limbs of poses to learn on, on the neutral body [m]: on bodies of other girths that leaves less."""
PARTS = ("field", "top", "bottom", "solver")


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
    terms: int = 96
    """N_B of §3.2.1; networks that learned with fewer go on with so many."""
    points: int = 60_000
    """Points around the body that the field is learned from."""
    cleared: int = 800
    """Poses to learn on, drawn once, limbs turned out of the body (a tenth of a second each); 0 = others in each step,
    as they are drawn, most of them with arms that lie partly in the trunk, where no cloth has room."""
    shape_spread: float = 1.0
    """Standard deviation of the shape coefficients of training bodies, cut at two; the population's is 1."""
    rate: float = 1.5e-3
    """Adam's learning rate at the start; decays along a cosine."""
    rounds: int = 12
    """Rounds that end a drape: half of the product's, for edges about twice as long."""
    collision: float = 2e4
    """Stiffness of contact with the body [J/m³ per vertex]."""
    usual: float = 0.2
    """Energies [J] of strain and contact above this count by their logarithm."""
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
    outside: float = 5000.0
    """Weight of how far the bottom is outside of the top that covers it [1/m of the mean over covered vertices]: Eq. 11
    sees what hangs near the body, and of a wide skirt nothing."""
    apart: float = 0.002
    """How far inside the top the bottom should be [m]."""


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
        shape = DrapeShape(body.n_shape, terms=config.terms, skinning=config.skinning)
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
    if config.terms > nets.shape.terms and config.part in GROUPS:
        nets = widened(nets, config.terms)
    return nets, {**weights.card, "shape": asdict(nets.shape)}


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
        motions = read_motions(config.motions, config.holdout, body, 30.0, config.out)
        sampling = Sampling(shape_spread=config.shape_spread, pool=config.cleared)
        clearance = Clearance(body, body.neutral().shape, Clearing(gap=CLEAR)) if config.cleared else None
        self.sampler = BodySampler(motions, body.n_shape, sampling, clearance)
        self.group = "bottom" if config.part == "solver" else config.part
        weights = FrameWeights(collision=config.collision, margin=config.margin, inextensibility=0.0, deep_share=3)
        garments = coarse(GROUPS[self.group], config, config.garments)
        self.wardrobe = Wardrobe.of(garments, body, weights, config.bodies)
        with torch.no_grad():
            skinning = SkinningDraper(body)
            self.ready = [nets.prepare(g.mesh, self.group, nets.bound(g.mesh, skinning)) for g in garments]
            self.endings = [Ending.of(g, skinning.surface, config.rounds) for g in garments]
            self.held = [trunk(g, body) if self.group == "bottom" else None for g in garments]
            self.overlap = torch.zeros(len(garments), 0)
            self.covered: dict[tuple[int, int], Covered] = {}
            self.tops = []
            if config.part == "solver":
                tops = coarse(GROUPS["top"][:1], config, config.garments // 2)
                self.tops = [(g, nets.prepare(g.mesh, "top", nets.bound(g.mesh, skinning))) for g in tops]
                hems = torch.stack([g.mesh.vertices[:, 1].min() for g in tops])
                waists = torch.stack([g.mesh.vertices[:, 1].max() for g in garments])
                self.overlap = (waists[:, None] - hems).clamp_min(0.01)  # what hardly meets has little to teach

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
                over = int(torch.multinomial(self.overlap[k], 1, generator=generator))
                above = self.tops[over][1]
            moved = self._moved(ready, above, body)
            x = self.endings[k](ready.place(moved, body), body)
            energy, terms = self.wardrobe.physics[k](x)
            if self.held[k] is not None:
                energy = energy + c.pin * pinned(moved[:, self.held[k]], c.pin_side)
            # Tight clothes on large bodies store many times the energy of others, and would be all that is learned.
            loss = (energy / (terms["strain"] + terms["collision"] + c.usual).to(energy)).mean()
            if above is not None:
                crossing, outside = self._layer(k, x, over, body)
                loss = loss + c.layer * crossing + c.outside * outside
                shown |= {"layer": 1e3 * float(crossing.detach()), "outside": 1e3 * float(outside.detach())}
            total = total + loss / c.worn
            for name, value in terms.items():
                shown[name] = shown.get(name, 0.0) + float(value.mean()) / c.worn
        return total, {"loss": total.item(), **shown}

    def _moved(self, ready: Prepared, above: Prepared | None, body: PosedBody) -> Tensor:
        """(B, N, 3): the part that learns anew, the others as they were made ready."""
        if above is None:
            return self._learned(self.nets.displacements(self.group), ready.rest, ready.code, body)
        with torch.no_grad():
            fixed = self.nets.displacements("bottom")(ready.matrix, body)
        codes = torch.cat([above.code, ready.code])
        return fixed + self._learned(self.nets.solver, ready.rest, codes, body)

    @staticmethod
    def _learned(net: Displacements, x: Tensor, code: Tensor, body: PosedBody) -> Tensor:
        """(B, N, 3), in halves where they are faster."""
        with torch.autocast(x.device.type, torch.bfloat16, enabled=halves_are_fast(x.device)):
            return net(net.matrix(x, code), body).float()

    def _layer(self, k: int, x: Tensor, over: int, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Of bottom ``k`` at x under top ``over``: () mean of Eq. 11 over bodies and covered points [m], and of
        :func:`outside`."""
        garment, above = self.tops[over]
        with torch.no_grad():
            top = above.place(self.nets.displacements("top")(above.matrix, body), body)
        if (k, over) not in self.covered:
            self.covered[k, over] = Covered.of(self.body, garment.mesh, self.wardrobe.garments[k].mesh)
        covered = self.covered[k, over]
        points = body.mesh.vertices[:, covered.points]
        lower, upper = nearest(points, x, covered.bottom), nearest(points, top, covered.top)
        crossing = under_top(lower, upper, self.config.gamma) / max(len(covered.points), 1)
        return crossing.mean(), outside(
            x, self.wardrobe.garments[k].mesh.faces, Mesh(top, garment.mesh.faces), self.config.apart
        )


def store(nets: DrapeNets, card: dict, config: TrainDrapenet, done: Training) -> Path:
    """Write ``drapenet`` with its card; a part learned anew replaces its entry."""
    data = f"{config.garments} garments of the shipped decoders; motion clips of {config.motions.name} and their "
    data += f"mirror images (held out: {', '.join(config.holdout)}), random poses within the joints' limits"
    if config.cleared:
        data += f"; {config.cleared} such poses, limbs turned out of the body"
    part = {
        "data": "the body's own weights and shape directions" if config.part == "field" else data,
        **done.card(config),
    }
    if config.part in card["parts"]:  # it went on from there
        part["before"] = {
            k: v for k, v in card["parts"][config.part].items() if k in ("steps", "minutes", "before", "begin")
        }
    entry = {
        "what": "DrapeNet's draping networks: skinning field, displacements of tops and bottoms, intersection solver",
        "shape": card["shape"],
        "body": card["body"],
        "licence": CLIP_TERMS,
        "parts": {**card["parts"], config.part: part},
    }
    return write_weights("drapenet", dict(nets.state_dict()), entry, config.out, exact=("code.points",))
