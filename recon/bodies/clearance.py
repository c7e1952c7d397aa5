"""Poses in which no limb passes through the body: what a recorded or random pose needs before cloth can lie between.

A clip's angles on another body, or angles drawn at random, push arms into the trunk and legs into each other; no
garment can be outside of such a body without crossing itself. The limbs' joints are turned, as little as does it, until
balls inscribed in the body are ``gap`` apart. Balls: the largest in the body at rest that touches the skin at a
vertex (the medial axis' balls), carried along by that vertex' skinning weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from torch import Tensor

from recon.bodies import Body
from recon.bodies.rig import JOINT_NAMES, axis_angles, joint_transforms, rotation_matrices
from recon.descend import Descent, descend
from recon.types import BodyPose, Motion

PARTS = {
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "l_collar", "r_collar"),
    "l_arm": ("l_shoulder",),
    "l_forearm": ("l_elbow", "l_wrist", "l_hand"),
    "r_arm": ("r_shoulder",),
    "r_forearm": ("r_elbow", "r_wrist", "r_hand"),
    "l_thigh": ("l_hip",),
    "l_shin": ("l_knee", "l_ankle", "l_foot"),
    "r_thigh": ("r_hip",),
    "r_shin": ("r_knee", "r_ankle", "r_foot"),
}
"""Parts that keep clear of each other, by the joints that carry them."""
TURNED = tuple(s + n for n in ("shoulder", "elbow", "hip", "knee") for s in ("l_", "r_"))
"""Joints that may be turned."""
REACH = 0.06
"""Pairs farther from each other than the gap and this [m] are not watched while limbs turn."""

SEEN = 1.0
"""Turns smaller than this [degrees] are not worth a note."""


@dataclass(frozen=True)
class Clearing:
    """How far limbs keep away, and what turning them costs."""

    gap: float = 0.01
    """Room between parts of the body [m]: cloth on each side, and what balls leave of the skin's bumps."""
    near: float = 0.1
    """Balls of two parts closer than this in the T pose are neighbours across a joint: folds are left alone [m]."""
    balls: int = 200
    """Balls in the body."""
    turning: float = 5.0
    """Cost of turning a joint by a radian, against the square of 1 cm too near."""
    smooth: float = 10.0
    """Cost of a turn's change from frame to frame, as a multiple of ``turning`` (motions only)."""
    steps: int = 60
    """Most steps of the descent."""


@dataclass(frozen=True)
class Balls:
    """Balls inscribed in one body, and the pairs of them that must not come near each other."""

    centre: Tensor
    """(N, 3) at rest [m]."""
    radius: Tensor
    """(N,) [m]."""
    weights: Tensor
    """(N, 24) skinning."""
    pairs: Tensor
    """(2, P) long."""

    def centres(self, transforms: Tensor) -> Tensor:
        """(B, N, 3) in bodies of transforms (B, 24, 4, 4)."""
        blended = torch.einsum("nj,bjkl->bnkl", self.weights, transforms[:, :, :3])
        return (blended[..., :3] @ self.centre[..., None])[..., 0] + blended[..., 3]

    def near(self, centres: Tensor, reach: float) -> Tensor:
        """(3, K) body, ball and ball of the pairs that are nearer each other than ``reach`` [m]."""
        found = []
        for k, own in enumerate(centres):
            apart = torch.cdist(own, own)[self.pairs[0], self.pairs[1]] - self.radius[self.pairs].sum(0)
            a, b = self.pairs[:, apart < reach]
            found.append(torch.stack([torch.full_like(a, k), a, b]))
        return torch.cat(found, 1)

    def depth(self, centres: Tensor, near: Tensor, gap: float) -> Tensor:
        """(K,) how much nearer than ``gap`` those pairs are [m]; 0: far enough."""
        body, a, b = near
        apart = (centres[body, a] - centres[body, b]).square().sum(-1).clamp_min(1e-10).sqrt()
        return (self.radius[a] + self.radius[b] + gap - apart).clamp_min(0)


def inscribed(body: Body, shape: Tensor, settings: Clearing) -> Balls:
    """The balls of one body of shape (1, S)."""
    vertices = body.rest(shape).vertices[0].detach()
    skin = trimesh.Trimesh(vertices.cpu().numpy(), body.faces.cpu().numpy(), process=False)
    normals = torch.as_tensor(np.array(skin.vertex_normals)).to(vertices)
    carrier = body.weights.argmax(1)
    part = torch.full((len(vertices),), -1, device=vertices.device)
    for k, names in enumerate(PARTS.values()):
        part[torch.isin(carrier, torch.tensor([JOINT_NAMES.index(n) for n in names], device=part.device))] = k
    chosen = _spread(vertices, settings.balls)
    radius = _radii(vertices, normals, chosen)
    centre = vertices[chosen] - radius[:, None] * normals[chosen]
    apart = torch.cdist(centre, centre) - radius[:, None] - radius
    own = part[chosen]
    a, b = torch.nonzero((own[:, None] < own) & (apart > settings.near), as_tuple=True)
    return Balls(centre, radius, body.weights[chosen], torch.stack([a, b]))


