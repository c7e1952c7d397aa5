"""Train the garment generative network (DrapeNet §3.1, Eq. 1-5): ``recon train udf --family upper``.

Encoder and decoder learn together: points of a garment give its code, the code gives the field, and the field is held
against exact distances and gradients. The encoder is slow on a CPU, and a decoder that sees its codes blurs whatever it
does not tell apart. So in the compact training codes are free: they begin as principal components of distances and
learn with the decoder, and the encoder learns to meet them. ``codes`` = ``encoded`` is the paper's training, as far as
``encoded`` reaches: garments of a batch beyond that have their principal components for a code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipelines.training import Budget, Training, settings_of
from pipelines.udf_samples import Sampling, UdfSamples, bounds, collect, sides_of, spread_mesh
from recon.files.weights import read_weights, write_weights
from recon.garments.dataset import Item, load_items
from recon.garments.udf import FAMILIES, Known, Sided, UdfDecoder
from recon.garments.udf_net import UdfNets, UdfShape
from recon.types import UserError

APART = {"lower": 0.03}
"""Families -> how far their sides are moved apart for the networks [m]; others: not. Trousers' legs may touch."""
NOISE = 0.05
"""Deviation of what is added to codes in training: codes beside one another describe garments alike."""


@dataclass(frozen=True)
class TrainUdf:
    """Settings of one training."""

    family: str
    """Garment family: upper (tops and dresses) or lower (trousers and skirts)."""
    data: Path | None = None
    """Folder of the garment data set (<kind>_train.npz, <kind>_test.npz); the one that ships if not given."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 18.0
    """Training time [minutes], preparation and evaluation not counted."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of initialisation and sampling."""
    threads: int = 2
    """CPU threads."""
    garments: int = 0
    """Train on the first so many garments of each kind only; 0 = all."""
    size: Literal["compact", "paper"] = "compact"
    """Networks that train on a CPU core, or those of the paper (days on a CPU)."""
    head: Literal["pair", "sigmoid"] = "pair"
    """The compact decoder's output; the paper's is a sigmoid."""
    apart: float | None = None
    """How far what is left and right of the middle plane is moved apart for the networks [m]; by default 0.03 for lower
    garments, whose legs may touch, and 0 for others."""
    width: int = 128
    """Units per layer of the compact decoder."""
    batch: int = 8
    """Garments per step (the paper: 4)."""
    places: int = 1200
    """Places per garment and step (the paper: 20000)."""
    slopes: int = 400
    """How many of them also have their gradient compared (the paper: all)."""
    codes: Literal["free", "encoded"] = "free"
    """What the decoder learns from: codes that learn with it, or those of the encoder, as in the paper."""
    encoded: int = 2
    """How many garments of a batch go through the encoder."""
    aim: float = 0.3
    """Weight of the distance between their codes and those that they should have."""
    tie: float = 0.01
    """Weight that keeps free codes near where they begin."""
    begin: Path | None = None
    """Folder of weights whose networks to begin from, where they have the same sizes; and whose codes, where they are
    of the same garments."""
    loss: Literal["bce", "l1", "l2"] = "bce"
    """Distance loss: binary cross-entropy (Eq. 4), or the alternatives of §7.1."""
    gradient: float = 0.1
    """λ_g: weight of the gradient loss (Eq. 5); 0 = without."""
    rate: float = 2e-3
    """Adam's learning rate at the start; decays along a cosine (the paper: 1e-4)."""
    sampling: Sampling = field(default_factory=Sampling)
    """How places are drawn."""
    evaluate: int = 10
    """Held-out garments of each kind to evaluate on; 0 = none."""


def train_udf(config: TrainUdf) -> Path:
    """Train, evaluate on held-out garments and write weights with their card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no such family, or no garments of it.
    """
    if config.family not in FAMILIES:
        raise UserError(f"garment family: found {config.family!r}, wanted one of {', '.join(FAMILIES)}")
    items = [item for kind in FAMILIES[config.family] for item in _items(config, kind, "train")]
    if not items:
        raise UserError(f"{config.data or config.family}: no garments of family {config.family} to train on")
    decoder, done = learn(items, config)
    path = store(decoder, config, done, {})  # evaluation takes minutes: what was learned is safe from now on
    if not config.evaluate:
        return path
    from pipelines.eval_udf import evaluate

    tests = [item for kind in FAMILIES[config.family] for item in _items(config, kind, "test")[: config.evaluate]]
    both: dict[str, object] = {"unseen_encoded": evaluate(decoder, tests), "unseen": evaluate(decoder, tests, steps=60)}
    return store(decoder, config, done, both)


def _items(config: TrainUdf, kind: str, split: str) -> list[Item]:
    source = kind if config.data is None else config.data / f"{kind}_{split}.npz"
    if config.data is not None and not Path(source).is_file():
        return []
    items = [item for item in load_items(source, split) if item.garment.kind == kind]
    return items[: config.garments or None] if split == "train" else items


