"""Stage 'body' of a scan: shape and pose from labelled points, without landmarks (DrapeNet Eq. 13, body term).

Many starts (facing every way, arms level, half down, down) descend together on a few hundred points and a thinned body
with a robust distance that narrows; the best few go on against the body's whole surface. The distance is one-way, from
the scan to the body: skin points lie on the body, garments' points outside of it and not far away.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.fit_body import to_body
from recon.bodies import Body
from recon.bodies.pose_prior import pose_prior, sample_poses
from recon.bodies.poses import a_pose
from recon.bodies.rig import JOINT_NAMES
from recon.cloth.contact import BodyContact
from recon.descend import Descent, descend
from recon.garments import NAMES
from recon.types import BodyPose, Scan

PARAMETERS = {"shape": 0.04, "pose": 0.03, "translation": 0.015}
"""Body parameters with their step sizes (unit normal, rad, m)."""
NEVER: dict[str, tuple[str, ...]] = {
    "top": ("head", "hands", "feet"),
    "dress": ("head", "hands", "feet"),
    "trousers": ("head", "neck", "hands", "forearms", "upper_arms"),
    "skirt": ("head", "neck", "hands", "forearms", "upper_arms"),
}
"""Garment kind -> regions of the body that it never lies next to."""
ARM = ("collar", "shoulder", "elbow", "wrist")
ARMS = tuple([JOINT_NAMES.index(f"{side}_{part}") for part in ARM] for side in "lr")
"""The joints of each arm."""
ENDS = ("head", "upper_arms", "forearms", "hands", "feet")
"""Regions that a scan shows, bare or closely clothed."""


@dataclass(frozen=True)
class ScanBodyFit:
    """Settings of the body stage; weights are unitless."""

    facings: int = 8
    """Directions that the person may face, tried all around."""
    arms: tuple[float, ...] = (0.0, 40.0, 75.0)
    """How far the arms hang down in the starts [degrees]."""
    points: int = 450
    """Scan points of the first descents."""
    pairing: int = 2
    """Steps of the first descents for which nearest points are kept."""
    fine_points: int = 2000
    """Scan points of the last one."""
    cell: float = 0.048
    """The thinned body keeps one vertex in each cell of this size [m]."""
    reaches: tuple[float, ...] = (0.3, 0.12, 0.06)
    """Distances at which points stop pulling harder, from coarse to fine [m]."""
    kept: tuple[int, ...] = (24, 8, 4)
    """How many starts each of these goes on with."""
    varied: int = 16
    """Bodies with other arms, likely ones, that join the best after the first of these."""
    finalists: int = 2
    """How many go on against the body's surface."""
    coarse: Descent = field(default_factory=lambda: Descent(steps=45, patience=45))
    """Each of the first descents."""
    fine: tuple[tuple[float, float, Descent], ...] = (
        (0.05, 0.1, Descent(steps=30, patience=30, rate=0.5)),
        (0.02, 0.3, Descent(steps=50, patience=30, rate=0.3)),
        (0.015, 1.0, Descent(steps=40, patience=20, rate=0.15, tolerance=5e-4)),
    )
    """The last descents: distance at which a skin point stops pulling harder [m], weight of garments' points that are
    inside of the body (unit: 1 cm), and steps. All finalists take the first, the best one the others. The weight
    grows: at first an arm that is a centimetre off would leave its sleeve by the nearest way, and never come back."""
    cloth: float = 0.05
    """The same of a garment's point."""
    slack: float = 0.25
    """Weight of garments' points being away from the body, against skin points'."""
    ends: float = 0.3
    """Weight of head, arms and feet being where nothing was scanned: the one part of the body's distance that is
    two-way, since a limb in empty space has no points to answer for."""
    gap: float = 0.003
    """Garments' points are outside of the body by this much at least [m]."""
    prior: float = 0.004
    """Weight of the pose prior."""
    shape: float = 0.004
    """Weight of the squared shape coefficients."""


def fit_scan_body(
    scan: Scan,
    body: Body,
    settings: ScanBodyFit,
    start: BodyPose | None = None,
    tick: Callable[[int, float], None] | None = None,
) -> dict[str, Tensor]:
    """Fit the body under the clothes.

    Args:
        scan: the evidence.
        body: a ``recon.bodies`` body.
        settings: see :class:`ScanBodyFit`.
        start: where to begin instead of everywhere.
        tick: hears (step, loss).

    Returns:
        shape (1, S), pose (1, 24, 3) [rad], translation (1, 3) [m].
    """
    if start is None:
        starts = search(scan, body, settings, tick)
    else:
        starts = {"shape": start.shape, "pose": start.pose, "translation": start.translation}
    left = [{k: v[i : i + 1] for k, v in starts.items()} for i in range(len(starts["pose"]))]
    for reach, outside, plan in settings.fine:
        loss = SurfaceLoss(scan, body, settings, settings.fine_points, reach, outside)
        ends = [descend(values, PARAMETERS, loss, plan, tick) for values in left]
        left = [min(ends, key=lambda end: end.loss).values]
    return left[0]


