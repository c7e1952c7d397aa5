"""Stage 'body': shape, pose and perspective camera of the person from landmarks and silhouette."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pipelines.evidence import Level, level
from recon.bodies.pose_prior import pose_prior
from recon.bodies.rig import JOINT_NAMES
from recon.descend import Descended, Descent, descend
from recon.losses import robust_distance
from recon.types import BodyPose, Camera, Photo, PosedBody

BONES = (
    (11, 13),
    (13, 15),
    (12, 14),
    (14, 16),
    (23, 25),
    (25, 27),
    (24, 26),
    (26, 28),
    (11, 12),
    (23, 24),
    (11, 23),
    (12, 24),
)
"""Pairs of BlazePose landmarks whose directions in space are compared with the network's guess."""
KNEES = [JOINT_NAMES.index("l_knee"), JOINT_NAMES.index("r_knee")]
TRUST = torch.tensor(
    [1.0] + [0.3] * 6 + [0.7] * 2 + [0.3] * 2 + [1.0] * 4 + [0.8] * 2 + [0.2] * 6 + [1.0] * 6 + [0.4] * 4
)
"""(33,) how far each landmark is trusted: trunk and limbs fully, finger and eye points little."""


@dataclass(frozen=True)
class BodyFit:
    """Settings of the body stage; weights are unitless."""

    focal: float = 1.1
    """Expected focal length in units of the photo's longer side (prior of the camera)."""
    focal_spread: float = 0.15
    """Standard deviation of log focal length around it."""
    landmarks: float = 30.0
    """Weight of the landmarks' robust distance."""
    landmark_scale: float = 0.03
    """Distance at which a landmark stops pulling harder, in units of the person's height in the photo."""
    bones: float = 6.0
    """Weight of limb directions in space against the landmark network's guess."""
    places: float = 0.0
    """Weight of the landmarks' places in space about their middle (robust beyond 0.1 m): 0 for a network's guess of a
    photo, which leans by 10-20 degrees; worth much where they were measured."""
    size: float = 0.5
    """Weight of the body's size (unit: 5 %) against the landmark network's guess in metres: one view alone hardly tells
    a tall person far away from a short one close by."""
    prior: float = 0.15
    """Weight of the pose prior (limits and Mahalanobis distance)."""
    upright: float = 0.2
    """Weight of the body's lean out of the vertical (unit: 0.1 rad) and of the camera's pitch (unit: 0.3 rad): people
    stand upright before a tilted camera rather than lean before a level one."""
    straight: float = 0.1
    """Weight of bent knees (unit: 0.3 rad): a photo from the front hardly shows them, and people stand on straight legs
    before they crouch."""
    shape: float = 0.06
    """Weight of the squared shape coefficients."""
    inside: float = 6.0
    """Weight of body coverage outside the person's mask."""
    fill: float = 1.0
    """Weight of the person's mask left uncovered (small: clothes stand off the body)."""
    posing: Descent = field(default_factory=lambda: Descent(steps=220, patience=40))
    """First descent: landmarks alone."""
    shaping: Descent = field(default_factory=lambda: Descent(steps=70, patience=70, rate=0.4))
    """Second descent: with silhouettes, in small steps, from where large ones have settled."""
    long_side: int = 160
    """Resolution of the silhouettes."""


PARAMETERS = {"shape": 0.03, "pose": 0.02, "translation": 0.01, "log_focal": 0.01, "pitch": 0.01}
"""Body and camera parameters with their step sizes (unit normal, rad, m, log, rad)."""


def to_body(values: dict[str, Tensor]) -> BodyPose:
    """Descent parameters -> the body they mean."""
    return BodyPose(values["shape"], values["pose"], values["translation"])


def to_camera(values: dict[str, Tensor], size: tuple[int, int]) -> Camera:
    """Descent parameters -> a camera at the world's origin that looks along -z, pitched down by ``pitch`` [rad].

    The principal point is the photo's centre.
    """
    focal, pitch = values["log_focal"].exp(), values["pitch"]
    zero, one = torch.zeros_like(focal), torch.ones_like(focal)
    K = torch.stack([focal, zero, one * size[1] / 2, zero, focal, one * size[0] / 2, zero, zero, one]).reshape(3, 3)
    c, s = pitch.cos(), pitch.sin()
    R = torch.stack([one, zero, zero, zero, -c, s, zero, -s, -c]).reshape(3, 3)
    return Camera(K, R, focal.new_zeros(3), size)


def lean(posed: PosedBody) -> Tensor:
    """() squared sines of the angles of legs (ankles to pelvis) and trunk (pelvis to neck) with the vertical, summed.

    Each for itself: a body whose legs lean forward and whose trunk leans back is not upright.
    """
    ankles, pelvis, neck = (posed.joints[0, list(k)] for k in ((7, 8), (0,), (12,)))
    axes = torch.stack([pelvis.mean(0) - ankles.mean(0), neck.mean(0) - pelvis.mean(0)])
    return (1 - torch.nn.functional.normalize(axes, dim=1)[:, 1].square()).sum()


def person_height(photo: Photo) -> float:
    """Height of the person's mask in pixels."""
    rows = torch.where((photo.person > 0.5).any(1))[0]
    return float(rows[-1] - rows[0] + 1)


