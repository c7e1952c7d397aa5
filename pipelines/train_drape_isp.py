"""Train ISP's displacement network D_s for a kind of garment: ``recon train drape-isp --kind top --motions FOLDER``.

Self-supervised by physics (ISP Eq. 8): random garments of the kind on random bodies, their drapes drawn towards rest by
strain, bending, gravity and contact with the body; no simulated drapes are needed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from pipelines.drape_garments import Wardrobe
from pipelines.drape_training import CLIP_TERMS, HELD_OUT, BodySampler, Sampling, read_motions
from pipelines.training import Budget, Training, settings_of
from recon.bodies import Body, load_body
from recon.bodies.clearance import Clearance
from recon.bodies.rig import PARENTS
from recon.cloth.frames import FrameWeights
from recon.draping.isp import DisplacementNet, DisplacementShape, Worn, load_isp_draper
from recon.draping.skinning import SkinningDraper
from recon.draping.uv import Box, rest_features
from recon.files.weights import read_manifest, write_weights
from recon.garments import KINDS
from recon.types import UserError

MOVES = 0.05
"""A joint that some vertex of some garment follows by more than this share moves the kind."""


@dataclass(frozen=True)
class TrainDrapeIsp:
    """Settings of one training."""

    kind: str
    """top, skirt, trousers or dress."""
    motions: Path
    """Folder of motion clips (npz or bvh)."""
    holdout: tuple[str, ...] = HELD_OUT
    """Clips not learned from, by their files' stems."""
    start: Path | None = None
    """Folder with weights of the same name to go on from; the sizes below are theirs then."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 12.0
    """Training time [minutes]."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of garments, initialisation and sampling."""
    threads: int = 1
    """CPU threads."""
    garments: int = 60
    """Garments to learn on, of the shipped decoder: half learned codes, half between them."""
    vertices: int = 1200
    """About so many vertices has each."""
    bodies: int = 8
    """Bodies per step."""
    worn: int = 2
    """Garments per step, each on all of its bodies."""
    shape_spread: float = 1.0
    """Standard deviation of the shape coefficients of training bodies, cut at two; the population's is 1."""
    rate: float = 1e-3
    """Adam's learning rate at the start; decays along a cosine."""
    modes: int = 900
    """Cosines that each panel's displacement map is made of."""
    rank: int = 96
    """Maps that all others are sums of: what the weights' size depends on."""
    width: int = 224
    """Units of each layer."""
    depth: int = 4
    """Layers before the last."""
    rounds: int = 12
    """Rounds that end a drape: half of the product's, for edges about twice as long."""
    collision: float = 2e4
    """Stiffness of contact with the body [J/m³ per vertex]."""
    usual: float = 0.2
    """Energies [J] of strain and contact above this count by their logarithm."""
    margin: float = 0.005
    """Distance from the body at which contact begins [m]."""
    pin: float = 50.0
    """Stiffness that keeps a waistband where skinning has it, and shoulder seams near there [J/m² per vertex]."""
    slack: float = 0.08
    """So far shoulder seams are free [m]: beyond lies the floor, where a dress has least energy of all."""


def train_drape_isp(config: TrainDrapeIsp) -> Path:
    """Train and write ``drape-isp-KIND`` with its card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no such kind, no motions.
    """
    torch.set_num_threads(config.threads)
    if config.kind not in KINDS:
        raise UserError(f"--kind: found {config.kind!r}; wanted one of {', '.join(KINDS)}")
    body = load_body()
    loss = Loss(config, body)
    net = loss.net
    adam = torch.optim.Adam(net.parameters(), config.rate, fused=True)
    training = Training(f"drape-isp-{config.kind}", net, adam, settings_of(config), config.out)
    training.resume()
    generator = torch.Generator().manual_seed(config.seed + training.step)
    training.run(Budget(config.minutes, config.steps), lambda share: loss(generator))
    return store(net, config, training)