def search(scan: Scan, body: Body, settings: ScanBodyFit, tick=None) -> dict[str, Tensor]:
    """The best ``finalists`` of many starts, found on few points, best first."""
    values = all_starts(scan, body, settings)
    loss = CloudLoss(scan, body, settings)
    for number, (reach, kept) in enumerate(zip(settings.reaches, settings.kept, strict=True)):
        with torch.no_grad():
            best = loss.at(reach).each(values).argsort()[:kept]
        values = {k: v[best] for k, v in values.items()}
        if number == 1:
            values = with_other_arms(values, settings.varied)
        values = descend(values, PARAMETERS, lambda v: loss.each(v).sum(), settings.coarse, tick).values
    with torch.no_grad():
        best = loss.at(settings.reaches[-1]).each(values).argsort()[: settings.finalists]
    return {k: v[best] for k, v in values.items()}


def all_starts(scan: Scan, body: Body, settings: ScanBodyFit) -> dict[str, Tensor]:
    """Bodies as tall as the scan, on its ground and under its middle, facing all around, with arms at all heights."""
    x = scan.points
    low, high = x[:, 1].quantile(0.002), x[:, 1].quantile(0.998)
    poses = []
    for k in range(settings.facings):
        for degrees in settings.arms:
            pose = a_pose(1, degrees)
            pose[0, 0, 1] = 2 * math.pi * k / settings.facings
            poses.append(pose)
    pose = torch.cat(poses).to(x)
    n = len(pose)
    shape = _tall(body, float(high - low)).to(x).expand(n, -1).contiguous()
    with torch.no_grad():
        v = body.pose(BodyPose(shape[:1], pose[:1], x.new_zeros(1, 3))).mesh.vertices[0]
    middle = (x.quantile(0.02, 0) + x.quantile(0.98, 0)) / 2
    place = middle - (v.amin(0) + v.amax(0)) / 2
    place[1] = low - v[:, 1].min()
    return {"shape": shape, "pose": pose, "translation": place.expand(n, 3).contiguous()}


