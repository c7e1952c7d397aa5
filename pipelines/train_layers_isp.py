"""Train ISP's layering network D_m: ``recon train layers-isp --motions FOLDER``.

Self-supervised (ISP Eq. 10): pairs of garments, each draped alone by D_s on a random body; the outer one is moved so
that it keeps off the inner one and yet its own energies stay low. One network serves all kinds of garments.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from pipelines.drape_garments import Wardrobe, garments_of
from pipelines.drape_training import CLIP_TERMS, HELD_OUT, BodySampler, read_motions
from pipelines.training import Budget, Training, settings_of
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearance
from recon.cloth.beneath import MARGIN, Beneath, repulsion, rim_of, vertex_normals
from recon.cloth.energies import collision
from recon.cloth.frames import FrameWeights
from recon.draping.isp import Worn, load_isp_draper
from recon.draping.layering import LayeringNet, Raster
from recon.files.weights import write_weights
from recon.garments import load_decoder
from recon.types import Mesh, PosedBody, UserError

OUTER = {"top": 0.65, "dress": 0.15, "skirt": 0.2}
"""How often each kind is the outer layer; legs of trousers have nowhere to go from beneath a tunic."""
INNER = {"top": 0.35, "trousers": 0.15, "skirt": 0.1, "dress": 0.1, "body": 0.3}
"""How often each is what lies beneath."""
USUAL = 0.3
"""Energies [J] above this count by their logarithm: a pair that nobody would wear must not outweigh the rest."""
STEEP = 0.01
"""Depth [m] beneath the inner layer from which on Eq. 10's penalty grows no faster."""


@dataclass(frozen=True)
class TrainLayersIsp:
    """Settings of one training."""

    motions: Path
    """Folder of motion clips (npz or bvh)."""
    holdout: tuple[str, ...] = HELD_OUT
    """Clips not learned from, by their files' stems."""
    weights: Path | None = None
    """Folder with the draping networks drape-isp-KIND; None takes the shipped ones."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 10.0
    """Training time [minutes]."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of garments, initialisation and sampling."""
    threads: int = 1
    """CPU threads."""
    garments: int = 16
    """Garments of each kind to learn on."""
    vertices: int = 1500
    """About so many vertices has each."""
    bodies: int = 4
    """Bodies per step."""
    pairs: int = 2
    """Pairs of garments per step, each on all of its bodies."""
    lift: float = 0.015
    """Every other inner layer is blown up by up to so much [m]: as if there were more layers beneath it."""
    rate: float = 2e-3
    """Adam's learning rate at the start; decays along a cosine."""
    apart: float = 1e5
    """lambda_g of Eq. 10: stiffness of contact with the inner layer [J/m³ per vertex]."""
    small: float = 10.0
    """lambda_r of Eq. 10: what displacements beyond the forces cost [J/m² per vertex]."""
    collision: float = 2e4
    """Stiffness of contact with the body [J/m³ per vertex]."""


def train_layers_isp(config: TrainLayersIsp) -> Path:
    """Train and write ``layers-isp`` with its card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no draping network to drape the garments with, no motions.
    """
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    net = LayeringNet()
    adam = torch.optim.Adam(net.parameters(), config.rate, fused=True)
    training = Training("layers-isp", net, adam, settings_of(config), config.out)
    training.resume()
    generator = torch.Generator().manual_seed(config.seed + training.step)
    loss = Loss(config, load_body())
    training.run(Budget(config.minutes, config.steps), lambda share: loss(net, generator))
    return store(net, config, training)