class Loss:
    """ISP Eq. 8 on random garments and bodies."""

    def __init__(self, config: TrainDrapeIsp, body: Body):
        """Decodes and binds the garments: half a minute."""
        self.config, self.body = config, body
        motions = read_motions(config.motions, config.holdout, body, 30.0, config.out)
        clearance = Clearance(body, body.neutral().shape)
        self.sampler = BodySampler(motions, body.n_shape, Sampling(shape_spread=config.shape_spread), clearance)
        weights = FrameWeights(collision=config.collision, margin=config.margin, inextensibility=0.0, deep_share=3)
        self.wardrobe = Wardrobe.decoded(
            config.kind, config.garments, config.vertices, body, weights, config.bodies, config.seed
        )
        skinning = SkinningDraper(body)
        torch.manual_seed(config.seed)
        self.net = self._made(skinning)
        self.worn = [Worn.of(g, self.net, skinning, config.rounds) for g in self.wardrobe.garments]

    def _made(self, skinning: SkinningDraper) -> DisplacementNet:
        """The network, knowing box, joints and codes of the garments."""
        c, garments = self.config, self.wardrobe.garments
        if c.start is not None:
            return load_isp_draper(self.body, c.start, [c.kind]).nets[c.kind].requires_grad_(True).train()
        followed = torch.stack([skinning.bind(g.mesh.vertices, g.mesh.faces)[0].amax(0) for g in garments]).amax(0)
        box = Box.around(torch.cat([g.panel_points for g in garments]))
        shape = DisplacementShape(
            c.kind,
            moving_joints(followed),
            self.body.n_shape,
            box,
            modes=c.modes,
            rank=c.rank,
            width=c.width,
            depth=c.depth,
        )
        net = DisplacementNet(shape)
        net.know(torch.stack([rest_features(g, box, shape.cells) for g in garments]))
        return net

    def __call__(self, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one random batch, and its terms per drape [J]."""
        c = self.config
        pose = self.sampler(c.bodies, generator)
        with torch.no_grad():
            body = self.body.pose(pose)
        self.wardrobe.physics[0].pose(body.mesh.vertices)
        total, shown = torch.zeros(()), dict[str, float]()
        for k in torch.randperm(len(self.worn), generator=generator)[: c.worn].tolist():
            worn = self.worn[k]
            moved = worn.displaced(self.net(body.transforms, body.shape, worn.code))
            x = worn.placed(moved, body)
            energy, terms = self.wardrobe.physics[k](x)
            off = moved[:, self.wardrobe.held[k]].square().sum((1, 2))
            off = off + F.relu(moved[:, self.wardrobe.hung[k]].norm(dim=2) - c.slack).square().sum(1)
            # Tight clothes on large bodies store many times the energy of others, and would be all that is learned.
            level = terms["strain"] + terms["collision"] + c.usual
            total = total + ((energy + c.pin * off) / level.to(energy)).mean() / c.worn
            for name, value in terms.items():
                shown[name] = shown.get(name, 0.0) + float(value.mean()) / c.worn
        return total, {"loss": total.item(), **shown}


def moving_joints(followed: Tensor) -> tuple[int, ...]:
    """Joints (the pelvis left out) whose weight somewhere (24,) counts, and those between them and the pelvis."""
    chosen: set[int] = set()
    for j in (followed > MOVES).nonzero().flatten().tolist():
        while j > 0:
            chosen.add(j)
            j = PARENTS[j]
    return tuple(sorted(chosen))


def store(net: DisplacementNet, config: TrainDrapeIsp, done: Training) -> Path:
    """Write the weights with their card."""
    card = {
        "what": f"ISP's displacement network D_s for any {config.kind}",
        "shape": asdict(net.shape),
        "data": f"{config.garments} garments of the decoder isp-{config.kind}; motion clips of {config.motions.name} "
        f"and their mirror images (held out: {', '.join(config.holdout)}), random poses within the joints' limits",
        **done.card(config),
        "licence": CLIP_TERMS,
    }
    if config.start is not None:
        earlier = read_manifest(config.start).get(f"drape-isp-{config.kind}", {})
        card["before"] = {key: earlier.get(key) for key in ("steps", "minutes", "settings", "before") if key in earlier}
    return write_weights(f"drape-isp-{config.kind}", dict(net.state_dict()), card, config.out)
