"""A linear body: template + shape directions, 24 joints, linear blend skinning (SMPL's function M(beta, theta)).

Anny's export and the user's SMPL files are both instances; they differ in data only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from recon.bodies.rig import JOINT_NAMES, PARENTS, REGION_NAMES, joint_transforms, rotation_matrices
from recon.bodies.skin import skin
from recon.types import BodyPose, Mesh, PosedBody

ALIASES = {"arms": ("upper_arms", "forearms")}


@dataclass(frozen=True)
class Measures:
    """A joint Gaussian of measures and shape coefficients, for bodies by height, mass ..."""

    names: tuple[str, ...]
    """height [m], mass [kg], gender [-1 man .. 1 woman], muscle [-1 .. 1]."""
    mean: Tensor
    """(M,)"""
    covariance: Tensor
    """(M, M)"""
    beta_covariance: Tensor
    """(S, M)"""


@dataclass(frozen=True)
class LinearBody:
    """A body in the common 24-joint rig; batched and differentiable in shape, pose and translation."""

    template: Tensor
    """(V, 3) neutral T-pose vertices [m], feet at y = 0."""
    shape_dirs: Tensor
    """(V, 3, S) displacement [m] per unit of each shape coefficient."""
    joints: Tensor
    """(24, 3) neutral joints [m]."""
    joint_dirs: Tensor
    """(24, 3, S)."""
    weights: Tensor
    """(V, 24) skinning weights, rows sum to 1."""
    faces: Tensor
    """(F, 3) long, counter-clockwise from outside."""
    regions: Tensor
    """(V,) long, index into ``region_names``."""
    landmark_index: Tensor
    """(33, K) long, into [24 joints; V vertices]."""
    landmark_weight: Tensor
    """(33, K), rows sum to 1."""
    name: str = "body"
    pose_dirs: Tensor | None = None
    """(V, 3, 207) SMPL's pose blend shapes on R(theta) - I of joints 1..23, or None."""
    measures: Measures | None = None
    parents: tuple[int, ...] = PARENTS
    joint_names: tuple[str, ...] = JOINT_NAMES
    region_names: tuple[str, ...] = REGION_NAMES
    card: dict = field(default_factory=dict)
    """Where the data come from, and how well they were measured."""

    @property
    def n_shape(self) -> int:
        """Number of shape coefficients S."""
        return self.shape_dirs.shape[2]

    @property
    def n_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.template)

    def neutral(self, batch: int = 1) -> BodyPose:
        """The average body in T pose, ``batch`` times."""
        zeros = self.template.new_zeros
        return BodyPose(zeros(batch, self.n_shape), zeros(batch, 24, 3), zeros(batch, 3))

    def rest(self, shape: Tensor) -> Mesh:
        """Bodies of shape (B, S) in T pose: Mesh with (B, V, 3)."""
        self._check(shape, "shape", (self.n_shape,))
        v = torch.matmul(shape, self.shape_dirs.flatten(0, 1).T).unflatten(-1, (-1, 3))
        return Mesh(self.template + v, self.faces)

    def rest_joints(self, shape: Tensor) -> Tensor:
        """(B, S) -> (B, 24, 3) T-pose joints [m]."""
        return self.joints + torch.matmul(shape, self.joint_dirs.flatten(0, 1).T).unflatten(-1, (24, 3))

    def skeleton(self, body: BodyPose, rotations: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(B, 24, 4, 4) transforms from rest space to the world and (B, 24, 3) joints: what garments hang on.

        Without the body's own vertices, which take most of ``pose``'s time; ``rotations`` (B, 24, 3, 3) of the pose, if
        known.
        """
        rotations = rotation_matrices(body.pose) if rotations is None else rotations
        return joint_transforms(rotations, self.rest_joints(body.shape), body.translation)

    def pose(self, body: BodyPose) -> PosedBody:
        """Pose the bodies: forward kinematics, then linear blend skinning of the T-pose vertices."""
        self._check(body.pose, "pose", (24, 3))
        self._check(body.translation, "translation", (3,))
        rest = self.rest(body.shape)
        rotations = rotation_matrices(body.pose)
        transforms, posed = self.skeleton(body, rotations)
        vertices = rest.vertices
        if self.pose_dirs is not None:
            features = rotations[:, 1:] - torch.eye(3).to(vertices)
            bend = torch.matmul(features.flatten(1), self.pose_dirs.flatten(0, 1).T).unflatten(-1, (-1, 3))
            vertices = vertices + bend
        return PosedBody(
            rest.with_vertices(skin(vertices, transforms, self.weights)),
            rest,
            posed,
            transforms,
            self.weights,
            body.shape,
        )

    def landmarks(self, posed: PosedBody) -> Tensor:
        """(B, 33, 3) BlazePose's landmarks on the posed body, world [m]."""
        points = torch.cat([posed.joints, posed.mesh.vertices], 1)
        return (points[:, self.landmark_index] * self.landmark_weight[..., None]).sum(2)

    def region_mask(self, *names: str) -> Tensor:
        """(V,) bool: vertices of the named regions ('arms' = upper_arms + forearms)."""
        index = [self.region_names.index(r) for n in names for r in ALIASES.get(n, (n,))]
        return torch.isin(self.regions, torch.tensor(index, device=self.regions.device))

    def shape_from(self, **known: float) -> Tensor:
        """(1, S) the likeliest shape given some of ``measures.names``, e.g. ``shape_from(height=1.8, gender=-1)``.

        Conditional mean of a Gaussian: C_bm C_mm^-1 (m - mean), over the given measures alone.
        """
        if self.measures is None:
            raise ValueError(f"body {self.name} has no measures to choose a shape by")
        unknown = set(known) - set(self.measures.names)
        if unknown:
            raise ValueError(f"unknown measures {sorted(unknown)}; known are {', '.join(self.measures.names)}")
        at = [self.measures.names.index(k) for k in known]
        m = self.template.new_tensor(list(known.values())) - self.measures.mean[at]
        gain = torch.linalg.solve(self.measures.covariance[at][:, at], m)
        return (self.measures.beta_covariance[:, at] @ gain)[None]

    @staticmethod
    def _check(value: Tensor, name: str, tail: tuple[int, ...]) -> None:
        if value.dim() != len(tail) + 1 or tuple(value.shape[1:]) != tail:
            raise ValueError(f"{name}: shape {tuple(value.shape)}, wanted (B, {', '.join(map(str, tail))})")
