"""Train GAPS for one garment, self-supervised by physics: ``recon train gaps --garment top:test:7 --motions FOLDER``.

Windows of motion, random shapes: the network's drapes are pulled towards rest by strain, bending, gravity, collision,
inertia and the collision-aware inextensibility (GAPS Eq. 9-17). No simulated drapes are needed. The paper's baselines
run in the same frame: SNUG's is ``--skinning nearest --inextensibility 0 --edge-rounds 0``, NCS' ``--skinning smoothed
--inextensibility 0 --edge-rounds 0``. At the end the last layer becomes two, the first of few units
(:mod:`pipelines.low_rank`): less memory to read in each frame.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from pipelines.drape_training import ARMS, CLIP_TERMS, HELD_OUT, read_motions
from pipelines.garment_source import load_garment
from pipelines.low_rank import narrowed
from pipelines.training import Budget, Training, settings_of
from recon.bodies import Body, load_body
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, inertia, towards_template
from recon.cloth.frames import FramePhysics, FrameWeights
from recon.cloth.inextensible import OneRings
from recon.draping.binding import METHODS
from recon.draping.dress import held_vertices
from recon.draping.gaps import (
    Bound,
    GapsDraper,
    GapsNet,
    GapsShape,
    load_gaps,
    motion_features,
    smooth_basis,
    template_edges,
)
from recon.files.weights import read_manifest, write_weights
from recon.garments.panels import border_loops
from recon.types import BodyPose, Garment, Mesh, Motion, UserError

FAR = 0.1
"""Distance from the body at which an edge keeps the template's fold entirely (alpha of Eq. 12) [m]."""


@dataclass(frozen=True)
class TrainGaps:
    """Settings of one training."""

    garment: str
    """The template: KIND:NUMBER, KIND:mean, KIND:random:SEED, KIND:train:N, KIND:test:N or a mesh file."""
    motions: Path
    """Folder of motion clips (npz or bvh)."""
    name: str = "tshirt"
    """The weights will be called gaps-NAME."""
    holdout: tuple[str, ...] = HELD_OUT
    """Clips not learned from, by their files' stems."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 20.0
    """Training time [minutes]."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of initialisation and sampling."""
    threads: int = 2
    """CPU threads."""
    windows: int = 5
    """Windows of motion per step, each on a body of its own."""
    frames: int = 3
    """Frames of a window."""
    burn_in: int = 24
    """Frames before it that only bring the hidden state where it is in the midst of a motion."""
    fps: float = 30.0
    """Frames per second."""
    shape_spread: float = 0.7
    """Standard deviation of the shape coefficients of training bodies, cut at two."""
    rate: float = 2e-3
    """Adam's learning rate at the start; decays along a cosine."""
    width: int = 256
    """Units of each GRU layer."""
    layers: int = 4
    """GRU layers."""
    modes: int = 800
    """Smoothest functions on the garment that displacements are learned in."""
    edge_rounds: int = 2
    """Rounds of edge projection that end the network, and are learned through; 0 = none, as in the paper."""
    skinning: str = "rbf"
    """How the garment rides on the body: rbf, gaps, nearest, k_nearest or smoothed."""
    inextensibility: float = 1e-3
    """Strength of Eq. 15 per vertex [J]; 0 = without. Five times as much lengthens triangles instead: rings as wide as
    they are long hardly say which way."""
    relax: bool = True
    """Let the stretch factor out where cloth collides (Eq. 16); False holds it at 1."""
    collision: float = 1e4
    """k_c of Eq. 11 [J/m³ per vertex]; the paper's 250 leaves more in the body on our finer meshes."""
    margin: float = 0.003
    """Distance from the body at which collision begins [m]."""
    start: Path | None = None
    """Folder with weights of this name and garment to go on from; None begins anew."""
    rank: int = 96
    """Drapes that the last layer mixes in the end; 0 = displacements straight from all states."""
    pin: float = 20.0
    """Stiffness that keeps a waistband where skinning has it [J/m² per vertex]."""


