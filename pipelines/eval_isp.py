"""Measure an implicit sewing pattern decoder on garments that it has and has not seen (ISP §4.2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pipelines.isp_samples import along, panel_border, signed_distance
from recon.garments.isp import IspDecoder
from recon.garments.latents import LatentPrior, spread
from recon.garments.sewing import is_manifold
from recon.metrics import boundary_loops, compare_meshes, largest_stretch, panel_iou, sample_surface
from recon.types import Garment, UserError

RESOLUTION = 256
"""Grid at which decoded garments are compared."""
FROM_MESH = 4
"""How many unseen garments are also found from their mesh: each takes a hundred decodings."""


def evaluate(
    decoder: IspDecoder, seen: list[Garment], unseen: list[Garment], seed: int = 0
) -> dict[str, dict[str, float]]:
    """Figures for the card: learned codes against their own garments, and unseen garments whose code is searched.

    ``seen`` are the garments of the first codes. Unseen ones are found twice: from their pattern (distances and labels)
    and from their mesh alone (Chamfer distance with Eq. 6's gradient, as in the paper).
    """
    generator = torch.Generator().manual_seed(seed)
    pairs = {"seen": [(decoder.codes[k], g) for k, g in enumerate(seen)]}
    if unseen:
        pairs["unseen_from_pattern"] = [(fit_pattern(decoder, g, seed=seed), g) for g in unseen]
        bank = _bank(decoder, generator)
        pairs["unseen_from_mesh"] = [(fit_mesh(decoder, g, bank, generator), g) for g in unseen[:FROM_MESH]]
    result: dict[str, dict[str, float]] = {}
    for name, group in pairs.items():
        rows = [measure(decoder, z, g, generator) for z, g in group]
        keys = sorted({k for row in rows for k in row})
        result[name] = {k: round(float(np.mean([row[k] for row in rows if k in row])), 6) for k in keys}
        result[name]["garments"] = len(rows)
    return result


def measure(decoder: IspDecoder, latent: Tensor, truth: Garment, generator: torch.Generator) -> dict[str, float]:
    """All figures of one decoded garment against the truth."""
    with torch.no_grad():
        try:
            found = decoder.decode(latent, RESOLUTION)
        except UserError:
            return {"decodes": 0.0}
        row = compare_meshes(found.mesh, truth.mesh, generator, 5000)
        row["decodes"] = 1.0
        row["panel_iou"] = panel_iou(found, truth)
        row["right_loops"] = float(boundary_loops(found.mesh.faces) == boundary_loops(truth.mesh.faces))
        row["stretch_p95"] = float(largest_stretch(found).quantile(0.95))
        row["manifold"] = float(is_manifold(found.mesh.faces.numpy()))
        row["labels"] = label_accuracy(decoder, latent, truth)
        gap = seam_gap(decoder, found)
        if len(gap):
            row["seam_gap_mm"], row["seam_gap_p95_mm"] = float(gap.mean()) * 1e3, float(gap.quantile(0.95)) * 1e3
    return row


def label_accuracy(decoder: IspDecoder, latent: Tensor, truth: Garment, count: int = 1000) -> float:
    """Share of the truth's border points whose label the pattern network finds."""
    rng, right = np.random.default_rng(0), []
    for panel in (0, 1):
        border = panel_border(truth, decoder.nets.shape, panel)
        at = along(border, rng, count)[0]
        label = signed_distance(border, at)[1]
        _, logits = decoder.pattern(latent, decoder.nets.to_panel(torch.as_tensor(at, dtype=latent.dtype)))
        right.append((logits[:, panel].argmax(-1).numpy() == label).mean())
    return float(np.mean(right))


def seam_gap(decoder: IspDecoder, garment: Garment) -> Tensor:
    """(S,) distances [m] between the two sides of each seam point before they are welded."""
    seam = (garment.border_labels > 0).nonzero()[:, 0]
    panel = torch.zeros(len(garment.panel_points), dtype=torch.long)
    panel[garment.panel_faces[garment.panel_of_face == 1]] = 1
    assert garment.latent is not None
    lifted = decoder.surface(garment.latent.detach(), garment.panel_points[seam])
    own = lifted[torch.arange(len(seam)), panel[seam]]
    front, back = panel[seam] == 0, panel[seam] == 1
    vertex = garment.vertex_of_point[seam]
    place = torch.full((len(garment.mesh.vertices), 3), torch.nan)
    place[vertex[back]] = own[back]
    gap = (place[vertex[front]] - own[front]).norm(dim=1)
    return gap[gap.isfinite()]


def fit_pattern(decoder: IspDecoder, truth: Garment, steps: int = 250, seed: int = 0) -> Tensor:
    """The code (z,) whose flat panels match the garment's: signed distance and labels, with a weak prior."""
    rng = np.random.default_rng(seed)
    borders = [panel_border(truth, decoder.nets.shape, k) for k in (0, 1)]
    near = [along(b, rng, 700)[0] + rng.normal(size=(700, 2)) * 0.02 for b in borders]
    at = np.concatenate([*near, rng.uniform(-1, 1, (600, 2))])
    measured = [signed_distance(b, at) for b in borders]
    x = torch.as_tensor(at, dtype=torch.float32)
    distance = torch.as_tensor(np.stack([d for d, _ in measured], 1), dtype=torch.float32)
    label = torch.as_tensor(np.stack([c for _, c in measured], 1))
    prior = LatentPrior.of(decoder.codes)

    def loss(z: Tensor) -> Tensor:
        nets = decoder.nets
        found, logits = nets.split_pattern(nets.pattern(x.expand(len(z), -1, -1), z))
        error = ((found - distance).abs() * (0.1 / distance.abs().clamp_min(0.1))).mean((1, 2))
        entropy = F.cross_entropy(logits.permute(0, 3, 1, 2), label.expand(len(z), -1, -1), reduction="none")
        return 4 * error + 0.02 * entropy.mean((1, 2)) + 2e-4 * prior.energy(z)

    with torch.no_grad():
        first = torch.cat([loss(part) for part in decoder.codes.split(32)])
    starts = first.topk(min(2, len(first)), largest=False).indices
    return _descend(decoder.codes[starts], loss, steps)


def _descend(start: Tensor, loss: Callable[[Tensor], Tensor], steps: int) -> Tensor:
    """Adam on codes (K, z) side by side; the best one ever met."""
    z = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([z], lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    best, least = start[0].clone(), float("inf")
    for _ in range(steps):
        values = loss(z)
        k = int(values.detach().argmin())
        if float(values[k].detach()) < least:
            best, least = z[k].detach().clone(), float(values[k].detach())
        optimizer.zero_grad()
        values.sum().backward()
        optimizer.step()
        schedule.step()
    return best


def _bank(decoder: IspDecoder, generator: torch.Generator, count: int = 64) -> list[tuple[int, Tensor]]:
    """Surface points of learned garments that cover the code space, to start a search from."""
    bank = []
    for k in spread(decoder.codes, count).tolist():
        with torch.no_grad():
            bank.append((k, sample_surface(decoder.decode(decoder.codes[k], 64).mesh, 800, generator)[0]))
    return bank


def fit_mesh(
    decoder: IspDecoder, truth: Garment, bank: list[tuple[int, Tensor]], generator: torch.Generator, steps: int = 100
) -> Tensor:
    """The code (z,) whose sewn garment has the least Chamfer distance to the mesh; nothing of the pattern is used."""
    target = sample_surface(truth.mesh, 2500, generator)[0]
    start = min(bank, key=lambda entry: float(_chamfer(entry[1], target[:800])))[0]
    prior = LatentPrior.of(decoder.codes)

    def loss(z: Tensor) -> Tensor:
        mesh = decoder.decode(z[0], 72).mesh
        near = _chamfer(mesh.vertices, target)
        return near[None] + 2e-6 * prior.energy(z)

    return _descend(decoder.codes[start][None], loss, steps)


def _chamfer(a: Tensor, b: Tensor) -> Tensor:
    """Mean squared nearest-neighbour distances [m²] both ways, differentiable in a."""
    from scipy.spatial import cKDTree

    forth = torch.as_tensor(cKDTree(b.numpy()).query(a.detach().numpy())[1])
    back = torch.as_tensor(cKDTree(a.detach().numpy()).query(b.numpy())[1])
    return (a - b[forth]).square().sum(1).mean() + (a[back] - b).square().sum(1).mean()
