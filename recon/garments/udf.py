"""Garments as unsigned distance fields behind the decoders' protocol (DrapeNet §3.1): codes to open meshes and back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from recon.files.weights import read_weights
from recon.garments.mesh_udf import Frame, Meshing, chase, follow, mesh_udf, shown
from recon.garments.udf_codes import CodeSearch, refined
from recon.garments.udf_grid import Box
from recon.garments.udf_net import CHUNK, Folded, UdfNets, UdfShape
from recon.garments.udf_sides import beyond_borders, follow_sides, mesh_sides
from recon.garments.udf_space import gathered, spread
from recon.types import Garment, Mesh, UserError

FAMILIES: dict[str, tuple[str, ...]] = {"upper": ("top", "dress"), "lower": ("trousers", "skirt")}
"""Networks -> the kinds that they know; two, as in the paper: what hangs from shoulders, what from a waist."""
MESHING = Meshing(steepness=1.25, floor=0.004, beyond=0.35)
"""How learned fields are meshed: they are less steep in places, and not quite zero on the surface."""
BESIDE = 0.006
"""Distance from the surface at which a learned field is asked how it moves [m]."""

SETTLE = 3
"""Steps by which vertices go to where the field of a code nearby is zero."""


@dataclass(frozen=True)
class Known:
    """What a learned code stands for."""

    kind: str
    """Garment kind."""
    variant: str
    """Finer name within the kind."""
    parameters: dict[str, float]
    """Pattern parameters that the training garment was cut with, where known."""


@dataclass(frozen=True)
class Sided:
    """What the two outputs of a decoder say of the surface's sides, as its training found out."""

    turn: Tensor
    """(2, 2) orthogonal: takes them to a signed distance across the surface, and one beside it."""
    border: float
    """Distance beside the surface that borders show in the middle [m]."""


