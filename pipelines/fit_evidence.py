"""Evidence for a latent code: a flat pattern, a mesh, a point cloud, or the silhouette of the worn garment.

All energies are in about the same unit, 4 x the mean misfit over half the domain's side, so that one prior suits all.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.codes import retrieved
from pipelines.isp_samples import Border, Outline, on_border, panel_border, signed_distance
from recon.bodies import load_body
from recon.cloth.contact import BodyContact
from recon.files.masks import read_mask
from recon.files.meshes import read_mesh
from recon.files.points import read_points
from recon.garments.isp import IspDecoder
from recon.garments.panels import border_edges
from recon.losses import chamfer_pull, hard_iou, outside_distance, soft_iou_loss
from recon.metrics import boundary_loops, sample_surface, surface_distance
from recon.render.labels import LabelRenderer
from recon.render.shade import orbit_camera
from recon.types import Camera, Garment, Mesh, UserError

SCALE = 4.0
"""Energy of a mean misfit as large as half the domain's side."""
SOFT = 1e-3
"""Distances below this count by their square, above by themselves [m]."""
CANDIDATES = 5
"""Learned codes handed to the search as starts."""
BANK_RESOLUTION = 48
"""Cells of the grid on which learned garments are decoded to choose starts."""


class PatternEvidence:
    """Flat panels: their signed distances and border labels (Eq. 2; Eq. 12 with distances signed)."""

    def __init__(self, decoder: IspDecoder, panels: list[Border] | list[Outline], count: int = 350, seed: int = 0):
        """``panels``: one border each, domain units; ``count`` points near each border are looked at."""
        rng = np.random.default_rng(seed)
        near = [on_border(b, rng, count)[2] + rng.normal(size=(count, 2)) * 0.02 for b in panels]
        at = np.concatenate([*near, rng.uniform(-1, 1, (count // 2, 2))])
        measured = [signed_distance(b, at) for b in panels]
        self.decoder = decoder
        self.at = torch.as_tensor(at, dtype=torch.float32)
        self.distance = torch.as_tensor(np.stack([d for d, _ in measured], 1), dtype=torch.float32)
        labels = torch.as_tensor(np.stack([c for _, c in measured], 1))
        self.label = labels if all(isinstance(b, Border) for b in panels) else None
        """Which seam each border is; None = not known (drawn outlines)."""

    @staticmethod
    def of(decoder: IspDecoder, truth: Garment, seed: int = 0) -> PatternEvidence:
        """A garment's own panels."""
        return PatternEvidence(
            decoder, [panel_border(truth, decoder.nets.shape, k) for k in range(decoder.panels)], seed=seed
        )

    def renew(self, latent: Tensor) -> None:
        """Nothing depends on the code."""

    def __call__(self, latent: Tensor, every: int = 1) -> Tensor:
        """Energy of a code (z,), by ``every`` so many of the points."""
        nets, distance = self.decoder.nets, self.distance[::every]
        found, logits = nets.split_pattern(nets.pattern.run_folded(nets.pattern.fold(latent), self.at[::every]))
        error = ((found - distance).square() + 1e-6).sqrt() - 1e-3
        error = error * (0.1 / distance.abs().clamp_min(0.1))  # far away only the side matters
        if self.label is None:
            return SCALE * error.mean()
        return SCALE * error.mean() + 0.02 * F.cross_entropy(logits.flatten(0, 1), self.label[::every].flatten())

    def starts(self) -> list[int]:
        """Learned codes whose panels are closest, best first."""
        with torch.no_grad():
            energies = torch.stack([self(z, every=6) for z in self.decoder.codes])
        return energies.topk(min(CANDIDATES, len(energies)), largest=False).indices.tolist()


class Bank:
    """Learned garments to choose starts from, decoded coarsely when they are first asked for."""

    def __init__(self, decoder: IspDecoder, count: int = 40):
        """``count`` codes that cover the learned ones are compared first, then their best ones' neighbours."""
        self.decoder, self.count = decoder, count
        self._kept: dict[int, Garment] = {}

    def __getitem__(self, index: int) -> Garment:
        """The garment of a learned code."""
        if index not in self._kept:
            with torch.no_grad():
                self._kept[index] = self.decoder.decode(self.decoder.codes[index], BANK_RESOLUTION)
        return self._kept[index]

    def best(self, score: Callable[[Garment], float]) -> list[int]:
        """Learned codes by the score of their garments, best first; 1 is a perfect score."""
        everyone = torch.arange(len(self.decoder.codes))
        found = retrieved(self.decoder.codes, everyone, lambda index: score(self[index]), self.count)
        return found[:CANDIDATES].tolist()


class SurfaceEvidence:
    """A mesh, or points alone: exact distances both ways, and the open borders where there is a mesh."""

    def __init__(
        self, decoder: IspDecoder, target: Mesh | Tensor, resolution: int = 72, count: int = 1500, seed: int = 0
    ):
        """``target``: a mesh or points (N, 3), in the rest space of the neutral body [m]."""
        generator = torch.Generator().manual_seed(seed)
        self.decoder, self.resolution = decoder, resolution
        self.half = decoder.nets.shape.half
        self.mesh = target if isinstance(target, Mesh) else None
        self.loops = boundary_loops(target.faces) if isinstance(target, Mesh) else None
        if isinstance(target, Mesh):
            self.points = sample_surface(target, count, generator)[0]
            self.contact = BodyContact(target.vertices, target.faces)
            self.border = border_points(target.vertices, target.faces)
            self.spacing = 0.0
        else:
            some = torch.randperm(len(target), generator=generator)[:count]
            self.points, self.border = target[some], torch.zeros(0, 3)
            apart = cKDTree(self.points.numpy()).query(self.points.numpy(), k=2)[0][:, 1]
            self.spacing = 2.0 * float(np.median(apart))  # cloth between points is no nearer to them than this
        self.garment: Garment | None = None

    def renew(self, latent: Tensor) -> None:
        """Cut and sew the code's garment."""
        with torch.no_grad():
            self.garment = self.decoder.decode(latent, self.resolution)

    def __call__(self, latent: Tensor) -> Tensor:
        """Energy of a code (z,) near the one of the last ``renew``."""
        assert self.garment is not None
        x = self.decoder.decode_like(latent, self.garment).mesh.vertices
        faces = self.garment.mesh.faces
        face, weights, _ = BodyContact(x.detach(), faces).closest(self.points)
        forth = (x[faces[face]] * weights[..., None]).sum(1) - self.points
        energy = _soft(forth) + self._back(x)
        if len(self.border):
            energy = energy + 0.5 * self._borders(x)
        return SCALE * 0.5 * energy / self.half

    def figures(self, latent: Tensor) -> dict[str, float]:
        """How near the garment comes to the target, mean and 95th percentile [mm]."""
        with torch.no_grad():
            garment = self.decoder.decode(latent, 128)
        away = surface_distance(self.points, garment.mesh)[0]
        return {"off_mm": 1e3 * float(away.mean()), "off_p95_mm": 1e3 * float(away.quantile(0.95))}

    def _back(self, x: Tensor) -> Tensor:
        """The garment's own points off the target; beside sparse points only what is further than their spacing."""
        if self.mesh is not None:
            face, weights, _ = self.contact.closest(x.detach())
            return _soft(x - (self.mesh.vertices[self.mesh.faces[face]] * weights[..., None]).sum(1))
        near = torch.as_tensor(cKDTree(self.points.numpy()).query(x.detach().numpy())[1])
        away = (x - self.points[near]).norm(dim=1)
        return F.relu(away - self.spacing).mean()

    def _borders(self, x: Tensor) -> Tensor:
        assert self.garment is not None
        own = border_points(x, self.garment.mesh.faces)
        forth = cKDTree(self.border.numpy()).query(own.detach().numpy())[1]
        back = cKDTree(own.detach().numpy()).query(self.border.numpy())[1]
        return _soft(own - self.border[forth]) + _soft(own[back] - self.border)

    def starts(self, bank: Bank) -> list[int]:
        """Learned codes whose garments are closest, best first; those with another number of open borders come last."""
        return bank.best(self._score)

    def _score(self, garment: Garment) -> float:
        """1 less the distances both ways, those of the borders too [m], and less 0.1 where borders do not agree."""
        pairs = [(garment.mesh.vertices.numpy(), self.points.numpy())]
        if len(self.border):
            own = border_points(garment.mesh.vertices, garment.mesh.faces)
            pairs.append((own.numpy(), self.border.numpy()))
        off = sum(cKDTree(a).query(b)[0].mean() + cKDTree(b).query(a)[0].mean() for a, b in pairs)
        other = self.loops is not None and boundary_loops(garment.mesh.faces) != self.loops
        return 1.0 - float(off) - 0.1 * other


def border_points(x: Tensor, faces: Tensor, pieces: int = 4) -> Tensor:
    """Points along the open borders of a mesh (V, 3), ``pieces`` an edge: (M, 3), differentiable."""
    edges = torch.as_tensor(border_edges(faces.numpy()))
    share = torch.arange(pieces, dtype=x.dtype)[:, None, None] / pieces
    return ((1 - share) * x[edges[:, 0]] + share * x[edges[:, 1]]).flatten(0, 1)


def _soft(away: Tensor) -> Tensor:
    """Mean pseudo-Huber length of (N, 3) differences [m]."""
    return ((away.square().sum(1) + SOFT**2).sqrt() - SOFT).mean()


class SilhouetteEvidence:
    """A mask of the garment on the neutral body in the T pose, which hides what is behind it."""

    def __init__(self, decoder: IspDecoder, mask: Tensor, camera: Camera, pixels: int = 192, resolution: int = 72):
        """``mask`` (h, w) coverage in [0, 1], as ``camera`` sees it; it is looked at on ``pixels`` rows."""
        self.decoder, self.camera, self.resolution = decoder, camera, resolution
        h, w = mask.shape
        self.size = (pixels, max(1, round(pixels * w / h)))
        self.target = F.interpolate(mask[None, None].float(), self.size, mode="area")[0, 0]
        body = load_body()
        self.body = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
        self.field = outside_distance(self.target > 0.5)
        self.rows = torch.nonzero(self.target > 0.5).flip(1).float() + 0.5
        self.rows = self.rows[:: max(1, len(self.rows) // 400)]
        self.garment: Garment | None = None
        self.renderer: LabelRenderer | None = None

    def renew(self, latent: Tensor) -> None:
        """Cut and sew the code's garment."""
        with torch.no_grad():
            self.take(self.decoder.decode(latent, self.resolution))

    def take(self, garment: Garment) -> None:
        """Look at this garment from now on."""
        counts = [len(garment.mesh.vertices), len(self.body.vertices)]
        self.garment = garment
        self.renderer = LabelRenderer([garment.mesh.faces, self.body.faces], [0, -1], counts)

    def __call__(self, latent: Tensor) -> Tensor:
        """Energy of a code (z,) near the one of the last ``renew``."""
        assert self.garment is not None
        return self._energy(self.decoder.decode_like(latent, self.garment).mesh.vertices)

    def image(self, x: Tensor) -> Tensor:
        """(h, w) coverage of the garment with vertices (V, 3) in the topology of the last ``renew``."""
        assert self.renderer is not None
        return self.renderer([x, self.body.vertices], self.camera, self.size)[0]

    def figures(self, latent: Tensor) -> dict[str, float]:
        """Overlap of the code's silhouette with the mask."""
        with torch.no_grad():
            self.take(self.decoder.decode(latent, 128))
            assert self.garment is not None
            image = self.image(self.garment.mesh.vertices)
        return {"iou": float(hard_iou(image[None], self.target[None])[0])}

    def _energy(self, x: Tensor) -> Tensor:
        image = self.image(x)
        overlap = soft_iou_loss(image[None], self.target[None])[0]
        scale = self.size[0] / self.camera.size[0]
        pull = chamfer_pull(self.camera.project(x) * scale, self.field, self.rows)
        return 0.15 * overlap + 0.3 * overlap.detach().square() * pull

    def starts(self, bank: Bank) -> list[int]:
        """Learned codes whose silhouettes overlap most, best first."""
        return bank.best(self._score)

    def _score(self, garment: Garment) -> float:
        """Overlap of the garment's silhouette with the mask."""
        self.take(garment)
        with torch.no_grad():
            image = self.image(garment.mesh.vertices)
        return float(hard_iou(image[None], self.target[None])[0])


def evidence_of(decoder: IspDecoder, path: Path, seed: int = 0) -> SurfaceEvidence | SilhouetteEvidence:
    """The evidence in a file: a silhouette (png, jpg), points (npy, xyz, txt, ply without faces) or a mesh.

    Raises:
        UserError: unreadable, or not of the size of clothes in metres.
    """
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        mask = read_mask(path)
        return SilhouetteEvidence(decoder, mask, front_camera((mask.shape[0], mask.shape[1])))
    if path.suffix.lower() in (".npy", ".xyz", ".txt") or _pointcloud(path):
        points = read_points(path)
        _wearable(path, points)
        return SurfaceEvidence(decoder, points, seed=seed)
    mesh = read_mesh(path)
    _wearable(path, mesh.vertices)
    return SurfaceEvidence(decoder, mesh, seed=seed)


def _pointcloud(path: Path) -> bool:
    if path.suffix.lower() != ".ply" or not path.is_file():
        return False
    head = path.read_bytes()[:4096].split(b"end_header")[0]
    count = re.search(rb"element face (\d+)", head)
    return count is None or int(count[1]) == 0


def _wearable(path: Path, points: Tensor) -> None:
    low, high = points.amin(0), points.amax(0)
    size = float((high - low).max())
    if not 0.15 < size < 2.5:
        raise UserError(f"{path}: is {size:.3g} across; wanted a garment's size in metres")
    if float(low[1]) < -0.5 or float(high[1]) > 2.5 or float(points.mean(0).abs()[[0, 2]].max()) > 0.5:
        x, y, z = points.mean(0).tolist()
        raise UserError(
            f"{path}: its middle is at {x:.2f}, {y:.2f}, {z:.2f} m; wanted it on the neutral body, feet at y = 0"
        )


def front_camera(size: tuple[int, int]) -> Camera:
    """The camera of silhouettes: in front of the neutral body, which just fits the picture of ``size`` (h, w)."""
    body = load_body()
    return orbit_camera([Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)], 0.0, 0.0, size)
