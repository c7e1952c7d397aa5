"""Scans of known truth: test garments that no decoder has seen, on random bodies, seen by cameras all around.

    python benchmarks/made_scans.py OUT --cases 3      # writes scan.ply, labels.npz and truth.npz per case

A scanner sees surfaces, not what lies beneath them: points come from the first hits of a ring of cameras. Noise is
Gaussian; holes are balls cut out of the cloud. The truth (body, pose, every garment whole) is kept.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.bodies import Body
from recon.bodies.clearance import clear_bodies
from recon.bodies.pose_prior import mean_pose, sample_poses
from recon.bodies.poses import a_pose, t_pose
from recon.draping import Draper
from recon.draping.dress import dress, neutral
from recon.garments import NAMES
from recon.garments.dataset import load_garments
from recon.garments.grading import grade
from recon.render.hits import first_hit
from recon.types import BodyPose, Camera, Garment, Mesh, Scan

OUTFITS = (("top", "trousers"), ("top", "skirt"), ("dress",), ("jacket", "trousers"), ("tshirt", "shorts"))
POSES = ("a", "t", "standing", "random")


@dataclass(frozen=True)
class Scanner:
    """How a made scan is taken."""

    cameras: int = 12
    """Around the person, at two heights in turn."""
    pixels: int = 220
    """Height of each camera's picture."""
    points: int = 24000
    """Points kept, at most."""
    noise: float = 0.0015
    """Standard deviation of each coordinate [m]."""
    holes: int = 6
    """Balls cut out of the cloud."""
    hole_radius: float = 0.05
    """Their largest radius [m]."""


@dataclass(frozen=True)
class MadeScan:
    """A scan and what it was made from."""

    scan: Scan
    body: BodyPose
    body_mesh: Mesh
    garments: dict[str, Mesh]
    """Name -> the whole garment as worn, outermost first."""
    pose: str


def random_body(body: Body, pose: str, generator: torch.Generator) -> BodyPose:
    """A random shape in the named pose (some degrees off it), turned anywhere about the vertical, somewhere.

    Random angles push limbs through the trunk, where no scanner finds them: they are turned out of it.
    """
    shape = 0.7 * torch.randn(1, body.n_shape, generator=generator)
    away = 0.15 if pose != "random" else 0.8
    base = {"a": a_pose(1, 45.0), "t": t_pose(1), "standing": a_pose(1, 68.0), "random": mean_pose(1)}[pose]
    joints = base + away * (sample_poses(1, generator) - mean_pose(1))
    turn, place = (torch.rand(1, generator=generator) - 0.5).item(), torch.randn(3, generator=generator)
    joints[0, 0] = torch.tensor([0.0, 2 * math.pi * turn, 0.0])
    return clear_bodies(BodyPose(shape, joints, (place * torch.tensor([0.3, 0.05, 0.3]))[None]), body)


def test_garment(name: str, number: int) -> Garment:
    """A garment of the test split that the name allows."""
    kind, variants = NAMES[name]
    tests = [g for g in load_garments(kind, "test") if g.variant in variants]
    return tests[number % len(tests)]


def dressed(outfit: tuple[str, ...], number: int, place: BodyPose, body: Body, draper: Draper) -> dict[str, Mesh]:
    """Test garments graded to the body, put on and carried into its pose by simulation; outermost first."""
    with torch.no_grad():
        unposed, garments = body.pose(neutral(place)), []
        for name in outfit:
            garment = test_garment(name, number)
            garments.append(grade(garment, draper.drape(garment, unposed).vertices[0]))
        worn = dress(garments, body, place, draper)
    return {n: Mesh(torch.from_numpy(x).float(), g.mesh.faces) for n, x, g in zip(outfit, worn, garments, strict=True)}