class LatentField:
    """The unsigned distance [m] of one code: a ``udf_grid.Field``, differentiable in points and code.

    Points and distances are those of the space that the networks know garments in (``UdfDecoder.spread``).
    """

    def __init__(self, nets: UdfNets, latent: Tensor, half: bool = False, sided: Sided | None = None):
        """
        Args:
            nets: the networks.
            latent: (Z,).
            half: values without gradient in bfloat16, three times as fast and 1 % off.
            sided: what the outputs say of sides, where they do.
        """
        self.nets, self.half, self.sided = nets, half, sided
        self.layers = nets.decoder.fold(latent)
        self._fixed = [Folded(k.weight.detach(), k.bias.detach()) for k in self.layers]

    def __call__(self, points: Tensor) -> Tensor:
        """(N, 3) [m] -> (N,) distances [m], at most δ."""
        if not torch.is_grad_enabled():
            return self._values(points)
        parts = points.split(CHUNK)
        run = self.nets.decoder.run
        return self.nets.shape.reach * torch.cat([run(self.layers, self.nets.to_domain(part)) for part in parts])

    def _values(self, points: Tensor) -> Tensor:
        out = points.new_empty(len(points))
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self.half):
            for start in range(0, len(points), CHUNK):
                x = self.nets.to_domain(points[start : start + CHUNK])
                out[start : start + CHUNK] = self.nets.decoder.run(self._fixed, x)
        return out * self.nets.shape.reach

    def slope(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N,) and gradients (N, 3), detached."""
        distance, gradient = points.new_empty(len(points)), torch.empty_like(points)
        for start in range(0, len(points), CHUNK):
            with torch.enable_grad(), torch.autocast(points.device.type, torch.bfloat16, enabled=self.half):
                x = points[start : start + CHUNK].detach().requires_grad_()
                u = self.nets.decoder.run(self._fixed, self.nets.to_domain(x))
                (g,) = torch.autograd.grad(u.sum(), x)
            distance[start : start + CHUNK], gradient[start : start + CHUNK] = u.detach(), g
        return distance * self.nets.shape.reach, gradient * self.nets.shape.reach

    def sides(self, points: Tensor) -> Tensor:
        """(N, 3) [m] -> (N, 2) signed distance across the surface and distance beside it [m]; needs ``sided``."""
        if not torch.is_grad_enabled():
            with torch.autocast(points.device.type, torch.bfloat16, enabled=self.half):
                return torch.cat([self._sides(self._fixed, part) for part in points.split(CHUNK)])
        return torch.cat([self._sides(self.layers, part) for part in points.split(CHUNK)])

    def sides_slope(self, points: Tensor, column: int) -> tuple[Tensor, Tensor]:
        """One of both (N,) and its gradient (N, 3), detached."""
        value, gradient = points.new_empty(len(points)), torch.empty_like(points)
        for start in range(0, len(points), CHUNK):
            with torch.enable_grad():
                x = points[start : start + CHUNK].detach().requires_grad_()
                one = self._sides(self._fixed, x)[:, column]
                (g,) = torch.autograd.grad(one.sum(), x)
            value[start : start + CHUNK], gradient[start : start + CHUNK] = one.detach(), g
        return value, gradient

    def _sides(self, layers: list[Folded], points: Tensor) -> Tensor:
        assert self.sided is not None
        both = self.nets.decoder.outputs(layers, self.nets.to_domain(points)).float() @ self.sided.turn
        return self.nets.shape.reach * torch.stack([both[:, 0], both[:, 1].abs()], 1)


class UdfDecoder:
    """A ``GarmentDecoder`` that knows one kind of its family; and an encoder. Its garments have no panels."""

    name = "udf"

    def __init__(self, nets: UdfNets, codes: Tensor, known: list[Known], kind: str = "", sided: Sided | None = None):
        """
        Args:
            nets: encoder and decoder.
            codes: (n, z) of the whole family.
            known: what each stands for.
            kind: which garments this decoder is for; default: the first code's.
            sided: which side of surfaces is told how, where the networks tell it.
        """
        if len(codes) != len(known):
            raise ValueError(f"{len(codes)} codes but {len(known)} descriptions")
        self.nets = nets.eval().requires_grad_(False)
        self.all_codes, self.known = codes, known
        self._kind = kind or known[0].kind
        self.sided = sided
        rows = [k for k, what in enumerate(known) if what.kind == self._kind]
        self.codes = codes[rows]
        self.variants = [known[k].variant for k in rows]
        self.parameters = [known[k].parameters for k in rows]

    @property
    def kind(self) -> str:
        """Garment kind: top, skirt, trousers or dress."""
        return self._kind

    def to(self, device: str | torch.device) -> UdfDecoder:
        """The same decoder on another device."""
        nets = self.nets.to(device)
        sided = None if self.sided is None else replace(self.sided, turn=self.sided.turn.to(device))
        return UdfDecoder(nets, self.all_codes.to(device), self.known, self._kind, sided)

    def spread(self, points: Tensor) -> Tensor:
        """(N, 3) [m] on the neutral body -> (N, 3) places in the fields' space, where legs that touch are apart."""
        return spread(points, self.nets.shape.apart)

    def field(self, latent: Tensor, half: bool = False) -> LatentField:
        """The distance field of a code (Z,), of spread points; ``half``: faster and coarser, without gradient."""
        return LatentField(self.nets, latent, half, self.sided)

    def decode(self, latent: Tensor, resolution: int = 256) -> Garment:
        """The garment of a code (Z,), on a grid of ``resolution`` cells along the family's longest side, spread.

        Vertices carry the gradient of MeshUDF §3.3, on the surface and on its borders.

        Raises:
            UserError: the code describes no surface.
        """
        shape = self.nets.shape
        with torch.no_grad():
            field, box = self.field(latent.detach(), half=True), Box(shape.low, shape.high)
            meshing = replace(MESHING, resolution=resolution)
            if field.sided is None:
                mesh = mesh_udf(field, box, meshing)
            else:
                mesh = mesh_sides(field, box, replace(meshing, floor=field.sided.border + 0.002), field.sided.border)
        if len(mesh.faces) < 8:
            raise UserError(f"{self.kind}: the code describes no garment; start from a learned code")
        mesh = Mesh(mesh.vertices.to(latent), mesh.faces.to(latent.device))
        return self._garment(latent, self._following(latent, mesh))

    def decode_like(self, latent: Tensor, garment: Garment) -> Garment:
        """``garment`` re-evaluated at a code nearby: same faces, vertices moved to where the field now is zero."""
        mesh = garment.mesh.with_vertices(self.spread(garment.mesh.vertices.detach()))
        frame, own = Frame.of(mesh), latent if garment.latent is None else garment.latent
        with torch.no_grad():
            field, before = self.field(latent.detach()), self.field(own.detach())
            if field.sided is None:
                held = shown(before, mesh, BESIDE, frame)
                mesh = chase(field, before, mesh, BESIDE, frame)
                for _ in range(SETTLE):
                    mesh = follow(field, mesh, BESIDE, frame, held)
            else:
                level = beyond_borders(before, mesh, frame)
                for _ in range(SETTLE):
                    mesh = follow_sides(field, mesh, level, frame, move=True)
        return replace(garment, mesh=self._following(latent, mesh, frame), latent=latent)

    def _following(self, latent: Tensor, mesh: Mesh, frame: Frame | None = None) -> Mesh:
        """A mesh of the fields' space taken back into the world, with the code's gradient where it has one."""
        if latent.requires_grad and torch.is_grad_enabled():
            mesh = self._moving(latent, mesh, frame or Frame.of(mesh))
        return mesh.with_vertices(gathered(mesh.vertices, self.nets.shape.apart))

    def _moving(self, latent: Tensor, mesh: Mesh, frame: Frame) -> Mesh:
        field = self.field(latent)
        if field.sided is None:
            return follow(field, mesh, BESIDE, frame)
        return follow_sides(field, mesh, mesh.vertices.new_zeros(len(frame.border)), frame)

    def _garment(self, latent: Tensor, mesh: Mesh) -> Garment:
        nearest = int((self.codes - latent.detach()).square().sum(1).argmin())
        return replace(Garment.bare(self.kind, mesh), latent=latent, variant=self.variants[nearest])

    @torch.no_grad()
    def encode(self, points: Tensor) -> Tensor:
        """(N, 3) points of a garment's surface [m], in random order -> its code (Z,); N is at least the K neighbours.

        The first ``shape.points`` of them are those that neighbours are taken from, however many there are: what the
        networks call near does not depend on N.
        """
        shape = self.nets.shape
        x = self.nets.to_domain(self.spread(points))
        host = x.cpu().numpy()
        near = cKDTree(host[: shape.points]).query(host, k=shape.neighbours)[1]
        rows = torch.as_tensor(near.astype(np.int32), device=x.device)
        return self.nets.encoder(x[None], rows[None])[0]

    def refine(self, latent: Tensor, points: Tensor, steps: int = 60, rate: float = 0.03) -> Tensor:
        """The code (Z,) near ``latent`` whose field is smallest at surface points (N, 3) [m] and large elsewhere."""
        return refined(self, latent, self.spread(points), self.nets.shape.reach, CodeSearch(steps, rate))


