"""The photo as fitting sees it: the person's window, its masks at one resolution, and the camera of that window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.losses import outside_distance
from recon.types import Camera, Photo


@dataclass(frozen=True)
class Level:
    """Evidence at one resolution of the coarse-to-fine fit."""

    names: tuple[str, ...]
    """Garment names, outermost first: the order of ``targets``."""
    targets: Tensor
    """(L, h, w) wanted coverage in [0, 1]."""
    person: Tensor
    """(h, w) coverage of the person in [0, 1]."""
    weight: Tensor
    """(h, w) in [0, 1]: 0 where hair, hands or things held in front hide the garments."""
    fields: Tensor
    """(L, h, w) distance to each mask in units of the image's height, 0 inside."""
    window: tuple[float, float, float, float]
    """x0, y0, x1, y1 of the window in pixels of the photo."""

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)"""
        return self.person.shape[-2], self.person.shape[-1]

    def camera(self, camera: Camera) -> Camera:
        """The photo's camera cut to the window and scaled to this level's pixels; differentiable in the camera."""
        x0, y0, x1, y1 = self.window
        h, w = self.size
        scale = camera.K.new_tensor([[w / (x1 - x0)], [h / (y1 - y0)], [1.0]])
        shift = torch.zeros_like(camera.K)
        shift[0, 2], shift[1, 2] = x0, y0
        return replace(camera, K=(camera.K - shift) * scale, size=(h, w))

    def pick(self, names: tuple[str, ...]) -> Level:
        """Only the named garments, in the given order."""
        at = [self.names.index(n) for n in names]
        return replace(self, names=tuple(names), targets=self.targets[at], fields=self.fields[at])


def person_window(photo: Photo, margin: float = 0.12) -> tuple[float, float, float, float]:
    """The box of person and garments with a margin (share of its longer side), clipped to the photo."""
    on = photo.person > 0.5
    for mask in photo.garments.values():
        on = on | mask
    ys, xs = torch.where(on)
    x0, x1, y0, y1 = (int(xs.min()), int(xs.max()) + 1, int(ys.min()), int(ys.max()) + 1)
    pad = int(margin * max(x1 - x0, y1 - y0)) + 1
    h, w = on.shape
    return max(0, x0 - pad), max(0, y0 - pad), min(w, x1 + pad), min(h, y1 + pad)


def level(photo: Photo, long_side: int) -> Level:
    """Resample the photo's masks to the person's window with ``long_side`` pixels on its longer side (area average)."""
    x0, y0, x1, y1 = (int(v) for v in person_window(photo))
    scale = long_side / max(x1 - x0, y1 - y0)
    size = (max(8, round((y1 - y0) * scale)), max(8, round((x1 - x0) * scale)))

    def shrink(mask: Tensor) -> Tensor:
        cut = mask[y0:y1, x0:x1].to(torch.float32)[None, None]
        return F.interpolate(cut, size, mode="area")[0, 0]

    names = tuple(photo.garments)
    targets = torch.stack([shrink(photo.garments[n]) for n in names])
    return Level(
        names=names,
        targets=targets,
        person=shrink(photo.person),
        weight=1 - shrink(photo.ignore),
        fields=torch.stack([outside_distance(t > 0.5) for t in targets]),
        window=(float(x0), float(y0), float(x1), float(y1)),
    )
