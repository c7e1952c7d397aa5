"""Layering by ISP's network D_m: an outer garment moved off what lies beneath it (ISP §3.2, Eq. 9-10, Algorithm 1).

A U-Net reads maps over the outer garment's panels, front and back beside each other: its rest state, its drape and
the forces with which the layer beneath repels it; it writes a map of displacements. Drape and forces are read in frames
that ride on the cloth itself, so that turning the person changes nothing, and forces reach the vertices directly as
well: what is learned is how cloth gives way, not that it must.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.cloth.beneath import MARGIN, Beneath, deepest, repulsion, vertex_normals
from recon.cloth.contact import BodyContact
from recon.cloth.edges import planes
from recon.draping.ending import edges_of
from recon.draping.uv import FLAT_SCALE, Welding
from recon.files.weights import read_weights
from recon.types import Garment, Mesh, UserError

CELL = 0.016
"""Distance of a map's nodes [m]."""
BLOCKS = 4
"""Halvings of the maps inside the network."""
CHANNELS = 26
"""Of a map: presence, force, strain, curvature and place at rest, for both panels."""
FORCE_SCALE = 100.0
"""Brings forces [m] to about one."""
SETTLING, LOOK = 8, 4
"""Rounds of edge projection that end the layering of a garment, and after how many it looks again at what is below:
with twice as many, five layers come no further apart."""


@dataclass(frozen=True)
class Raster:
    """How a garment's vertices and maps over its panels go over into each other."""

    size: tuple[int, int]
    """Nodes along x and y, multiples of 2^BLOCKS."""
    corners: Tensor
    """(2 N, 3) vertices around each node, front panel's map then back panel's."""
    weights: Tensor
    """(2 N, 3) their shares."""
    inside: Tensor
    """(2 N, 1) one where there is cloth, else zero."""
    rest: Tensor
    """(2 N, 3) M_r: the garment at rest less its panels' plane."""
    grid: Tensor
    """(P, 2) panel points as grid_sample counts."""
    panel: Tensor
    """(P,)."""
    welding: Welding

    @classmethod
    def of(cls, garment: Garment) -> Raster:
        """For a garment with panels."""
        points = garment.panel_points.detach().float()
        low, high = points.amin(0) - CELL, points.amax(0) + CELL
        step = 2**BLOCKS
        size = [step * math.ceil(float(n) / CELL / step) for n in (high - low)]
        axes = [low[k] + CELL * torch.arange(size[k]) for k in (0, 1)]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 2)
        found = [_locate(garment, points, nodes, k) for k in (0, 1)]
        corners, weights, inside = (torch.cat(parts) for parts in zip(*found, strict=True))
        rest = (garment.mesh.vertices.detach().float()[corners] * weights[..., None]).sum(1)
        rest = FLAT_SCALE * torch.cat([rest[:, :2] - nodes.repeat(2, 1), rest[:, 2:]], 1) * inside
        grid = 2 * (points - low) / (CELL * (torch.tensor(size) - 1)) - 1
        panel = garment.side_of_point
        return cls((size[0], size[1]), corners, weights, inside, rest, grid, panel, Welding.of(garment))

    def maps(self, values: Tensor) -> Tensor:
        """(B, V, C) at vertices -> (B, 2, C, nx, ny), zero where there is no cloth."""
        found = (values[:, self.corners] * self.weights[..., None]).sum(2) * self.inside
        return self.image(found)

    def image(self, nodes: Tensor) -> Tensor:
        """(B, 2 N, C) at nodes -> (B, 2, C, nx, ny)."""
        return nodes.unflatten(1, (2, *self.size)).permute(0, 1, 4, 2, 3)

    def read(self, maps: Tensor) -> Tensor:
        """(B, 2, C, nx, ny) -> (B, V, C) at vertices, averaged at the seams; what lies outside the cloth has no say."""
        count, inside = len(maps), self.image(self.inside[None])
        maps = torch.cat([maps * inside, inside.expand(count, -1, -1, -1, -1)], 2)
        values = maps.new_zeros(count, len(self.grid), maps.shape[2])
        for k in (0, 1):
            mine = (self.panel == k).nonzero()[:, 0]
            at = self.grid[mine].flip(1)[None, :, None].expand(count, -1, -1, -1)
            found = F.grid_sample(maps[:, k], at.to(maps), align_corners=True)
            values = values.index_add(1, mine, found[..., 0].transpose(1, 2))
        return self.welding(values[..., :-1] / values[..., -1:].clamp_min(0.05))