def evidence_loss(values: dict[str, Tensor], posed: PosedBody, body, photo: Photo, settings: BodyFit) -> Tensor:
    """Landmarks, limb directions and priors: what holds in every stage that moves body or camera."""
    camera = to_camera(values, (photo.rgb.shape[0], photo.rgb.shape[1]))
    points = body.landmarks(posed)[0]
    trust = TRUST.to(photo.landmarks) * photo.landmarks[:, 2]
    height = person_height(photo)
    close = robust_distance(camera.project(points), photo.landmarks[:, :2], trust, settings.landmark_scale * height)
    a, b = (torch.tensor(side) for side in zip(*BONES))
    seen = (points @ camera.R.T) * points.new_tensor([1.0, -1.0, -1.0])  # y up before the camera, as the guess is
    share = (trust / trust.sum().clamp_min(1e-6))[:, None]
    places, guess = (x - (share * x).sum(0) for x in (seen, photo.landmarks_world))
    ours, theirs = seen[b] - seen[a], photo.landmarks_world[b] - photo.landmarks_world[a]
    sure = torch.minimum(trust[a], trust[b])
    aligned = 1 - torch.cosine_similarity(ours, theirs, dim=-1)
    bones = (sure * aligned).sum() / sure.sum().clamp_min(1e-6)
    lengths = [(sure * bone.norm(dim=-1)).sum().clamp_min(1e-6) for bone in (ours, theirs)]
    size = ((lengths[0] / lengths[1]).log() / 0.05).square()
    expected = math.log(settings.focal * max(photo.rgb.shape[:2]))
    lens = ((values["log_focal"] - expected) / settings.focal_spread).square().sum()
    return (
        settings.landmarks * close
        + settings.bones * bones
        + settings.places * robust_distance(places, guess, trust, 0.1)
        + settings.size * size
        + settings.prior * pose_prior(values["pose"]).mean()
        + settings.straight * (values["pose"][:, KNEES, 0] / 0.3).square().mean()
        + settings.shape * values["shape"].square().mean()
        + settings.upright * (lean(posed) / 0.1**2 + values["pitch"].square() / 0.3**2)
        + 0.05 * lens
    )


def start_values(body, photo: Photo, settings: BodyFit) -> dict[str, Tensor]:
    """Arms half down, turned as the landmarks' shoulders and hips say, placed so that the trunk's landmarks agree."""
    from recon.bodies.poses import a_pose

    size = (photo.rgb.shape[0], photo.rgb.shape[1])
    world = photo.landmarks_world
    pose = a_pose(1, 60.0).to(world)
    across = (world[11] - world[12]) + (world[23] - world[24])
    pose[0, 0] = world.new_tensor([0.0, float(torch.atan2(-across[2], across[0])), 0.0])
    focal = settings.focal * max(size)
    values = {
        "shape": world.new_zeros(1, body.n_shape),
        "pose": pose,
        "translation": world.new_zeros(1, 3),
        "log_focal": world.new_tensor(math.log(focal)),
        "pitch": world.new_zeros(()),
    }
    with torch.no_grad():
        points = body.landmarks(body.pose(to_body(values)))[0]
    sure = photo.landmarks[:, 2] > 0.5
    sure[1:11] = False
    if sure.sum() < 4:
        sure[[11, 12, 23, 24]] = True
    p, q = points[sure], photo.landmarks[sure, :2]
    depth = focal * spread(p[:, :2]) / spread(q).clamp_min(1.0)
    centre = world.new_tensor([size[1] / 2, size[0] / 2])
    at = (q.mean(0) - centre) / focal * depth
    values["translation"] = torch.stack([at[0], -at[1], -depth])[None] - torch.cat([p.mean(0)[:2], p.mean(0)[2:]])[None]
    return values


def spread(points: Tensor) -> Tensor:
    """Root mean square distance of points from their mean."""
    return (points - points.mean(0)).square().sum(1).mean().sqrt()


def silhouette_loss(image: Tensor, at: Level, settings: BodyFit) -> Tensor:
    """A naked body inside a dressed silhouette: outside costs much, uncovered person a little."""
    person = at.person
    area = person.sum().clamp_min(1.0)
    outside = (image * (1 - person)).sum() / area
    empty = (person * (1 - image)).sum() / area
    return settings.inside * outside + settings.fill * empty


def fit_body(photo: Photo, body, renderer_of: Callable, settings: BodyFit, tick=None) -> dict[str, Tensor]:
    """Fit the body under the clothes and the camera that sees it.

    Args:
        photo: the evidence.
        body: a ``recon.bodies`` body.
        renderer_of: (faces, labels, n_vertices) -> label renderer.
        settings: see :class:`BodyFit`.

    Returns:
        shape (1, S), pose (1, 24, 3) [rad], translation (1, 3) [m], log_focal () [log px], pitch () [rad].
    """

    def by_landmarks(values: dict[str, Tensor]) -> Tensor:
        return evidence_loss(values, body.pose(to_body(values)), body, photo, settings)

    placed = descend(start_values(body, photo, settings), PARAMETERS, by_landmarks, settings.posing, tick)
    at = level(photo, settings.long_side)
    renderer = renderer_of([body.faces], [0], [len(body.weights)])

    def by_silhouette(values: dict[str, Tensor]) -> Tensor:
        posed = body.pose(to_body(values))
        camera = at.camera(to_camera(values, (photo.rgb.shape[0], photo.rgb.shape[1])))
        image = renderer([posed.mesh.vertices[0]], camera, at.size)[0]
        return evidence_loss(values, posed, body, photo, settings) + silhouette_loss(image, at, settings)

    halved = {k: 0.5 * v for k, v in PARAMETERS.items()}
    shaped: Descended = descend(placed.values, halved, by_silhouette, settings.shaping, tick)
    return shaped.values
