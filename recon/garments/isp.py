"""Implicit sewing patterns: from a latent code to a sewn garment, differentiably (ISP §3.1, Eq. 1-6, B.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.files.weights import read_weights
from recon.garments.isp_lattice import Lattice, lattice
from recon.garments.isp_net import IspNets, IspShape, Layer, halves_are_fast
from recon.garments.panels import KEPT, cut_panel, grid_axis, move_safely
from recon.garments.sewing import Sewn, sew
from recon.types import Garment, Mesh, UserError, behind, to_device

COARSE = (32, 128)
"""Cells of the coarser grids along each axis."""
LIPSCHITZ = 1.6
"""Bound on how steep the learned signed distance is; coarse cells that it puts far from the border are skipped."""
FAR = 1.0
"""Signed distance written where a coarse cell rules the border out [domain units]."""
MAX_STEP = 0.5
"""Longest projection step, in cells."""


@dataclass(frozen=True)
class Variant:
    """What a learned code stands for."""

    name: str
    """Garment variant: tank, tshirt, jacket, shorts ..."""
    parameters: dict[str, float]
    """Pattern parameters that the training garment was cut with, where known."""


class IspDecoder:
    """A ``GarmentDecoder``: codes to garments of one kind."""

    name = "isp"

    def __init__(self, nets: IspNets, codes: Tensor, variants: list[Variant]):
        """``codes`` (n, z) learned codes and what each stands for."""
        if len(codes) != len(variants):
            raise ValueError(f"{len(codes)} codes but {len(variants)} variants")
        self.nets = nets.eval().requires_grad_(False)
        self.codes = codes
        self.variants = [v.name for v in variants]
        self.parameters = [v.parameters for v in variants]
        self._plan: tuple[Garment, _Plan] | None = None

    @property
    def kind(self) -> str:
        """Garment kind: top, skirt, trousers or dress."""
        return self.nets.shape.kind

    @property
    def seam_names(self) -> tuple[str, ...]:
        """Names of the border labels."""
        return self.nets.shape.seam_names

    @property
    def panels(self) -> int:
        """How many panels garments of the kind have (K)."""
        return len(self.nets.shape.panel_names)

    def to(self, device: str | torch.device) -> IspDecoder:
        """The same decoder on another device."""
        self.nets.to(device)
        self.codes = self.codes.to(device)
        self._plan = None
        return self

    def decode(self, latent: Tensor, resolution: int = 256) -> Garment:
        """The garment of one code (z,), cut on a grid of ``resolution`` cells along the domain's side.

        Topology is computed afresh; vertices carry the gradient of Eq. 6, both terms.

        Raises:
            UserError: the code describes no panel.
        """
        code = latent.detach()
        with torch.no_grad():
            field = self.nets.pattern.fold(code)
            sewn = self._cut_and_sew(field, self._distance_grid(field, resolution))
        plan = _Plan.make(sewn, latent, self.panels, resolution)
        steps = 2.0 / resolution * MAX_STEP
        points = self._on_border(field, plan, plan.points, steps, 1)
        start, faces, border, goal = (
            t.cpu().numpy() for t in (plan.points, plan.faces, plan.border, points[plan.border])
        )
        safe = move_safely(start, faces, border, goal, KEPT)
        points = torch.as_tensor(safe, dtype=points.dtype, device=points.device)
        return self._remember(self._garment(latent, replace(plan, points=points), None), plan)

    def decode_like(self, latent: Tensor, garment: Garment) -> Garment:
        """``garment`` (decoded by this decoder) re-evaluated at a code nearby: same topology, its border re-projected.

        Several times cheaper than ``decode``; decode afresh when the code has moved far (hems by more than a few
        cells).
        """
        if self._plan is not None and self._plan[0].panel_faces is garment.panel_faces:
            plan = replace(self._plan[1], points=self.nets.to_domain(garment.panel_points))
        else:
            points = self.nets.to_domain(garment.panel_points.detach())
            topology = (garment.panel_faces, garment.panel_of_face, garment.vertex_of_point, garment.border_labels)
            sewn = Sewn(points.cpu().double().numpy(), *(t.cpu().numpy() for t in topology))
            plan = _Plan.make(sewn, latent, self.panels)
        with torch.no_grad():
            field = self.nets.pattern.fold(latent.detach())
        points = self._on_border(field, plan, plan.points, 0.05, 2)
        return self._remember(self._garment(latent, replace(plan, points=points), garment), plan)

    def pattern(self, latent: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """I_Θ at panel points x (N, 2) [m]: signed distance (N, K) [m] of each panel, label logits (N, K, L)."""
        layers = self.nets.pattern.fold(latent)
        distance, logits = self.nets.split_pattern(self.nets.pattern.run_folded(layers, self.nets.to_domain(x)))
        return distance * self.nets.shape.half, logits

    def surface(self, latent: Tensor, x: Tensor) -> Tensor:
        """A_Φ at panel points x (N, 2) [m] -> (N, K, 3) points of each panel in rest space [m]."""
        at = self.nets.to_domain(x)
        return self.nets.to_world(self.nets.lift(self.nets.surface.run_folded(self.nets.surface.fold(latent), at), at))

    def _cut_and_sew(self, field: list[Layer], distance: np.ndarray):
        cell = 2.0 / (len(distance) - 1)
        panels, labels = [], []
        for k in range(self.panels):
            panel = cut_panel(distance[:, :, k])
            if len(panel.faces) < 8:
                raise UserError(f"{self.kind}: the code describes no garment; start from a learned code")
            border = panel.border
            start = torch.as_tensor(panel.points[border], dtype=self.codes.dtype, device=self.codes.device)
            panel_of = torch.full((len(border),), k, device=start.device)
            target, logits = self._project(field, start, panel_of, MAX_STEP * cell, 1, exact=False)
            points = move_safely(panel.points, panel.faces, border, target.cpu().double().numpy())
            panels.append(replace(panel, points=points))
            labels.append(logits.argmax(-1).cpu().numpy())
        return sew(panels, labels, [behind(name) for name in self.nets.shape.panel_names], cell)

    def _distance_grid(self, field: list[Layer], resolution: int) -> np.ndarray:
        """(R+1, R+1, K) signed distances; what coarser grids rule out is not evaluated: ±FAR."""
        axis = torch.as_tensor(grid_axis(resolution), dtype=self.codes.dtype, device=self.codes.device)
        levels = [cells for cells in COARSE if 2 * cells <= resolution]
        known = needed = None
        for cells in levels:
            middle = (torch.arange(cells, dtype=axis.dtype, device=axis.device) + 0.5) * (2 / cells) - 1
            known = self._refine(field, middle, known, needed)
            margin = LIPSCHITZ * 2**0.5 / cells + 2.0 / resolution
            needed = (known.abs() < margin).any(-1)
        return self._refine(field, axis, known, needed).double().cpu().numpy()

    def _refine(self, field: list[Layer], axis: Tensor, known: Tensor | None, needed: Tensor | None) -> Tensor:
        """Signed distances (n, n, K) at all pairs of ``axis``, evaluated in ``needed`` coarse cells only."""
        if known is None or needed is None:
            grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)
            return self._distance(field, grid.view(-1, 2)).unflatten(0, grid.shape[:2])
        cell = ((axis + 1) * (len(known) / 2)).long().clamp(0, len(known) - 1)
        distance = torch.where(known > 0, FAR, -FAR).to(axis.dtype)[cell[:, None], cell[None]]
        i, j = needed[cell[:, None], cell[None]].nonzero(as_tuple=True)
        distance[i, j] = self._distance(field, torch.stack([axis[i], axis[j]], 1))
        return distance

    def _distance(self, field: list[Layer], x: Tensor) -> Tensor:
        """(N, K) signed distances, good to a tenth of a fine grid's cell: what they cut is projected afterwards."""
        with torch.autocast(x.device.type, torch.bfloat16, enabled=halves_are_fast(x.device)):
            return self.nets.pattern.run_folded(field, x)[:, : self.panels].to(x.dtype)

    def _slope(self, field: list[Layer], x: Tensor, panel: Tensor, halves: bool = False):
        """Signed distance (N,), its gradient (N, 2) in x, and label logits (N, L) of each point's own panel.

        ``halves``: in half precision, where it is fast.
        """
        with torch.enable_grad(), torch.autocast(x.device.type, torch.bfloat16, enabled=halves):
            at = x.detach().requires_grad_()
            distance, logits = self.nets.split_pattern(self.nets.pattern.run_folded(field, at))
            row = torch.arange(len(x), device=x.device)
            own = distance[row, panel]
            (slope,) = torch.autograd.grad(own.sum(), at)
        return own.detach().to(x.dtype), slope, logits.detach()[row, panel]

    def _project(self, field: list[Layer], x: Tensor, panel: Tensor, longest: float, rounds: int, exact: bool = True):
        """Points moved along the gradient onto the zero level (B.2), in all at most ``longest``; with their logits.

        ``exact``: points that are projected again may stop a little short of it.
        """
        start, halves = x, not exact and halves_are_fast(x.device)
        for _ in range(rounds):
            own, slope, logits = self._slope(field, x, panel, halves)
            step = own[:, None] * slope / slope.square().sum(1, keepdim=True).clamp_min(0.1)
            away = x - step - start
            x = start + away * (longest / away.norm(dim=1, keepdim=True).clamp_min(longest))
        return x, logits

    def _on_border(self, field: list[Layer], plan: _Plan, points: Tensor, longest: float, rounds: int) -> Tensor:
        points = points.clone()
        points[plan.border] = self._project(field, points[plan.border], plan.border_panel, longest, rounds)[0]
        return points

    def _garment(self, latent: Tensor, plan: _Plan, like: Garment | None) -> Garment:
        """Lift the plan's points; border points move with the code as Eq. 6 says: dx/dz = -∇s (∂s/∂z) / |∇s|²."""
        nets, points = self.nets, plan.points
        border = points[plan.border]
        if latent.requires_grad and torch.is_grad_enabled():
            field = nets.pattern.fold(latent)
            _, slope, _ = self._slope([_detached(k) for k in field], border, plan.border_panel)
            own = nets.pattern.run_folded(field, border)[torch.arange(len(border)), plan.border_panel]
            step = slope / slope.square().sum(1, keepdim=True).clamp_min(0.1)
            border = border - step * (own - own.detach())[:, None]
        x = torch.cat([points[plan.inner], border])
        raw = nets.surface.run_folded(nets.surface.fold(latent), x)
        between = plan.lattice.interpolate(raw)
        x = torch.cat([x, points[plan.between]])
        own = nets.lift(torch.cat([raw, between]), x).flatten(0, 1)[plan.lifted_row]
        vertices = torch.zeros(plan.n_vertices, 3, dtype=own.dtype, device=own.device)
        vertices = nets.to_world(vertices.index_add(0, plan.vertex_of_point, own) / plan.points_per_vertex[:, None])
        panel_points = nets.to_panel(points)
        if like is not None:
            mesh = like.mesh.with_vertices(vertices)
            return replace(like, mesh=mesh, panel_points=panel_points, latent=latent)
        return Garment(
            kind=self.kind,
            mesh=Mesh(vertices, plan.vertex_of_point[plan.faces]),
            panel_points=panel_points,
            panel_faces=plan.faces,
            panel_of_face=plan.panel_of_face,
            vertex_of_point=plan.vertex_of_point,
            border_labels=plan.labels,
            seam_names=self.seam_names,
            latent=latent,
            variant=self._variant_near(latent),
            panel_names=self.nets.shape.panel_names,
        )

    def _variant_near(self, latent: Tensor) -> str:
        return self.variants[int((self.codes - latent.detach()).square().sum(1).argmin())]

    def _remember(self, garment: Garment, plan: _Plan) -> Garment:
        self._plan = garment, plan
        return garment