def _spread(points: Tensor, count: int) -> Tensor:
    """(count,) indices of points far from each other (farthest-point sampling)."""
    far = torch.full((len(points),), torch.inf, device=points.device)
    chosen = [0]
    for _ in range(count - 1):
        far = torch.minimum(far, (points - points[chosen[-1]]).square().sum(1))
        chosen.append(int(far.argmax()))
    return torch.tensor(chosen, device=points.device)


def _radii(vertices: Tensor, normals: Tensor, chosen: Tensor, bumps: float = 0.01) -> Tensor:
    """(N,) radii of the largest balls that touch the skin at chosen vertices from inside.

    No vertex q is nearer to the centre p - r n than r: r = min over q of |q - p|² / (2 (p - q)·n). Vertices within
    ``bumps`` [m] don't count: the skin's own relief there is not the body's.
    """
    step = vertices[chosen][:, None] - vertices
    square, along = step.square().sum(-1), (step * normals[chosen][:, None]).sum(-1)
    bound = torch.where((along > 1e-6) & (square > bumps**2), square / (2 * along.clamp_min(1e-6)), torch.inf)
    return bound.min(1).values.clamp(0.002, 0.15)


class Clearance:
    """Clears poses of one body."""

    def __init__(self, body: Body, shape: Tensor, settings: Clearing | None = None):
        """``shape`` (1, S)."""
        self.body, self.shape, self.settings = body, shape, settings or Clearing()
        self.balls = inscribed(body, shape, self.settings)
        self.joints = body.rest_joints(shape)

    def transforms(self, rotations: Tensor) -> Tensor:
        """(B, 24, 4, 4) of local rotations (B, 24, 3, 3)."""
        count = len(rotations)
        return joint_transforms(rotations, self.joints.expand(count, -1, -1), rotations.new_zeros(count, 3))[0]

    @torch.no_grad()
    def deepest(self, pose: Tensor) -> Tensor:
        """(B,) the most that two parts of the body are too near each other [m], of poses (B, 24, 3)."""
        gap, centres = self.settings.gap, self.balls.centres(self.transforms(rotation_matrices(pose)))
        near = self.balls.near(centres, gap)
        return pose.new_zeros(len(pose)).scatter_reduce(0, near[0], self.balls.depth(centres, near, gap), "amax")

    @torch.enable_grad()
    def cleared(self, pose: Tensor, motion: bool = False) -> Tensor:
        """(B, 24, 3) the poses, limbs turned out of the body; those that were clear come back as they are.

        ``motion``: the poses follow each other, and so must the turns.
        """
        s, rotations = self.settings, rotation_matrices(pose)
        free = [JOINT_NAMES.index(n) for n in TURNED]
        near = self.balls.near(self.balls.centres(self.transforms(rotations)), s.gap + REACH)
        if not (self.deepest(pose) > 0).any():
            return pose

        def turned(turn: Tensor) -> Tensor:
            own = rotations.clone()
            own[:, free] = rotation_matrices(turn) @ rotations[:, free]
            return own

        def loss(values: dict[str, Tensor]) -> Tensor:
            turn = values["turn"]
            depth = self.balls.depth(self.balls.centres(self.transforms(turned(turn))), near, s.gap) / 0.01
            cost = depth.square().sum() + s.turning * turn.square().sum()
            if motion and len(turn) > 1:
                cost = cost + s.turning * s.smooth * (turn[1:] - turn[:-1]).square().sum()
            return cost

        start = {"turn": torch.zeros(len(pose), len(free), 3, dtype=pose.dtype, device=pose.device)}
        found = descend(start, {"turn": 0.03}, loss, Descent(steps=s.steps, patience=s.steps)).values["turn"]
        moved = found.norm(dim=-1) > 1e-4
        out = pose.clone()
        out[:, free] = torch.where(moved[..., None], axis_angles(turned(found)[:, free]), pose[:, free])
        return out


def clear_motion(motion: Motion, body: Body, shape: Tensor, settings: Clearing | None = None) -> Motion:
    """The motion of a body of shape (1, S), its limbs clear of it, and a note on how far they were turned."""
    pose = Clearance(body, shape.to(motion.pose), settings).cleared(motion.pose, motion=True)
    turn = _turns(pose, motion.pose).amax(1)
    turned = int((turn > SEEN).sum())
    if not turned:
        return motion
    note = (
        f"limbs passed through the body: turned in {turned} of {len(turn)} frames, by {turn.max():.0f} degrees at most"
    )
    return replace(motion, pose=pose, notes=(*motion.notes, note))


def clear_bodies(bodies: BodyPose, body: Body, settings: Clearing | None = None) -> BodyPose:
    """Bodies of any shapes, each by itself, their limbs clear of them."""
    poses = [
        Clearance(body, shape[None], settings).cleared(pose[None]) for shape, pose in zip(bodies.shape, bodies.pose)
    ]
    return replace(bodies, pose=torch.cat(poses))


def _turns(a: Tensor, b: Tensor) -> Tensor:
    """(B, 24) angles between the local rotations of poses (B, 24, 3) [degrees]."""
    trace = (rotation_matrices(a) * rotation_matrices(b)).sum((-1, -2))
    return ((trace - 1) / 2).clamp(-1, 1).acos().rad2deg()
