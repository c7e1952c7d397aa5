"""Train the implicit sewing patterns of one garment kind (ISP §3.1, Eq. 2-5): ``recon train isp --kind top``.

The pattern network, the surface map and a code per garment learn together. Garments know which panel point lies where
in space, so that Eq. 4's Chamfer distance and normal consistency and Eq. 5's seam consistency are written by
correspondence (exact, and much sharper than nearest neighbours): distances of points, of their differences along the
panel (Sobolev), of normals, of borders and seams, and the gap between the two sides of a seam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pipelines.isp_samples import GRID, IspSamples, collect, frame
from pipelines.training import Budget, Training, settings_of
from recon.files.weights import read_manifest, write_weights
from recon.garments.dataset import Item, load_items
from recon.garments.isp import IspDecoder, Variant, load_isp
from recon.garments.isp_net import IspNets, IspShape
from recon.types import Garment, UserError

STEP = 3
"""Grid points between the ends of a finite difference on the position maps."""


@dataclass(frozen=True)
class TrainIsp:
    """Settings of one training."""

    kind: str
    """Garment kind: top, skirt, trousers, dress or shirt6 (six panels; needs ``data``)."""
    data: Path | None = None
    """Folder of the garment data set (<kind>_train.npz, <kind>_test.npz); the one that ships if not given."""
    start: Path | None = None
    """Folder of weights to go on from (the same kind and network sizes); None = from scratch."""
    out: Path = Path("out/weights")
    """Folder for the weights, their manifest, the log and the checkpoints."""
    minutes: float = 20.0
    """Training time [minutes], preparation and evaluation not counted."""
    steps: int = 0
    """Train so many steps instead of so many minutes; 0 = by the clock."""
    seed: int = 0
    """Seed of initialisation and sampling."""
    threads: int = 2
    """CPU threads."""
    garments: int = 0
    """Train on the first so many garments only; 0 = all."""
    batch: int = 8
    """Garments per step."""
    surface_points: int = 96
    """Places per garment and step at which the surface map is compared (three points each, all panels)."""
    border_points: int = 32
    """Points per garment and step on each panel's border, and on seams."""
    pattern_points: int = 320
    """Signed distance samples per garment and step."""
    rate: float = 2e-3
    """Adam's learning rate of the networks at the start; decays along a cosine."""
    code_rate: float = 2e-3
    """The same for the codes."""
    code_noise: float = 0.0
    """Noise on the codes as a share of their spread, falling to a third: between codes must lie clothes as well."""
    normal: float = 1.0
    """Factor on L_normal: normals, and differences along the surface (0: Table 4 without it)."""
    consist: float = 1.0
    """Factor on L_consist: seams and their gaps (0: Table 4 without it)."""
    width: int = 192
    """Units per layer."""
    pattern_depth: int = 4
    """Layers of I_Θ."""
    surface_depth: int = 6
    """Layers of A_Φ."""
    code: int = 32
    """Length of a latent code."""
    evaluate: int = 10
    """Held-out garments to evaluate on; 0 = none."""


class Learned(torch.nn.Module):
    """What learns: the networks and a code per garment."""

    def __init__(self, nets: IspNets, codes: Tensor):
        super().__init__()
        self.nets, self.codes = nets, torch.nn.Parameter(codes)


def train_isp(config: TrainIsp) -> Path:
    """Train, evaluate on held-out garments and write weights with their card; returns the weights' file.

    Interrupted, the next call with the same settings goes on from the last checkpoint (one a minute).

    Raises:
        UserError: no garments of this kind.
    """
    items = _items(config, "train")[: config.garments or None]
    garments = [item.garment for item in items]
    if not garments:
        raise UserError(f"{config.data or config.kind}: no garments of kind {config.kind} to train on")
    decoder, done = learn(garments, config, [item.parameters for item in items])
    path = store(decoder, config, done, {})  # evaluation takes minutes: what was learned is safe from now on
    if not config.evaluate:
        return path
    from pipelines.eval_isp import evaluate

    unseen = [item.garment for item in _items(config, "test")[: config.evaluate]]
    return store(decoder, config, done, evaluate(decoder, garments[: config.evaluate], unseen))


def _items(config: TrainIsp, split: str) -> list[Item]:
    source = config.kind if config.data is None else config.data / f"{config.kind}_{split}.npz"
    return [item for item in load_items(source, split) if item.garment.kind == config.kind]


def learn(
    garments: list[Garment], config: TrainIsp, parameters: Sequence[dict[str, float]] = ()
) -> tuple[IspDecoder, Training]:
    """The training itself, for garments of one kind in memory; ``parameters`` they were cut with, where known."""
    torch.set_num_threads(config.threads)
    config.out.mkdir(parents=True, exist_ok=True)
    earlier = load_isp(config.kind, config.start) if config.start is not None else None
    shape = earlier.nets.shape if earlier is not None else _shape(garments, config)
    samples = collect(garments, shape, np.random.default_rng(config.seed), STEP)
    training = start(samples, shape, config)
    learned = training.module
    assert isinstance(learned, Learned)
    if earlier is not None:
        learned.nets.load_state_dict(earlier.nets.state_dict())
        with torch.no_grad():
            learned.codes.copy_(known_codes(earlier, samples))
    training.resume()
    generator = torch.Generator().manual_seed(config.seed + training.step)
    training.run(
        Budget(config.minutes, config.steps), lambda share: batch_loss(learned, samples, config, generator, share)
    )
    known = parameters or [{}] * len(garments)
    variants = [Variant(g.variant, dict(p)) for g, p in zip(garments, known, strict=True)]
    return IspDecoder(learned.nets, learned.codes.detach().clone(), variants), training


