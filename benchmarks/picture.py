"""The README's picture from a finished run: photo, overlay, the dressed body from two sides, and the patterns.

python benchmarks/picture.py out/demo examples/photos/man-hoodie-trousers.jpg --garments top,trousers
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from pipelines.report import colour_of
from recon.render.shade import orbit_camera, picture
from recon.types import Mesh

HEIGHT = 620
ROOT = Path(__file__).resolve().parent.parent


def read(path: Path) -> tuple[Mesh, NDArray, NDArray]:
    """An OBJ's mesh, and its flat triangles (F, 3, 2) in pattern coordinates with their panel (F,)."""
    found = trimesh.load(path, process=False, force="mesh")
    mesh = Mesh(torch.tensor(found.vertices, dtype=torch.float32), torch.tensor(found.faces))
    uv = getattr(found.visual, "uv", None)
    if uv is None:
        return mesh, np.zeros((0, 3, 2)), np.zeros(0)
    flat = np.asarray(uv)[found.faces]
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return mesh, flat, (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] < 0).astype(int)


def draw_panels(flat: NDArray, side: NDArray, colours: Sequence, size: tuple[int, int], panel: NDArray) -> NDArray:
    """Front and back beside each other, filled, outlined; (h, w, 3) BGR.

    Args:
        flat: (F, 3, 2) triangles in the plane.
        side: (F,) 0 = front, 1 = back.
        colours: of each panel.
        size: (h, w).
        panel: (F,) index into ``colours``.
    """
    h, w = size
    image = np.full((h, w, 3), 255, np.uint8)
    low, high = flat.min((0, 1)), flat.max((0, 1))
    scale = 0.9 * min(w / 2 / (high - low)[0], h / (high - low)[1])
    for k, number in sorted(set(zip(side.tolist(), panel.tolist(), strict=True))):
        tint = np.array(colours[number][::-1]) * 255
        centre = np.array([(k + 0.5) * w / 2, h / 2])
        pixels = (flat[(side == k) & (panel == number)] - (low + high) / 2) * [scale, -scale] + centre
        mask = np.zeros((h, w), np.uint8)
        for triangle in np.round(pixels * 16).astype(np.int32):
            cv2.fillConvexPoly(mask, triangle, 255, shift=4)
        image[mask > 0] = 0.3 * tint + 0.7 * 255
        outline, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, (0.6 * tint).tolist(), 3, cv2.LINE_AA)
    return image


def main() -> None:
    """Write docs/images/demo.png."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--garments", default="top,trousers")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "demo.png")
    options = parser.parse_args()
    names = options.garments.split(",")
    body, _, _ = read(options.folder / "body.obj")
    worn = [read(options.folder / f"{name}.obj") for name in names]
    overlay = cv2.imread(str(options.folder / "overlay.png"))
    photo = cv2.resize(cv2.imread(str(options.photo)), overlay.shape[1::-1], interpolation=cv2.INTER_AREA)
    changed = np.abs(photo.astype(int) - overlay).sum(2) > 30
    ys, xs = np.nonzero(cv2.erode(changed.astype(np.uint8), np.ones((3, 3), np.uint8)))
    pad = int(0.22 * (ys.max() - ys.min()))
    rows = slice(max(0, ys.min() - pad), ys.max() + pad // 2)
    cut = [image[rows, max(0, xs.min() - pad // 2) : xs.max() + pad // 2] for image in (photo, overlay)]
    sizes = [(round(c.shape[1] * HEIGHT / c.shape[0]), HEIGHT) for c in cut]
    parts = [cv2.resize(c, size, interpolation=cv2.INTER_AREA) for c, size in zip(cut, sizes)]
    meshes = [body, *[mesh for mesh, _, _ in worn]]
    colours = [colour_of(name) for name in ("body", *names)]
    for azimuth in (0.0, 0.9, math.pi):
        camera = orbit_camera(meshes, azimuth, 0.0, (HEIGHT, 360))
        parts.append(picture(meshes, colours, camera).numpy()[..., ::-1])
    share = HEIGHT // len(names)
    sheets = [
        draw_panels(flat, side, [colour_of(n)] * 2, (share, 480), side) for n, (_, flat, side) in zip(names, worn)
    ]
    parts.append(cv2.resize(np.vstack(sheets), (480, HEIGHT)))
    cv2.imwrite(str(options.out), np.hstack(parts))


if __name__ == "__main__":
    main()