@dataclass(frozen=True)
class Template:
    """A garment ready to be learned."""

    thing: Garment | Mesh
    mesh: Mesh
    cloth: Cloth
    """With the bending of Eq. 12."""
    held: Tensor
    """(H,) vertices of its waistband, empty where nothing holds it."""

    @classmethod
    def of(cls, thing: Garment | Mesh, body: Body) -> Template:
        """Cloth, bending balance and waistband of a garment at rest on the neutral body."""
        mesh = thing.mesh if isinstance(thing, Garment) else thing
        mesh = Mesh(mesh.vertices.detach().float(), mesh.faces)
        cloth = Cloth.from_garment(thing) if isinstance(thing, Garment) else Cloth.from_mesh(mesh)
        contact = BodyContact(body.rest(body.neutral().shape).vertices[0], body.faces)
        middle = mesh.vertices[cloth.hinges[:, :2]].mean(1)
        balance = (contact.signed_distance(middle).clamp_min(0) / FAR).clamp(max=1.0)
        held = torch.as_tensor(held_vertices(thing))
        return cls(thing, mesh, towards_template(cloth, mesh.vertices, balance), held)


def train_gaps(config: TrainGaps) -> Path:
    """Train and write weights with their card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no such garment, no motions, unknown skinning.
    """
    torch.set_num_threads(config.threads)
    if config.skinning not in METHODS:
        raise UserError(f"--skinning: found {config.skinning!r}; wanted one of {', '.join(METHODS)}")
    body = load_body()
    motions = read_motions(config.motions, config.holdout, body, config.fps, config.out)
    template = Template.of(load_garment(config.garment), body)
    if not border_loops(template.mesh.faces.numpy()):
        raise UserError(f"{config.garment}: found a closed surface; wanted an open garment")
    loss = Loss(template, motions, body, config)
    training = learn(loss)
    assert isinstance(training.module, GapsNet)
    net = training.module.folded()
    if config.rank:
        net = narrowed(net, loss.states(net), template.mesh, config.rank)
    file = store(net, template, body, config, training)
    training.checkpoint.unlink(missing_ok=True)
    return file


def learn(loss: Loss) -> Training:
    """The training itself."""
    config, template, body = loss.config, loss.template, loss.body
    torch.manual_seed(config.seed)
    count = len(template.mesh.vertices)
    shape = GapsShape(count, body.n_shape, config.width, config.layers, edge_rounds=config.edge_rounds)
    net = GapsNet(shape, smooth_basis(template.mesh.vertices, template.mesh.faces, config.modes))
    if config.start:
        known = _known(template, body, config).net
        if replace(known.shape, rank=0, edge_rounds=config.edge_rounds) != shape:
            raise UserError(f"{config.start}: found a network of {known.shape}; wanted {shape}")
        net.take_over(known)
    adam = torch.optim.Adam(net.parameters(), config.rate, fused=True)
    training = Training(f"gaps-{config.name}", net, adam, settings_of(config, ("rank",)), config.out)
    training.resume()
    generator = torch.Generator().manual_seed(config.seed + training.step)
    # What was learned once has its schedule of stretch behind it.
    training.run(
        Budget(config.minutes, config.steps), lambda share: loss(net, 1.0 if config.start else share, generator)
    )
    return training


def _known(template: Template, body: Body, config: TrainGaps) -> GapsDraper:
    """The draper that is there.

    Raises:
        UserError: no such network, or one of another garment.
    """
    draper = load_gaps(config.name, body, config.start)
    mesh = draper.garment.mesh if isinstance(draper.garment, Garment) else draper.garment
    if not torch.equal(mesh.faces, template.mesh.faces):
        raise UserError(f"gaps-{config.name}: found a network of another garment than {config.garment}")
    return draper


