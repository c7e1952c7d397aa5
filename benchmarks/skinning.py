"""GAPS Fig. 8 and 9 on our garments: how each way of skinning carries a loose and a tight garment, side by side.

python benchmarks/skinning.py                 # to docs/results/skinning.png, and a line of figures per method
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from recon.bodies import load_body
from recon.draping.binding import METHODS
from recon.draping.gaps import Bound
from recon.garments.dataset import load_garments
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Mesh

ORDER = ("nearest", "k_nearest", "smoothed", "gaps", "rbf")
GARMENTS = {"dress": 6, "top": 7}
OUT = Path(__file__).resolve().parent.parent / "docs" / "results" / "skinning.png"


def striding(body):
    """A body in mid-stride, arms lowered."""
    pose = body.neutral()
    pose.pose[0, 1, 0], pose.pose[0, 2, 0], pose.pose[0, 4, 0] = -0.7, 0.35, 0.4
    pose.pose[0, 16, 2], pose.pose[0, 17, 2] = -1.0, 1.0
    return pose


def stretch(rest: Mesh, x: torch.Tensor) -> torch.Tensor:
    """(E,) length of each edge in units of its length at rest."""
    ends = torch.cat([rest.faces[:, [0, 1]], rest.faces[:, [1, 2]], rest.faces[:, [2, 0]]]).sort(1).values.unique(dim=0)
    lengths = [(p[ends[:, 0]] - p[ends[:, 1]]).norm(dim=1) for p in (rest.vertices, x)]
    return lengths[1] / lengths[0]


def main() -> None:
    """Skin, measure and draw."""
    body = load_body()
    pose = striding(body)
    with torch.no_grad():
        posed = body.pose(pose)
    rows = []
    for kind, number in GARMENTS.items():
        rest = load_garments(kind, "test")[number].mesh
        views = []
        for method in ORDER:
            assert method in METHODS
            bound = Bound.of(rest.vertices, rest.faces, body, method)
            with torch.no_grad():
                x = bound.place(torch.zeros(1, *rest.vertices.shape), posed.transforms, pose.shape)[0]
            s = stretch(rest, x)
            mean, far = float((s - 1).abs().mean()), float(s.quantile(0.999))
            print(f"{kind:6} {method:10} edges {100 * mean:5.2f} % off, 99.9th percentile {far:.2f} times")
            meshes = [Mesh(posed.mesh.vertices[0], body.faces), Mesh(x, rest.faces)]
            camera = orbit_camera(meshes, 0.5, 0.05, (420, 280))
            colours = [(0.86, 0.69, 0.58), (0.27, 0.51, 0.76)]
            shot = picture(meshes, colours, camera, look=Look(samples=4, sky_rays=4)).numpy().copy()
            cv2.putText(shot, method, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (60, 60, 60), 1, cv2.LINE_AA)
            views.append(shot)
        rows.append(np.concatenate(views, 1))
    cv2.imwrite(str(OUT), np.concatenate(rows)[..., ::-1])


if __name__ == "__main__":
    main()
