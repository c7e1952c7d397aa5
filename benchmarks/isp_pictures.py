"""Pictures of decoded garments: the panels above, the garment on the neutral body below, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from picture import draw_panels

from recon.bodies import load_body
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Garment, Mesh

SKIN = (0.86, 0.69, 0.58)
COLOUR = (0.27, 0.51, 0.76)
FAST = Look(samples=4, sky_rays=3, lamp_rays=1)


def neutral() -> Mesh:
    """The neutral body in the T pose."""
    body = load_body()
    return Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)


def panels_of(garment: Garment, size: tuple[int, int]) -> NDArray:
    """(h, w, 3) BGR drawing of both panels."""
    flat = garment.panel_points.detach().numpy()[garment.panel_faces.numpy()]
    return draw_panels(flat, garment.panel_of_face.numpy(), COLOUR, size)


def column(
    garment: Garment, body: Mesh, caption: str, size: tuple[int, int] = (300, 330), azimuth: float = 0.0
) -> NDArray:
    """(h, w, 3) BGR: caption, panels, picture."""
    h, w = size
    shown = [body, garment.mesh.with_vertices(garment.mesh.vertices.detach())]
    image = picture(shown, [SKIN, COLOUR], orbit_camera(shown, azimuth, 0.0, (h, w)), look=FAST).numpy()[..., ::-1]
    head = np.full((26, w, 3), 255, np.uint8)
    cv2.putText(head, caption, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([head, panels_of(garment, (h // 2, w)), image])


def sheet(
    garments: Sequence[Garment], captions: Sequence[str], size: tuple[int, int] = (300, 330), azimuth: float = 0.0
):
    """(h, w, 3) BGR: columns side by side."""
    body = neutral()
    with torch.no_grad():
        return np.hstack([column(g, body, c, size, azimuth) for g, c in zip(garments, captions, strict=True)])