def _shape(garments: list[Garment], config: TrainIsp) -> IspShape:
    return replace(
        frame(garments, config.code),
        width=config.width,
        pattern_depth=config.pattern_depth,
        surface_depth=config.surface_depth,
    )


@torch.no_grad()
def known_codes(decoder: IspDecoder, samples: IspSamples, count: int = 256) -> Tensor:
    """For each garment the earlier code whose panels are closest: (n, z)."""
    fields = [decoder.nets.pattern.fold(z) for z in decoder.codes]
    best = []
    for at, distance in zip(samples.at[:, ::41][:, :count], samples.distance[:, ::41][:, :count], strict=True):
        off = [
            (decoder.nets.pattern.run_folded(field, at)[:, : decoder.panels] - distance).abs().mean()
            for field in fields
        ]
        best.append(int(torch.stack(off).argmin()))
    return decoder.codes[best]


def start(samples: IspSamples, shape: IspShape, config: TrainIsp) -> Training:
    """A training that has not begun."""
    torch.manual_seed(config.seed)
    learned = Learned(IspNets(shape), first_codes(samples, shape.code))
    groups = [
        {"params": list(learned.nets.parameters()), "lr": config.rate},
        {"params": [learned.codes], "lr": config.code_rate},
    ]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
    return Training(
        f"isp-{config.kind}",
        learned,
        adam,
        settings_of(config, ("evaluate", "garments"), count=len(samples)),
        config.out,
    )


def first_codes(samples: IspSamples, size: int) -> Tensor:
    """Starting codes (n, size): principal components of what the garments look like, so that neighbours start alike."""
    coarse = samples.positions[:, ::8, ::8] * samples.covered[:, ::8, ::8, :, None]
    features = torch.cat([coarse.flatten(1), samples.covered[:, ::8, ::8].flatten(1).float()], 1)
    features = features - features.mean(0)
    u, s, _ = torch.linalg.svd(features, full_matrices=False)
    keep = min(size, len(samples) - 1) if len(samples) > 1 else 0
    scores = u[:, :keep] * math.sqrt(len(samples)) * (s[:keep] / s[0]).sqrt()
    return F.pad(scores, (0, size - keep)) + 0.01 * torch.randn(len(samples), size)


def batch_loss(
    learned: Learned, samples: IspSamples, config: TrainIsp, generator: torch.Generator, share: float = 0.0
) -> tuple[Tensor, dict[str, float]]:
    """The loss of a random batch, ``share`` of the budget spent, and its terms in millimetres or natural units."""
    garments = torch.randperm(len(samples), generator=generator)[: config.batch]
    z = learned.codes[garments]
    if config.code_noise:
        size = config.code_noise * (1 - share * 2 / 3) * learned.codes.detach().std(0).square().mean().sqrt()
        z = z + size * torch.randn(z.shape, generator=generator)
    surface, measured = surface_loss(learned.nets, z, samples, garments, config, generator)
    pattern, more = pattern_loss(learned.nets, z, samples, garments, config.pattern_points, generator)
    loss = surface + pattern + 1e-4 * z.square().sum(1).mean()
    scale = learned.nets.shape.half * 1e3
    return loss, {k: float(v) * (scale if k.endswith("_mm") else 1.0) for k, v in {**measured, **more}.items()}