def make_scan(
    outfit: tuple[str, ...], number: int, pose: str, body: Body, draper: Draper, scanner: Scanner | None = None
) -> MadeScan:
    """One dressed random person, scanned; the same arguments give the same scan."""
    generator = torch.Generator().manual_seed(7000 + number)
    place = random_body(body, pose, generator)
    with torch.no_grad():
        posed = body.pose(place)
    skin = Mesh(posed.mesh.vertices[0], body.faces)
    garments = dressed(outfit, number, place, body, draper)
    return MadeScan(seen_points(skin, garments, scanner or Scanner(), generator), place, skin, garments, pose)


def seen_points(skin: Mesh, garments: dict[str, Mesh], scanner: Scanner, generator: torch.Generator) -> Scan:
    """The points that cameras around see, with noise and holes; labels 0 = body, 1 ... = garments."""
    meshes = [skin, *garments.values()]
    points, labels = [], []
    for camera in _around(skin, scanner):
        hit = first_hit(meshes, camera)
        for index, mesh in enumerate(meshes):
            at = hit.mesh == index
            corners = mesh.vertices[mesh.faces[hit.face[at]]]
            points.append((corners * hit.barycentric[at][..., None]).sum(1))
            labels.append(torch.full((len(corners),), index))
    x, label = torch.cat(points), torch.cat(labels)
    keep = torch.randperm(len(x), generator=generator)[: scanner.points]
    x, label = x[keep], label[keep]
    centres = x[torch.randint(len(x), (scanner.holes,), generator=generator)]
    radii = scanner.hole_radius * (0.5 + 0.5 * torch.rand(scanner.holes, generator=generator))
    left = (torch.cdist(x, centres) > radii).all(1)
    x = x[left] + scanner.noise * torch.randn(int(left.sum()), 3, generator=generator)
    return Scan(x, label[left], ("body", *garments))


def _around(skin: Mesh, scanner: Scanner):
    """Cameras on a ring 2.5 m away, level and from above in turn."""
    middle = (skin.vertices.amin(0) + skin.vertices.amax(0)) / 2
    size = (scanner.pixels, scanner.pixels)
    focal = 1.15 * scanner.pixels
    K = torch.tensor([[focal, 0, scanner.pixels / 2], [0, focal, scanner.pixels / 2], [0, 0, 1]])
    for k in range(scanner.cameras):
        turn, lift = 2 * math.pi * k / scanner.cameras, (0.0, 0.6)[k % 2]
        back = torch.tensor(
            [math.sin(turn) * math.cos(lift), math.sin(lift), math.cos(turn) * math.cos(lift)], dtype=torch.float32
        )
        right = torch.tensor([math.cos(turn), 0.0, -math.sin(turn)])
        R = torch.stack([right, torch.linalg.cross(right, back), -back])
        yield Camera(K, R, -R @ (middle + 2.5 * back), size)


def write_case(made: MadeScan, folder: Path) -> None:
    """``scan.ply``, ``labels.npz`` (0 = body, 1 ... = garments in order) and ``truth.npz``."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    trimesh.PointCloud(made.scan.points.numpy()).export(folder / "scan.ply")
    np.savez_compressed(folder / "labels.npz", labels=made.scan.labels.numpy())
    parts: dict[str, Tensor] = {"shape": made.body.shape, "pose": made.body.pose, "translation": made.body.translation}
    for name, mesh in {"body": made.body_mesh, **made.garments}.items():
        parts |= {f"{name}.vertices": mesh.vertices, f"{name}.faces": mesh.faces}
    np.savez_compressed(folder / "truth.npz", **{k: v.numpy() for k, v in parts.items()})


def main() -> None:
    """Write cases of all outfits and poses in turn."""
    from recon.bodies import load_body
    from recon.draping.skinning import SkinningDraper

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cases", type=int, default=3)
    args = parser.parse_args()
    body = load_body()
    draper = SkinningDraper(body)
    for number in range(args.cases):
        outfit, pose = OUTFITS[number % len(OUTFITS)], POSES[number % len(POSES)]
        write_case(make_scan(outfit, number, pose, body, draper), args.out / f"{number}-{'-'.join(outfit)}-{pose}")


if __name__ == "__main__":
    main()
