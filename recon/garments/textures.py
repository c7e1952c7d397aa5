"""Textures drawn on panels (ISP A.1): one square a side of the body, shared by all garments of a kind.

The image is twice as wide as high: the front's domain left, the back's right, both as seen from outside and upright.
Since panels of all garments lie in one domain, a drawing on one garment's panels is at its place on every other's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from recon.garments.isp_net import IspShape
from recon.types import Garment, Mesh

SIDE = 1024
"""Pixels of a template's height."""


@dataclass(frozen=True)
class Sheet:
    """Where on the panels' plane a texture lies."""

    centre: tuple[float, float]
    """Panel coordinates of the squares' middle [m]."""
    half: float
    """Half their side [m]."""

    @staticmethod
    def of(shape: IspShape) -> Sheet:
        """The domain of a decoder."""
        return Sheet(shape.centre, shape.half)

    def coordinates(self, garment: Garment) -> Tensor:
        """(P, 2) place of each panel point in the image, both in [0, 1]: from the left, from the top."""
        x, y = ((garment.panel_points.detach() - garment.panel_points.new_tensor(self.centre)) / self.half).unbind(1)
        back = garment.side_of_point == 1
        across = torch.where(back, 0.75 - x / 4, 0.25 + x / 4)  # the back is seen from behind
        return torch.stack([across, 0.5 - y / 2], 1)


def colours_at(texture: Tensor, coordinates: Tensor) -> Tensor:
    """(P, 3) bilinear colours of an image (h, w, 3) at places (P, 2) in [0, 1] from left and top."""
    grid = (coordinates * 2 - 1)[None, None].to(texture)
    found = F.grid_sample(texture.permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border")
    return found[0, :, 0].T


def unsewn(garment: Garment) -> Mesh:
    """The garment's surface with one vertex a panel point (P, 3): what texture coordinates belong to."""
    return Mesh(garment.mesh.vertices.detach()[garment.vertex_of_point], garment.panel_faces)


def template(garment: Garment, sheet: Sheet) -> NDArray[np.uint8]:
    """(SIDE, 2 SIDE, 3) BGR: all panels' outlines, to be drawn on."""
    image = np.full((SIDE, 2 * SIDE, 3), 255, np.uint8)
    pixels = sheet.coordinates(garment).numpy() * [2 * SIDE, SIDE]
    for panel in range(len(garment.panel_names)):
        mask = np.zeros(image.shape[:2], np.uint8)
        for triangle in pixels[garment.panel_faces[garment.panel_of_face == panel].numpy()]:
            cv2.fillConvexPoly(mask, np.round(triangle * 16).astype(np.int32), 255, shift=4)
        image[mask > 0] = (245, 240, 232)
        outline, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, (120, 110, 100), 2, cv2.LINE_AA)
    return image