class Loss:
    """ISP Eq. 10 on random pairs of garments and bodies."""

    def __init__(self, config: TrainLayersIsp, body: Body):
        """Decodes, binds and rasters the garments: half a minute."""
        self.config, self.body = config, body
        motions = read_motions(config.motions, config.holdout, body, 30.0, config.out)
        clearance = Clearance(body, body.neutral().shape)
        self.sampler = BodySampler(motions, body.n_shape, clearance=clearance)
        self.draper = load_isp_draper(body, config.weights)
        if not self.draper.nets:
            raise UserError(
                "train layers-isp: found no draping networks; wanted drape-isp-KIND (recon train drape-isp)"
            )
        generator = torch.Generator().manual_seed(config.seed)
        garments = []
        for kind in self.draper.nets:
            decoder = load_decoder(kind)
            garments += garments_of(decoder, config.garments, config.vertices, generator)
        weights = FrameWeights(collision=config.collision, inextensibility=0.0, margin=0.004, deep_share=3)
        self.wardrobe = Wardrobe.of(garments, body, weights, config.bodies)
        self.worn = [Worn.of(g, self.draper.nets[g.kind], self.draper.skinning) for g in garments]
        self.rasters = [Raster.of(g) for g in garments]
        self.rims = [rim_of(g.mesh.faces, len(g.mesh.vertices)) for g in garments]
        self.closed = torch.zeros(len(body.rest(body.neutral().shape).vertices[0]), dtype=torch.bool)
        self.of_kind = {kind: [k for k, g in enumerate(garments) if g.kind == kind] for kind in self.draper.nets}

    def __call__(self, net: LayeringNet, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one random batch, and its terms per drape."""
        c = self.config
        with torch.no_grad():
            body = self.body.pose(self.sampler(c.bodies, generator))
        self.wardrobe.physics[0].pose(body.mesh.vertices)
        skin = Beneath.all_of(body.mesh, self.closed)
        total, shown = torch.zeros(()), dict[str, float]()
        for _ in range(c.pairs):
            loss, terms = self._pair(net, body, skin, generator)
            total = total + loss / c.pairs
            for name, value in terms.items():
                shown[name] = shown.get(name, 0.0) + value / c.pairs
        return total, {"loss": total.item(), **shown}

    def _pair(
        self, net: LayeringNet, body: PosedBody, skin: list[Beneath], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        c = self.config
        k = self._choose(OUTER, generator)
        faces = self.wardrobe.garments[k].mesh.faces
        with torch.no_grad():
            x = self._drape(k, body)
            if torch.rand((), generator=generator) < 0.3:  # in a stack, layers have been moved before
                first = self._beneath(body, skin, generator)
                x = net.displaced(self.rasters[k], x, repulsion(x, faces, first))[0]
            inner = self._beneath(body, skin, generator)
            force = repulsion(x, faces, inner)
        moved, own = net.displaced(self.rasters[k], x, force)
        energy, terms = self.wardrobe.physics[k](moved)
        normals = vertex_normals(moved.detach(), faces)
        lack = torch.stack([b.lack(p, n)[0] for b, p, n in zip(inner, moved, normals, strict=True)])
        apart = collision(lack, c.apart, STEEP)
        cost = energy + apart + c.small * own.square().sum((1, 2))
        level = terms["strain"] + terms["collision"] + apart.detach() + USUAL
        loss = (cost / level.to(cost)).mean()
        shown = {name: float(v.mean()) for name, v in terms.items() if name in ("strain", "bending", "collision")}
        beneath = 100 * float((lack.detach() > MARGIN).float().mean())
        return loss, {**shown, "apart": float(apart.detach().mean()), "beneath_pct": beneath}

    def _choose(self, share: dict[str, float], generator: torch.Generator) -> int:
        """The number of a random garment, -1 for the body."""
        kinds = [kind for kind in share if kind in self.of_kind or kind == "body"]
        kind = kinds[int(torch.multinomial(torch.tensor([share[k] for k in kinds]), 1, generator=generator))]
        if kind == "body":
            return -1
        mine = self.of_kind[kind]
        return mine[int(torch.randint(len(mine), (), generator=generator))]

    def _drape(self, k: int, body: PosedBody) -> Tensor:
        worn, net = self.worn[k], self.draper.nets[self.wardrobe.garments[k].kind]
        return worn.placed(worn.displaced(net(body.transforms, body.shape, worn.code)), body)

    def _beneath(self, body: PosedBody, skin: list[Beneath], generator: torch.Generator) -> list[Beneath]:
        """A random layer, every other one blown up."""
        k = self._choose(INNER, generator)
        if k < 0:
            return skin
        layer = Mesh(self._drape(k, body), self.wardrobe.garments[k].mesh.faces)
        if torch.rand((), generator=generator) < 0.5:
            lift = self.config.lift * float(torch.rand((), generator=generator))
            layer = layer.with_vertices(layer.vertices + lift * vertex_normals(layer.vertices, layer.faces))
        return Beneath.all_of(layer, self.rims[k])


def store(net: LayeringNet, config: TrainLayersIsp, done: Training) -> Path:
    """Write the weights with their card."""
    card = {
        "what": "ISP's layering network D_m, for any kinds of garments",
        "shape": asdict(net.shape),
        "data": f"pairs of {config.garments} garments of each kind's decoder, draped by drape-isp; motion clips of "
        f"{config.motions.name} and their mirror images (held out: {', '.join(config.holdout)}), random poses",
        **done.card(config),
        "licence": CLIP_TERMS,
    }
    return write_weights("layers-isp", dict(net.state_dict()), card, config.out)