def _detached(layer: Layer) -> Layer:
    return Layer(layer.weight.detach(), layer.bias.detach(), None if layer.skip is None else layer.skip.detach())


@dataclass(frozen=True)
class _Plan:
    """Fixed topology, arranged for evaluation: inner grid points that several panels share are lifted once."""

    points: Tensor
    """(P, 2) domain."""
    faces: Tensor
    panel_of_face: Tensor
    vertex_of_point: Tensor
    labels: Tensor
    border: Tensor
    """(B,) indices of border points."""
    border_panel: Tensor
    """(B,) the panel of each."""
    inner: Tensor
    """(I,) one representative per distinct inner point that the network is asked about."""
    between: Tensor
    """(J,) one representative per distinct inner point that is interpolated."""
    lattice: Lattice
    """Where those J come from, among the I."""
    lifted_row: Tensor
    """(P,) row of each point among K (I + B + J) lifted positions, all panels of a point beside each other."""
    points_per_vertex: Tensor
    n_vertices: int

    @staticmethod
    def make(sewn: Sewn, like: Tensor, panels: int, resolution: int = 0) -> _Plan:
        """Tensors take the device and dtype of ``like``; ``resolution`` of the grid: fine ones are interpolated."""
        points, faces, labels = sewn.points, sewn.faces, sewn.labels
        panel = np.zeros(len(points), np.int64)
        panel[faces] = sewn.panel_of_face[:, None]
        border, inside = np.nonzero(labels >= 0)[0], np.nonzero(labels < 0)[0]
        keys = np.round((points[inside] + 2) * 2**22).astype(np.int64)
        _, first, which = np.unique(keys[:, 0] * 2**30 + keys[:, 1], return_index=True, return_inverse=True)
        used = np.bincount(which, 1 << panel[inside], len(first)).astype(np.uint8)
        asked, between = lattice(points[inside[first]], used, resolution)
        place = np.empty(len(first), np.int64)
        place[asked] = np.arange(asked.sum())
        place[~asked] = asked.sum() + len(border) + np.arange((~asked).sum())
        row = np.empty(len(points), np.int64)
        row[inside] = panels * place[which] + panel[inside]
        row[border] = panels * (asked.sum() + np.arange(len(border))) + panel[border]
        counts = np.bincount(sewn.vertex_of_point)

        def index(a: np.ndarray) -> Tensor:
            return torch.as_tensor(a, dtype=torch.long, device=like.device)

        return _Plan(
            points=torch.as_tensor(points, dtype=like.dtype, device=like.device),
            faces=index(faces),
            panel_of_face=index(sewn.panel_of_face),
            vertex_of_point=index(sewn.vertex_of_point),
            labels=index(labels),
            border=index(border),
            border_panel=index(panel[border]),
            inner=index(inside[first[asked]]),
            between=index(inside[first[~asked]]),
            lattice=replace(to_device(between, like.device), rows=index(place[between.rows])),
            lifted_row=index(row),
            points_per_vertex=torch.as_tensor(counts, dtype=like.dtype, device=like.device),
            n_vertices=len(counts),
        )


def load_isp(kind: str, folder: str | Path | None = None, device: str | torch.device = "cpu") -> IspDecoder:
    """The trained decoder of a garment kind, from ``folder`` or else the packaged weights.

    Raises:
        UserError: weights missing or corrupt, or not those of an implicit sewing pattern.
    """
    weights = read_weights(f"isp-{kind}", folder)
    try:
        shape = IspShape.read(weights.card["shape"])
        described = zip(weights.card["variants"], weights.card["parameters"], strict=True)
        decoder = build(shape, weights.tensors, [Variant(name, dict(values)) for name, values in described])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"isp-{kind}: weights and card don't describe sewing pattern networks ({error})") from error
    return decoder.to(device)


def build(shape: IspShape, tensors: dict[str, Tensor], variants: list[Variant]) -> IspDecoder:
    """A decoder from its stored parts: ``codes`` and the networks' parameters."""
    nets = IspNets(shape)
    state = {k: v.float() for k, v in tensors.items() if k != "codes"}
    nets.load_state_dict(state)
    return IspDecoder(nets, tensors["codes"].float(), variants)