def learn(items: Sequence[Item], config: TrainUdf) -> tuple[UdfDecoder, Training]:
    """The training itself, for garments in memory."""
    torch.set_num_threads(config.threads)
    apart = APART.get(config.family, 0.0) if config.apart is None else config.apart
    meshes = [spread_mesh(item.garment.mesh, apart) for item in items]
    low, high = bounds(meshes)
    shape = UdfShape.paper(config.family, low, high) if config.size == "paper" else UdfShape(config.family, low, high)
    shape = replace(shape, apart=apart)
    if config.size == "compact":
        shape = replace(shape, head=config.head, width=config.width)
    samples = collect(meshes, shape, config.sampling, torch.Generator().manual_seed(config.seed))
    known = [Known(i.garment.kind, i.garment.variant, dict(i.parameters)) for i in items]
    samples = replace(samples, aims=begun_codes(config, known, samples.aims))
    training = start(shape, config, samples.aims)
    training.resume()
    learner = training.module
    assert isinstance(learner, Learner)
    generator = torch.Generator().manual_seed(config.seed + training.step)
    learner.train()
    training.run(Budget(config.minutes, config.steps), lambda share: batch_loss(learner, samples, config, generator))
    learner.eval()
    codes = learner.codes.detach() if config.codes == "free" else codes_of(learner.nets, samples)
    decoder = UdfDecoder(learner.nets, codes, known)
    return UdfDecoder(learner.nets, codes, known, sided=sides_of(decoder, meshes)), training


def begun_codes(config: TrainUdf, known: Sequence[Known], aims: Tensor) -> Tensor:
    """(G, Z) where codes begin: those that ``begin`` stores, if they are of the same garments; else ``aims`` (G, Z)."""
    if config.begin is None:
        return aims
    weights = read_weights(f"udf-{config.family}", config.begin)
    codes, card = weights.tensors["codes"].float(), described(known)
    return codes if codes.shape == aims.shape and all(weights.card[k] == v for k, v in card.items()) else aims


def described(known: Sequence[Known]) -> dict[str, list[Any]]:
    """What a card says of the garments that codes stand for (``load_udf`` reads it)."""
    return {
        "kinds": [k.kind for k in known],
        "variants": [k.variant for k in known],
        "parameters": [{name: round(v, 4) for name, v in k.parameters.items()} for k in known],
    }


class Learner(nn.Module):
    """The networks and the free codes of the garments that they learn from."""

    def __init__(self, nets: UdfNets, codes: Tensor):
        """``codes`` (G, Z): where they begin."""
        super().__init__()
        self.nets, self.codes = nets, nn.Parameter(codes.clone())


def start(shape: UdfShape, config: TrainUdf, aims: Tensor) -> Training:
    """A training that has not begun; ``aims`` (G, Z): where codes begin.

    UserError: ``begin`` has networks of other sizes.
    """
    torch.manual_seed(config.seed)
    learner = Learner(UdfNets(shape), aims)
    if config.begin is not None:
        known = read_weights(f"udf-{config.family}", config.begin).tensors
        try:
            learner.nets.load_state_dict({k: v for k, v in known.items() if k != "codes"})
        except RuntimeError as error:
            raise UserError(f"{config.begin}: networks of other sizes; wanted those of these settings") from error
    adam = torch.optim.Adam(learner.parameters(), lr=config.rate, betas=(0.9, 0.99))
    settings = settings_of(config, ("evaluate", "garments"), count=len(aims))
    return Training(f"udf-{config.family}", learner, adam, settings, config.out)


def batch_loss(
    learner: Learner, samples: UdfSamples, config: TrainUdf, generator: torch.Generator
) -> tuple[Tensor, dict[str, float]]:
    """Eq. 1 on a random batch, and its terms."""
    nets = learner.nets
    garments = torch.randperm(len(samples), generator=generator)[: config.batch]
    pick = torch.randint(samples.places.shape[1], (len(garments), config.places), generator=generator)
    row = garments[:, None]
    x, wanted = samples.places[row, pick], samples.distance[row, pick]
    slopes = config.slopes if config.gradient else 0
    direction = samples.direction[row, pick[:, :slopes]].float()
    with torch.autocast(x.device.type, torch.bfloat16, enabled=config.size == "compact"):
        z, own, aims = batch_codes(learner, samples, config, garments, generator)
        found, gradient = fields(nets, x, z, slopes)
    distance = distance_loss(found, wanted, config.loss)
    terms = {"distance": distance.detach(), "mm": 1e3 * nets.shape.reach * _near_error(found, wanted)}
    code = (own - aims).square().mean() if len(own) else own.new_zeros(())
    loss, terms["code"] = distance + config.aim * code, code.detach()
    if config.codes == "free":
        loss = loss + config.tie * (learner.codes[garments] - samples.aims[garments]).square().mean()
    if slopes:
        known = (direction.square().sum(-1) > 0.5).float()
        off = ((gradient - direction).square().sum(-1) * known).sum() / known.sum().clamp_min(1)
        loss, terms["slope"] = loss + config.gradient * off, off.detach()
    return loss, {k: float(v) for k, v in terms.items()}