def with_other_arms(values: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """The bodies, and ``count`` more: the same in turn with the arms of random likely poses, one side or both.

    Starts hold both arms alike and straight; from there an arm that is bent behind the back is not found.
    """
    number = torch.arange(count, device=values["pose"].device) % len(values["pose"])
    more = {k: v[number].clone() for k, v in values.items()}
    other = sample_poses(count, torch.Generator().manual_seed(0)).to(more["pose"])
    for side, arm in enumerate(ARMS):
        chosen = torch.arange(count, device=number.device) % 3 != side
        more["pose"][:, arm] = torch.where(chosen[:, None, None], other[:, arm], more["pose"][:, arm])
    return {k: torch.cat([v, more[k]]) for k, v in values.items()}


def _tall(body: Body, height: float) -> Tensor:
    """(1, S) the likeliest shape of this height [m], along the coefficients that change it, within two deviations."""
    template = body.rest(torch.zeros(1, body.n_shape, device=body.weights.device)).vertices[0]
    top, bottom = int(template[:, 1].argmax()), int(template[:, 1].argmin())
    slope = body.shape_dirs[top, 1] - body.shape_dirs[bottom, 1]
    lack = height - float(template[top, 1] - template[bottom, 1])
    return (slope * (lack / slope.square().sum().clamp_min(1e-9))).clamp(-2, 2)[None]


def thinned(body: Body, cell: float) -> Tensor:
    """(K,) indices of one body vertex in each cell of its rest shape."""
    at = (body.rest(torch.zeros(1, body.n_shape, device=body.weights.device)).vertices[0] / cell).floor().cpu().numpy()
    _, first = np.unique(at, axis=0, return_index=True)
    return torch.as_tensor(np.sort(first), device=body.weights.device)


class _Thin:
    """Some vertices of a body: what ``CloudLoss`` poses many of at once."""

    def __init__(self, body, keep: Tensor):
        parts = {k: getattr(body, k)[keep] for k in ("template", "shape_dirs", "weights", "regions")}
        if body.pose_dirs is not None:
            parts["pose_dirs"] = body.pose_dirs[keep]
        self.pose = replace(body, **parts).pose
        self.regions = parts["regions"]


class CloudLoss:
    """Robust distances both ways between few scan points and a thinned body, for many bodies at once."""

    def __init__(self, scan: Scan, body: Body, settings: ScanBodyFit):
        self.settings, self.reach = settings, settings.reaches[0]
        self.points, self.labels = few(scan, settings.points)
        self.body = _Thin(body, thinned(body, settings.cell))
        self.apart = apart(scan, self.labels, body, self.body.regions)
        self._pairs: tuple[Tensor, Tensor] | None = None
        self._calls = 0

    def at(self, reach: float) -> CloudLoss:
        """From now on with this reach, and pairs found anew."""
        self.reach, self._pairs, self._calls = reach, None, 0
        return self

    def pairs(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """(n, N) nearest vertex of each point that labels allow, (n, V) nearest point of each vertex; kept for a while.

        Finding them costs most of a step.
        """
        if self._pairs is None or self._calls % self.settings.pairing == 0 or len(self._pairs[0]) != len(vertices):
            with torch.no_grad():
                distance = torch.cdist(self.points.expand(len(vertices), -1, -1), vertices)
                to_scan = distance.argmin(1)
                self._pairs = distance.add_(self.apart).argmin(2), to_scan
        self._calls += 1
        return self._pairs

    def each(self, values: dict[str, Tensor]) -> Tensor:
        """(n,) the loss of n bodies."""
        s = self.settings
        vertices = self.body.pose(to_body(values)).mesh.vertices
        to_vertex, to_scan = self.pairs(vertices)
        ahead = torch.gather(vertices, 1, to_vertex[..., None].expand(-1, -1, 3)) - self.points
        back = vertices - self.points[to_scan]
        loss = self._robust(ahead).mean(1) + 0.5 * self._robust(back).mean(1)
        return loss + s.prior * pose_prior(values["pose"]) + s.shape * values["shape"].square().mean(1)

    def _robust(self, away: Tensor) -> Tensor:
        square = away.square().sum(2) / self.reach**2
        return square / (1 + square)


def few(scan: Scan, count: int) -> tuple[Tensor, Tensor]:
    """Up to ``count`` labelled points, spread evenly over the scan (one a cell), and their labels."""
    known = scan.labels >= 0
    x, labels = scan.points[known], scan.labels[known]
    keep = evenly(x, count)
    return x[keep], labels[keep]


def evenly(points: Tensor, count: int) -> Tensor:
    """Indices of up to ``count`` points, one in each cell of the finest grid that has no more cells than that."""
    at = points.cpu().numpy()
    if len(at) <= count:
        return torch.arange(len(at))
    low, high = 1e-4, float(np.ptp(at, axis=0).max()) + 1e-3
    for _ in range(20):
        cell = math.sqrt(low * high)
        first = np.unique(np.floor(at / cell), axis=0, return_index=True)[1]
        low, high = (cell, high) if len(first) > count else (low, cell)
    return torch.as_tensor(np.sort(np.unique(np.floor(at / high), axis=0, return_index=True)[1]))


def apart(scan: Scan, labels: Tensor, body: Body, regions: Tensor) -> Tensor:
    """(N, V) distance added between points and body vertices that can't belong together by their labels [m]."""
    out = torch.zeros(len(labels), len(regions))
    for k, name in enumerate(scan.names[1:], start=1):
        never = [body.region_names.index(r) for r in NEVER[NAMES[name][0]]]
        out[(labels == k)[:, None] & torch.isin(regions.cpu(), torch.tensor(never))] = 0.5
    return out.to(scan.points)


class SurfaceLoss:
    """Distance from scan points to the body's surface: skin on it, cloth outside and near."""

    def __init__(
        self, scan: Scan, body: Body, settings: ScanBodyFit, count: int, reach: float = 0.02, outside: float = 1.0
    ):
        """``count``: points; ``reach``: distance from the body at which a skin point stops pulling harder [m];
        ``outside``: weight of garments' points inside of the body (unit: 1 cm)."""
        self.body, self.settings, self.reach, self.outside = body, settings, reach, outside
        self.points, labels = few(scan, count)
        self.skin = labels == 0
        index = thinned(body, settings.cell / 2)
        self.ends = index[body.region_mask(*ENDS)[index]]
        self.tree, self.cloud = cKDTree(self.points.cpu().numpy()), self.points

    def __call__(self, values: dict[str, Tensor]) -> Tensor:
        posed = self.body.pose(to_body(values))
        return self.of(values, BodyContact(posed.mesh.vertices[0], self.body.faces))

    def of(self, values: dict[str, Tensor], contact: BodyContact) -> Tensor:
        """() the loss of a body that is posed already."""
        s, distance = self.settings, contact.signed_distance(self.points)
        ends = contact.vertices[self.ends]
        near = self.cloud[torch.as_tensor(self.tree.query(ends.detach().cpu().numpy())[1], device=ends.device)]
        on, off = distance[self.skin], distance[~self.skin]
        loss = s.prior * pose_prior(values["pose"]).mean() + s.shape * values["shape"].square().mean()
        loss = loss + s.ends * geman((ends - near).norm(dim=1), s.cloth)
        if len(on):
            loss = loss + geman(on, self.reach)
        if len(off):
            inside = F.relu(s.gap - off) / 0.01
            loss = loss + s.slack * geman(off, s.cloth) + self.outside * (inside.square() / (1 + 0.1 * inside)).mean()
        return loss


def geman(distance: Tensor, scale: float) -> Tensor:
    """Mean of Geman-McClure's d² / (d² + scale²)."""
    square = (distance / scale).square()
    return (square / (1 + square)).mean()