def pattern_loss(
    nets: IspNets, z: Tensor, samples: IspSamples, garments: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Eq. 2: signed distance (L1) and edge labels (cross entropy) of all panels."""
    pick = torch.randint(samples.at.shape[1], (len(garments), count), generator=generator)
    row = garments[:, None]
    x, target, label = samples.at[row, pick], samples.distance[row, pick], samples.label[row, pick]
    with torch.autocast(x.device.type, torch.bfloat16):
        out = nets.pattern(x, z)
    distance, logits = nets.split_pattern(out.float())
    # Far from the border only the sign matters: errors there count less.
    error = (distance - target).abs()
    absolute = (error * (0.1 / target.abs().clamp_min(0.1))).mean()
    entropy = F.cross_entropy(logits.flatten(0, 2), label.flatten())
    near = target.abs() < 0.02
    return 4 * absolute + 0.04 * entropy, {"pattern_mm": error[near].mean().detach(), "entropy": entropy.detach()}


def surface_loss(
    nets: IspNets, z: Tensor, samples: IspSamples, garments: Tensor, config: TrainIsp, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Eq. 4 and 5 by correspondence: points, differences, normals, borders, seams and seam gaps."""
    n, b, m, panels = len(garments), config.surface_points, config.border_points, len(nets.shape.panel_names)
    row = garments[:, None]
    corner = samples.cells[row, torch.randint(samples.cells.shape[1], (n, b), generator=generator)].long()
    cells = (corner[:, :, None] + torch.tensor([[0, 0], [STEP, 0], [0, STEP]])).flatten(1, 2)
    target = samples.positions[row, cells[..., 0], cells[..., 1]].view(n, b, 3, panels, 3)
    mask = samples.covered[row, cells[..., 0], cells[..., 1]].view(n, b, 3, panels).float()
    pick = torch.randint(samples.border_at.shape[2], (n, panels + 1, m), generator=generator)
    rim = torch.stack([samples.border_at[row, k, pick[:, k]] for k in range(panels)], 1)
    rim_3d = torch.stack([samples.border_3d[row, k, pick[:, k]] for k in range(panels)], 1)
    seam, seam_panel, seam_3d = (
        part[row, pick[:, panels]] for part in (samples.seam_at, samples.seam_panel, samples.seam_3d)
    )
    x = torch.cat([cells * (2 / (GRID - 1)) - 1, rim.flatten(1, 2), seam.transpose(1, 2).flatten(1, 2)], 1)
    with torch.autocast(x.device.type, torch.bfloat16):
        out = nets.surface(x, z)
    places = nets.lift(out, x)
    inner, border, joint = places.split([3 * b, panels * m, 2 * m], 1)
    found = inner.unflatten(1, (b, 3))
    border = border.unflatten(1, (panels, m))
    joint = joint.unflatten(1, (2, m))
    terms = _compare(found, target, mask)
    terms["border"] = torch.stack([_length(border[:, k, :, k] - rim_3d[:, k]).mean() for k in range(panels)]).mean()
    sides = [_of_panel(joint[:, k], seam_panel[..., k]) for k in (0, 1)]
    terms["seam"] = torch.stack([_length(side - seam_3d).mean() for side in sides]).mean()
    terms["gap"] = _length(sides[0] - sides[1]).mean()
    weights = {"point": 1.0, "border": 0.5, "seam": 0.5 * config.consist, "gap": 0.5 * config.consist}
    weights |= {"difference": 0.03 * config.normal, "normal": 0.01 * config.normal}
    loss = sum((weights[k] * v for k, v in terms.items()), start=terms["gap"].new_zeros(()))
    names = {"point": "surface_mm", "border": "border_mm", "gap": "gap_mm", "normal": "normal"}
    return loss, {names[k]: v.detach() for k, v in terms.items() if k in names}


def _of_panel(places: Tensor, panel: Tensor) -> Tensor:
    """(n, M, K, 3) places on all panels and (n, M) one panel each -> (n, M, 3)."""
    return places.gather(2, panel[..., None, None].expand(-1, -1, 1, 3)).squeeze(2)


def _length(v: Tensor) -> Tensor:
    return (v.square().sum(-1) + 1e-9).sqrt()


def _compare(found: Tensor, target: Tensor, mask: Tensor) -> dict[str, Tensor]:
    """Points, differences and normals of (n, B, 3, K, 3) corner triples; mask (n, B, 3, K)."""
    whole = mask.amin(2)
    point = (_length(found - target) * mask).sum() / mask.sum().clamp_min(1)
    u, v = found[:, :, 1] - found[:, :, 0], found[:, :, 2] - found[:, :, 0]
    tu, tv = target[:, :, 1] - target[:, :, 0], target[:, :, 2] - target[:, :, 0]
    total = whole.sum().clamp_min(1)
    off = ((u - tu).square().sum(-1) + (v - tv).square().sum(-1) + 1e-10).sqrt() / (STEP * 2 / (GRID - 1))
    normal = F.normalize(torch.linalg.cross(u, v), dim=-1, eps=1e-9)
    wanted = F.normalize(torch.linalg.cross(tu, tv), dim=-1, eps=1e-9)
    turned = 1 - (normal * wanted).sum(-1)
    return {"point": point, "difference": (off * whole).sum() / total, "normal": (turned * whole).sum() / total}


def store(decoder: IspDecoder, config: TrainIsp, done: Training, metrics: dict[str, dict[str, float]]) -> Path:
    """Write ``isp-<kind>`` with its card; everything that ``recon.garments`` needs to rebuild the decoder."""
    tensors = {"codes": decoder.codes, **decoder.nets.state_dict()}
    card = {
        "what": f"implicit sewing patterns, {config.kind} (ISP networks I_Θ and A_Φ and {len(decoder.codes)} codes)",
        "shape": asdict(decoder.nets.shape),
        "variants": decoder.variants,
        "parameters": [{k: round(v, 4) for k, v in p.items()} for p in decoder.parameters],
        "data": f"{len(decoder.codes)} generated garments of kind {config.kind}",
        **done.card(config),
        "licence": "CC0-1.0",
        "metrics": metrics,
    }
    if config.start is not None:
        earlier = read_manifest(config.start)[f"isp-{config.kind}"]
        card["before"] = {key: earlier[key] for key in ("data", "steps", "minutes", "before") if key in earlier}
    return write_weights(f"isp-{config.kind}", tensors, card, config.out)