def family_of(kind: str) -> str:
    """The family whose networks know a kind. UserError: no such kind."""
    found = next((name for name, kinds in FAMILIES.items() if kind in kinds), None)
    if found is None:
        raise UserError(
            f"garment kind: found {kind!r}, wanted one of {', '.join(k for v in FAMILIES.values() for k in v)}"
        )
    return found


def load_udf(kind: str, folder: str | Path | None = None, device: str | torch.device = "cpu") -> UdfDecoder:
    """The trained decoder of a garment kind, from ``folder`` or else the packaged weights.

    Raises:
        UserError: no such kind, or weights missing, corrupt or not those of an unsigned distance field.
    """
    name = f"udf-{family_of(kind)}"
    weights = read_weights(name, folder)
    try:
        raw: dict[str, Any] = dict(weights.card["shape"])
        raw.update({k: tuple(v) for k, v in raw.items() if isinstance(v, list)})
        shape = UdfShape(**raw)
        rows = zip(weights.card["kinds"], weights.card["variants"], weights.card["parameters"], strict=True)
        sides = weights.card.get("sides")
        sided = None if sides is None else Sided(torch.tensor(sides["turn"]), float(sides["border"]))
        decoder = build(shape, weights.tensors, [Known(k, v, dict(p)) for k, v, p in rows], kind, sided)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"{name}: weights and card don't describe distance field networks ({error})") from error
    return decoder.to(device)


def build(
    shape: UdfShape, tensors: dict[str, Tensor], known: list[Known], kind: str, sided: Sided | None = None
) -> UdfDecoder:
    """A decoder from its stored parts: ``codes`` and the networks' parameters."""
    nets = UdfNets(shape)
    nets.load_state_dict({k: v for k, v in tensors.items() if k != "codes"})
    return UdfDecoder(nets, tensors["codes"].float(), known, kind, sided)