class Loss:
    """GAPS Eq. 17 on random windows of motion."""

    def __init__(self, template: Template, motions: list[Motion], body: Body, config: TrainGaps):
        self.template, self.motions, self.body, self.config = template, motions, body, config
        self.bound = Bound.of(template.mesh.vertices, template.mesh.faces, body, config.skinning)
        self.edges = template_edges(template.thing, config.edge_rounds)
        rings = OneRings.of(template.mesh.vertices, template.mesh.faces)
        weights = FrameWeights(
            collision=config.collision,
            margin=config.margin,
            inextensibility=config.inextensibility,
            relax=config.relax,
            deep_share=3,
        )
        rest = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
        self.physics = FramePhysics(template.cloth, rings, rest, weights, config.windows * config.frames)

    def windows(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Random windows of motion, each with the frames before it: pose (W, B + F + 1, 24, 3), translation likewise.

        In every other one the arms move as in another clip: a dozen clips hold few combinations.
        """
        c = self.config
        length = c.burn_in + c.frames + 1
        legs, arms = (self._pick(c.windows, length, generator) for _ in range(2))
        swap = torch.rand(c.windows, generator=generator) < 0.5
        return torch.where(swap[:, None, None, None] & ARMS[:, None], arms[0], legs[0]), legs[1]

    def _pick(self, count: int, length: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """``count`` random stretches of motion: pose (count, length, 24, 3) and translation (count, length, 3)."""
        lengths = torch.tensor([len(m.pose) for m in self.motions])
        poses, places = [], []
        for k in torch.multinomial(lengths.float(), count, replacement=True, generator=generator).tolist():
            motion = self.motions[k]
            last = int(torch.randint(int(lengths[k]), (), generator=generator))
            rows = torch.arange(last - length + 1, last + 1).clamp(min=0)  # before the clip begins people stand still
            poses.append(motion.pose[rows])
            places.append(motion.translation[rows])
        return torch.stack(poses), torch.stack(places)

    @torch.no_grad()
    def states(self, net: GapsNet, batches: int = 200) -> Tensor:
        """(N, W) states of a network on random windows."""
        generator = torch.Generator().manual_seed(self.config.seed)
        many = (self._seen(generator) for _ in range(batches))
        last = slice(self.config.burn_in, None)
        return torch.cat([net.remember(features, shape)[0][:, last].flatten(0, 1) for _, _, features, shape in many])

    def _seen(self, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Random windows on random bodies: pose and translation as ``windows``, features (W, B + F, FEATURES) and shape
        (W, S)."""
        c = self.config
        pose, place = self.windows(generator)
        features = motion_features(pose[:, 1:], place[:, 1:], c.fps, (pose[:, 0], place[:, 0]))
        shape = torch.randn(c.windows, self.body.n_shape, generator=generator).clamp(-2, 2) * c.shape_spread
        return pose, place, features, shape

    def __call__(self, net: GapsNet, share: float, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """The loss of one random batch, and its terms per frame."""
        c = self.config
        pose, place, features, shape = self._seen(generator)
        hidden = None
        if c.burn_in:  # hidden states as they are in the midst of a motion
            with torch.no_grad():
                hidden = net.remember(features[:, : c.burn_in], shape)[1]
        moved, _ = net(features[:, c.burn_in :], shape, hidden)
        many = shape.repeat_interleave(c.frames, 0)
        last = slice(-c.frames, None)
        with torch.no_grad():
            body = self.body.pose(BodyPose(many, pose[:, last].flatten(0, 1), place[:, last].flatten(0, 1)))
        x = self.edges(self.bound.place(moved.flatten(0, 1), body.transforms, many))
        energy, terms = self.physics(x, body.mesh.vertices, epoch=100 * min(1.0, 2 * share))
        path = x.unflatten(0, (c.windows, c.frames))
        swung = inertia(self.template.cloth, path[:, 2:], path[:, 1:-1], path[:, :-2], 1 / c.fps).sum(1)
        off = moved[..., self.template.held, :].square().sum((1, 2, 3))
        loss = (energy.unflatten(0, (c.windows, c.frames)).sum(1) + swung + c.pin * off).mean() / c.frames
        shown = {name: float(v.mean()) for name, v in terms.items() if name != "gravity"}
        return loss, {"loss": loss.item(), **shown, "inertia": float(swung.detach().mean()) / c.frames}


def store(net: GapsNet, template: Template, body: Body, config: TrainGaps, done: Training) -> Path:
    """Write ``gaps-<name>`` with its card; everything that ``recon.draping.gaps`` needs to rebuild the draper."""
    thing = template.thing
    tensors = {f"net.{k}": v for k, v in net.state_dict().items()}
    tensors |= {"garment.vertices": template.mesh.vertices, "garment.faces": template.mesh.faces}
    card = {
        "what": f"GAPS draping network of the garment {config.garment}",
        "shape": asdict(net.shape),
        "skinning": config.skinning,
        "data": f"motion clips of {config.motions.name} and their mirror images; held out: {', '.join(config.holdout)}",
        **done.card(config),
        "licence": CLIP_TERMS,
    }
    if config.start:
        before = read_manifest(config.start)[f"gaps-{config.name}"]
        card["before"] = {k: before[k] for k in ("seed", "steps", "minutes", "machine", "before") if k in before}
    if isinstance(thing, Garment):
        names = ("panel_points", "panel_faces", "panel_of_face", "vertex_of_point", "border_labels")
        tensors |= {f"garment.{name}": getattr(thing, name) for name in names}
        card |= {"kind": thing.kind, "seam_names": list(thing.seam_names), "variant": thing.variant}
        card |= {"panel_names": list(thing.panel_names)}
    places = ("garment.vertices", "garment.panel_points")
    return write_weights(f"gaps-{config.name}", tensors, card, config.out, exact=places)