def _locate(garment: Garment, points: Tensor, nodes: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices (N, 3), shares (N, 3) and presence (N, 1) of the cloth on one side of the body at map nodes (N, 2)."""
    faces = garment.panel_faces[garment.side_of_face == side]
    flat = BodyContact(F.pad(points, (0, 1)), faces)
    face, weights, _ = flat.closest(F.pad(nodes, (0, 1)))
    on = (points[faces[face]] * weights[..., None]).sum(1)
    inside = ((on - nodes).norm(dim=1) < 0.75 * CELL).to(points)
    return garment.vertex_of_point[faces[face]], weights, inside[:, None]


def frames_of(drape: Tensor, inside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Draped maps (B, 2, 3, nx, ny), presence (2, 1, nx, ny) -> slopes along x and y, frames (B, 2, 3, 3, nx, ny).

    The frames' first axis is along x on the panel, the last one points away from the body.
    """

    def slope(dim: int) -> Tensor:
        step = (drape.diff(dim=dim)) / CELL
        both = inside.narrow(dim - 1, 1, inside.shape[dim - 1] - 1) * inside.narrow(
            dim - 1, 0, inside.shape[dim - 1] - 1
        )
        pad = [0, 0, 0, 0]
        pad[2 * (4 - dim)] = 1
        after, count = F.pad(step * both, pad), F.pad(both, pad)
        pad = [0, 0, 0, 0]
        pad[2 * (4 - dim) + 1] = 1
        return (after + F.pad(step * both, pad)) / (count + F.pad(both, pad)).clamp_min(1)

    along, across = slope(3), slope(4)
    side = torch.tensor([1.0, -1.0]).to(drape).view(1, 2, 1, 1, 1)
    out, first = (
        v * v.square().sum(2, keepdim=True).clamp_min(1e-18).rsqrt() for v in (_cross(along, across) * side, along)
    )
    return along, across, torch.stack([first, _cross(out, first), out], 2)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of maps (B, 2, 3, nx, ny)."""
    (ax, ay, az), (bx, by, bz) = a.unbind(2), b.unbind(2)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 2)


def inputs_of(raster: Raster, x: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
    """M_r, M_d and M_f as the network reads them (B, CHANNELS, nx, ny), and the frames (B, 2, 3, 3, nx, ny)."""
    inside = raster.image(raster.inside[None])[0]
    along, across, frames = frames_of(raster.maps(x), inside)
    own = (frames * raster.maps(force)[:, :, None]).sum(3) * FORCE_SCALE
    strain = torch.stack([along.square().sum(2) - 1, across.square().sum(2) - 1, 2 * (along * across).sum(2)], 2).clamp(
        -2, 2
    )
    out = frames[:, :, 2]
    bent = torch.stack([(out.roll(-1, d) - out.roll(1, d)).mul(t).sum(2) for d, t in ((3, along), (4, across))], 2)
    twist = (out.roll(-1, 4) - out.roll(1, 4)).mul(along).sum(2, keepdim=True)
    curvature = torch.cat([bent, twist], 2).clamp(-2, 2)
    rest = raster.image(raster.rest[None]).expand(len(x), -1, -1, -1, -1)
    presence = inside.expand(len(x), -1, -1, -1, -1)
    parts = torch.cat([presence, own, strain * presence, curvature * presence, rest], 2)
    return parts.flatten(1, 2), frames


@dataclass(frozen=True)
class LayeringShape:
    """What is needed to rebuild the network."""

    channels: tuple[int, ...] = (16, 24, 32, 48, 48)
    """At each resolution, the finest first."""
    scale: float = 0.01
    """Displacement [m] that an output of one means."""


class LayeringNet(nn.Module):
    """D_m: a U-Net, maps (B, CHANNELS, nx, ny) -> displacements in the cloth's frames (B, 2, 3, nx, ny) [m]."""

    def __init__(self, shape: LayeringShape | None = None):
        super().__init__()
        self.shape = shape = shape or LayeringShape()
        c = shape.channels

        def conv(a: int, b: int, stride: int = 1) -> nn.Conv2d:
            return nn.Conv2d(a, b, 3, stride, 1)

        self.first = conv(CHANNELS, c[0])
        self.down = nn.ModuleList(conv(c[k], c[k + 1], 2) for k in range(BLOCKS))
        self.inner = nn.ModuleList(conv(c[k + 1], c[k + 1]) for k in range(BLOCKS))
        self.up = nn.ModuleList(conv(c[k + 1] + c[k], c[k]) for k in range(BLOCKS))
        self.out = conv(c[0], 6)
        nn.init.zeros_(self.out.weight)
        assert self.out.bias is not None
        nn.init.zeros_(self.out.bias)

    def forward(self, maps: Tensor) -> Tensor:
        """See the class."""
        levels = [F.silu(self.first(maps))]
        for down, inner in zip(self.down, self.inner, strict=True):
            h = F.silu(down(levels[-1]))
            levels.append(h + F.silu(inner(h)))
        h = levels.pop()
        for up in reversed(self.up):
            h = F.interpolate(h, scale_factor=2.0, mode="nearest")
            h = F.silu(up(torch.cat([h, levels.pop()], 1)))
        return self.shape.scale * self.out(h).unflatten(1, (2, 3))

    def displaced(self, raster: Raster, x: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """An outer layer (B, V, 3) and the forces on it -> where it goes (B, V, 3), and D_m's own part (B, V, 3)."""
        maps, frames = inputs_of(raster, x, force)
        own = self(maps)
        moved = raster.read((frames * own[:, :, :, None]).sum(2))
        return x + force + moved, moved


class Layering:
    """Algorithm 1: any number of garments, draped one by one, layered over each other.

    Each is moved off all that lies beneath it, one after another, and ends in a few rounds of edge projection: cloth
    that was pushed out is stretched, and pushed into one layer by the next.
    """

    def __init__(self, net: LayeringNet | None):
        """``net``: D_m; None: forces alone move the layers."""
        self.net = net.eval().requires_grad_(False) if net is not None else None

    def over(self, raster: Raster | None, outer: Mesh, beneath: Sequence[Beneath]) -> Mesh:
        """One outer garment (B, V, 3) moved off what lies beneath it in each pose; without panels by forces alone."""
        force = repulsion(outer.vertices, outer.faces, beneath)
        if not bool(force.any()):
            return outer
        if self.net is None or raster is None:
            return outer.with_vertices(outer.vertices + force)
        return outer.with_vertices(self.net.displaced(raster, outer.vertices, force)[0])

    @torch.no_grad()
    def __call__(
        self, garments: Sequence[Garment | Mesh], drapes: Sequence[Mesh], body: Mesh | None = None
    ) -> list[Mesh]:
        """The drapes, none beneath those before it.

        Args:
            garments: innermost first, each on the neutral body.
            drapes: each alone on the same B bodies, (B, V, 3).
            body: (B, N, 3), where the body itself shall count as the layer beneath all.
        """
        below = [Beneath.all_of(body)] if body is not None else []
        done = list[Mesh]()
        for garment, drape in zip(garments, drapes, strict=True):
            raster = Raster.of(garment) if isinstance(garment, Garment) else None
            moved = drape
            for layer in below:
                moved = self.over(raster, moved, layer)
            if moved is not drape:
                moved = settled(garment, moved, below)
            done.append(moved)
            below.append(Beneath.all_of(moved))
        return done


def settled(garment: Garment | Mesh, outer: Mesh, below: Sequence[Sequence[Beneath]]) -> Mesh:
    """A garment (B, V, 3) that was moved off the layers below, edges drawn to their lengths again above them all."""

    def beside(x: Tensor) -> Tensor:
        normals = vertex_normals(x, outer.faces)
        found = [deepest([layer[b] for layer in below], x[b], normals[b]) for b in range(len(x))]
        points, out = (torch.stack(part) for part in zip(*found, strict=True))
        return planes(points, out, MARGIN)

    return outer.with_vertices(edges_of(garment, SETTLING)(outer.vertices, beside, LOOK))


def load_layering(folder: str | Path | None = None) -> Layering:
    """The layering with the network ``layers-isp`` of a weights folder, or else the packaged one.

    Raises:
        UserError: weights missing or corrupt, or not of such a network.
    """
    weights = read_weights("layers-isp", folder)
    try:
        net = LayeringNet(
            LayeringShape(**{**weights.card["shape"], "channels": tuple(weights.card["shape"]["channels"])})
        )
        net.load_state_dict({k: v.float() for k, v in weights.tensors.items()})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"layers-isp: weights and card don't describe a layering network ({error})") from error
    return Layering(net)
