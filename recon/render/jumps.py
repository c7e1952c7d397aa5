"""Where a label image jumps: the visible parts of silhouettes, pixel by pixel, with what is seen on their two sides.

Each line is cut into pieces of at most a given length; what is seen beside a piece's two ends is asked for. Where the
answers agree they hold for the piece. Where they differ, something else begins or ends to hide the line: there the
piece is cut again, finer. Pieces with a jump are then cut at the borders of pixels: each counts for the one it is in.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.render.edges import Lines
from recon.render.raster import Raster

HAIR = 1e-5
"""How far to either side of a line the image is asked for a jump [px].

Wider counts edges twice that nearly coincide in the image; doubles resolve 1e-12 px.
"""
FINER = 8
"""Into as many parts is a piece cut whose ends see different things."""
INSET = 0.02
"""How far from a line's end its outermost points stay, in pieces: right at a vertex other edges interfere."""
LONGEST = 4096
"""Most pieces of one line."""


@dataclass(frozen=True)
class Jumps:
    """Straight pieces across which the label changes, none of them reaching from one pixel to another."""

    row: Tensor
    """(N,) long, of its pixel."""
    column: Tensor
    """(N,) long, of its pixel."""
    ahead: Tensor
    """(N,) long, value that is seen on the normal's side of the line."""
    behind: Tensor
    """(N,) long, value on the other side."""
    vertices: Tensor
    """(N, 2) long, the edge's vertices."""
    motion: Tensor
    """(N, 2, 3) area [px²] swept towards the normal, per motion of either vertex's homogeneous point."""


@dataclass(frozen=True)
class _Pieces:
    """Parts of lines."""

    line: Tensor
    """(N,) long, number of the line."""
    start: Tensor
    """(N,) where they start and end on it."""
    stop: Tensor

    def of(self, which: Tensor) -> _Pieces:
        return _Pieces(self.line[which], self.start[which], self.stop[which])

    def cut(self, parts: int) -> _Pieces:
        """Each in as many equal parts, one after the other."""
        rank = torch.arange(parts, device=self.line.device) / parts
        length = (self.stop - self.start)[:, None]
        start = self.start[:, None] + rank * length
        return _Pieces(self.line.repeat_interleave(parts), start.reshape(-1), (start + length / parts).reshape(-1))


def jumps(raster: Raster, lines: Lines, size: tuple[int, int], step: float) -> Jumps:
    """The jumps along the lines on (h, w) = ``size`` pixels, from pieces of at most ``step`` px."""
    pieces, order = _pieces(lines, step)
    ahead, behind = _beside_ends(raster, lines, pieces, order, size)
    same = (ahead[:, 0] == ahead[:, 1]) & (behind[:, 0] == behind[:, 1])
    whole = same & (ahead[:, 0] != behind[:, 0])
    fine = pieces.of(~same).cut(FINER)
    fine_ahead, fine_behind = _beside(raster, lines, fine.line, (fine.start + fine.stop) / 2, size)
    jump = fine_ahead != fine_behind
    both = (pieces.of(whole), fine.of(jump))
    found = _Pieces(*(torch.cat([getattr(part, name) for part in both]) for name in ("line", "start", "stop")))
    sides = (torch.cat([ahead[whole, 0], fine_ahead[jump]]), torch.cat([behind[whole, 0], fine_behind[jump]]))
    return _in_pixels(lines, found, sides, size)


def _pieces(lines: Lines, step: float) -> tuple[_Pieces, Tensor]:
    """Equal parts of the seen part of each line; and (N,) how many lines with any parts there are before each's."""
    span = lines.stop - lines.start
    counts = torch.where(span > 0, (lines.length * span / step).ceil().clamp(1, LONGEST), 0.0).long()
    line = torch.repeat_interleave(counts)
    rank = torch.arange(len(line), device=line.device) - (counts.cumsum(0) - counts)[line]
    part = (span / counts.clamp_min(1))[line]
    start = lines.start[line] + rank * part
    return _Pieces(line, start, start + part), ((counts > 0).cumsum(0) - 1)[line]


def _beside_ends(
    raster: Raster, lines: Lines, pieces: _Pieces, order: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """What is seen ahead of and behind the two ends of each piece: (N, 2) each. Neighbours share an end."""
    n = len(pieces.line)
    if n == 0:
        return order.new_zeros(0, 2), order.new_zeros(0, 2)
    first = torch.arange(n, device=order.device) + order  # number of each piece's first end, then of its second
    last_of_line = torch.ones(n, dtype=torch.bool, device=order.device)
    last_of_line[:-1] = pieces.line[1:] != pieces.line[:-1]
    first_of_line = last_of_line.roll(1)
    length = pieces.stop - pieces.start
    line = order.new_empty(int(first[-1]) + 2)
    at = length.new_empty(len(line))
    line[first], line[first + 1] = pieces.line, pieces.line
    at[first + 1] = pieces.stop - torch.where(last_of_line, INSET * length, 0.0)
    at[first[first_of_line]] = (pieces.start + INSET * length)[first_of_line]
    ahead, behind = _beside(raster, lines, line, at, size)
    ends = torch.stack([first, first + 1], 1)
    return ahead[ends], behind[ends]


def _beside(raster: Raster, lines: Lines, line: Tensor, at: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    return raster.seen_beside(lines.position(line, at), HAIR * lines.normal[line], size)


def _in_pixels(lines: Lines, pieces: _Pieces, sides: tuple[Tensor, Tensor], size: tuple[int, int]) -> Jumps:
    """Cut where lines of the pixel grid cross (one each way, as pieces are no longer than a pixel)."""
    half = pieces.start.new_tensor([size[1] / 2, size[0] / 2])
    one, two = (lines.position(pieces.line, at) + half for at in (pieces.start, pieces.stop))
    border = torch.maximum(one.floor(), two.floor())
    crossed = one.floor() != two.floor()
    where = torch.where(crossed, (border - one) / torch.where(crossed, two - one, 1.0), 0.0)
    zero = torch.zeros_like(pieces.start)
    cuts = torch.stack([zero, where.amin(1), where.amax(1), zero + 1], 1)
    length = (cuts[:, 1:] - cuts[:, :-1]).reshape(-1)
    middle = ((cuts[:, 1:] + cuts[:, :-1]) / 2).reshape(-1)
    kept = torch.nonzero(length > 0)[:, 0]
    source = kept // 3
    line, part = pieces.line[source], (pieces.stop - pieces.start)[source]
    at = pieces.start[source] + middle[kept] * part
    position, normal = lines.position(line, at), lines.normal[line]
    column, row = ((position + half).floor().long()).unbind(1)
    along = torch.cat([normal, -(normal * position).sum(1, keepdim=True)], 1)
    weight = length[kept] * part * lines.length[line]
    motion = (weight[:, None] * lines.share(line, at))[..., None] * along[:, None]
    inside = (row.clamp(0, size[0] - 1), column.clamp(0, size[1] - 1))
    return Jumps(*inside, sides[0][source], sides[1][source], lines.vertices[line], motion)
