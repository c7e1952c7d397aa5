"""A flat sheet as a garment, for tests of physics."""

import numpy as np
import torch

from recon.types import Garment, Mesh


def sheet(nx: int, ny: int, width: float, height: float) -> Garment:
    """A flat rectangle as a garment of one panel, float64."""
    x, y = np.meshgrid(np.linspace(0, width, nx + 1), np.linspace(0, height, ny + 1), indexing="ij")
    points = torch.tensor(np.stack([x.ravel(), y.ravel()], 1))
    corner = [(i * (ny + 1) + j) for i in range(nx) for j in range(ny)]
    faces = [[c, c + ny + 1, c + ny + 2] for c in corner] + [[c, c + ny + 2, c + 1] for c in corner]
    f = torch.tensor(faces)
    vertices = torch.cat([points, torch.zeros(len(points), 1, dtype=torch.float64)], 1)
    labels = torch.full((len(points),), -1)
    return Garment("top", Mesh(vertices, f), points, f, torch.zeros(len(f)).long(), torch.arange(len(points)), labels)