def batch_codes(
    learner: Learner, samples: UdfSamples, config: TrainUdf, garments: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """The codes (B, Z) that the decoder sees of a batch; the encoder's for its first ones, and what they should be."""
    some = garments[: config.encoded]
    cloud = torch.randint(samples.clouds.shape[1], (len(garments),), generator=generator)[: len(some)]
    own = samples.aims[:0]
    if len(some):
        own = learner.nets.encoder(samples.clouds[some, cloud], samples.near[some, cloud].int()).float()
    free = config.codes == "free"
    given = learner.codes[garments] if free else samples.aims[garments]
    z = given + NOISE * torch.randn(given.shape, generator=generator)
    if not free:
        z = torch.cat([own, z[len(some) :]])
    return z, own, given[: len(some)].detach()


def fields(nets: UdfNets, x: Tensor, z: Tensor, slopes: int) -> tuple[Tensor, Tensor]:
    """Distances over δ (B, N) at x (B, N, 3), and the distance's gradients (B, slopes, 3) at the first of them."""
    if not slopes:
        return nets.decoder(x, z), x[:, :0]
    some = x[:, :slopes].clone().requires_grad_()
    if nets.shape.batch_statistics:  # one batch, whole: its statistics belong to all of it
        some = x.clone().requires_grad_()
        found = nets.decoder(some, z)
        (gradient,) = torch.autograd.grad(found.sum(), some, create_graph=True)
        return found, nets.shape.clip * gradient[:, :slopes]
    layers = nets.decoder.fold(z)
    if nets.decoder.training:
        nets.decoder.learn_statistics(layers, x[:, ::8])
    first = nets.decoder.run(layers, some)
    (gradient,) = torch.autograd.grad(first.sum(), some, create_graph=True)
    return torch.cat([first, nets.decoder.run(layers, x[:, slopes:])], 1), nets.shape.clip * gradient


def distance_loss(found: Tensor, wanted: Tensor, kind: str) -> Tensor:
    """L_dist of distances over δ, both in [0, 1]: Eq. 4, or §7.1's alternatives."""
    if kind == "bce":
        p = found.clamp(1e-4, 1 - 1e-4)
        own = F.binary_cross_entropy(wanted.clamp(1e-4, 1 - 1e-4), wanted)  # its least value, for a readable curve
        return F.binary_cross_entropy(p, wanted) - own
    return (found - wanted).abs().mean() if kind == "l1" else (found - wanted).square().mean()


def _near_error(found: Tensor, wanted: Tensor) -> Tensor:
    near = wanted < 0.3
    return ((found - wanted).abs() * near).sum().detach() / near.sum().clamp_min(1)


@torch.no_grad()
def codes_of(nets: UdfNets, samples: UdfSamples) -> Tensor:
    """(G, Z) the codes of all garments, averaged over their clouds."""
    rows = []
    for clouds, near in zip(samples.clouds, samples.near, strict=True):
        rows.append(nets.encoder(clouds, near.int()).mean(0))
    return torch.stack(rows)


def sides_card(sided: Sided | None) -> dict[str, Any] | None:
    """What a card says of the surface's sides (``load_udf`` reads it)."""
    return None if sided is None else {"turn": sided.turn.tolist(), "border": sided.border}


def store(decoder: UdfDecoder, config: TrainUdf, done: Training, metrics: dict[str, object]) -> Path:
    """Write ``udf-<family>`` with its card; everything that ``recon.garments`` needs to rebuild the decoder."""
    tensors = {"codes": decoder.all_codes, **decoder.nets.state_dict()}
    card = {
        "what": f"unsigned distance fields, {config.family} (DGCNN encoder, CBN decoder, {len(decoder.known)} codes)",
        "shape": asdict(decoder.nets.shape),
        **described(decoder.known),
        "data": f"{len(decoder.known)} generated garments of kinds {', '.join(FAMILIES[config.family])}",
        "sides": sides_card(decoder.sided),
        "loss": f"{config.loss}, gradient weight {config.gradient}",
        **done.card(config),
        "licence": "CC0-1.0",
        "metrics": metrics,
    }
    exact = [k for k in tensors if k.endswith(("var", "mean"))]
    return write_weights(f"udf-{config.family}", tensors, card, config.out, exact=exact)
