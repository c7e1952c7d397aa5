"""What every fit of a garment's code needs, whatever the evidence: where to start, and decoding as the code moves."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from recon.garments import GarmentDecoder
from recon.garments.latents import nearest, spread
from recon.types import Garment


def retrieved(
    codes: Tensor,
    allowed: Tensor,
    score: Callable[[int], float],
    count: int,
    tick: Callable[[int, float], None] | None = None,
) -> Tensor:
    """Learned codes by their score, best first.

    A first round looks at codes that cover all allowed ones, a second at the neighbours of its best: with few codes
    that is all of them.

    Args:
        codes: (n, z) learned codes.
        allowed: (k,) indices of those that may be chosen.
        score: index -> how well the code fits the evidence, 1 at best.
        count: codes that the first round compares; the second compares as many.
        tick: hears (codes compared, 1 - best score).

    Returns:
        (m,) indices of those compared.
    """
    scores = {int(i): score(int(i)) for i in spread(codes, count, allowed)}
    for index in sorted(scores, key=scores.__getitem__, reverse=True)[:3]:
        near = nearest(codes[allowed], codes[index], count // 3)
        scores |= {i: score(i) for i in allowed[near].tolist() if i not in scores}
    if tick:
        tick(len(scores), 1 - max(scores.values()))
    return torch.tensor(sorted(scores, key=scores.__getitem__, reverse=True))


class Decoding:
    """Garments of a code that moves: topology is kept for a few steps, since cutting and sewing cost most of it."""

    def __init__(self, decoder: GarmentDecoder, resolution: int, refresh: int):
        """
        Args:
            decoder: of the garment's kind.
            resolution: of the decoded garments.
            refresh: steps for which a topology is kept.
        """
        self.decoder, self.resolution, self.refresh = decoder, resolution, refresh
        self._shape: Garment | None = None
        self._cut_at, self._age = decoder.codes[0], 0
        self._reach = 0.3 * decoder.codes.std(0).norm().item()

    def __call__(self, latent: Tensor) -> Garment:
        """The garment of a code (z,). UserError: the code describes none."""
        moved = bool((latent.detach() - self._cut_at).norm() > self._reach)
        if self._shape is None or moved or self._age >= self.refresh:
            self._shape = self.decoder.decode(latent, self.resolution)
            self._cut_at, self._age = latent.detach(), 0
            return self._shape
        self._age += 1
        return self.decoder.decode_like(latent, self._shape)
