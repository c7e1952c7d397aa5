"""What a tailor measures: lengths and girths of a body in the T pose, from its joints and plane slices.

Everything that a sewing pattern needs to know about a body is here, so that no size is written into a pattern.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

STEP = 0.01
"""Distance between slices [m]."""


@dataclass(frozen=True)
class Profile:
    """A tube of the body, slice by slice along one axis (interpolated in between, constant beyond)."""

    at: NDArray
    """(N,) ascending positions of the slices along the axis [m]."""
    girth: NDArray
    """(N,) perimeter of each slice's convex hull [m]: what a tape shows."""
    low: NDArray
    """(N, 2) least coordinates of the slice's two in-plane axes [m]."""
    high: NDArray
    """(N, 2) greatest coordinates of the slice's two in-plane axes [m]."""

    def girth_at(self, position: float | NDArray) -> NDArray | float:
        """Girth [m] at positions along the axis."""
        return np.interp(position, self.at, self.girth)

    def low_at(self, position: float | NDArray, axis: int) -> NDArray | float:
        """Least in-plane coordinate [m] at positions along the axis."""
        return np.interp(position, self.at, self.low[:, axis])

    def high_at(self, position: float | NDArray, axis: int) -> NDArray | float:
        """Greatest in-plane coordinate [m] at positions along the axis."""
        return np.interp(position, self.at, self.high[:, axis])


@dataclass(frozen=True)
class Measures:
    """A body in the T pose (y up, facing +z, wearer's left = +x), measured for sewing patterns."""

    vertices: NDArray
    """(V, 3) [m]."""
    faces: NDArray
    """(F, 3)."""
    joints: NDArray
    """(24, 3) in the common rig's order [m]."""

    @classmethod
    def from_body(cls, body) -> Measures:
        """Measure the neutral body of a ``recon.bodies`` Body."""
        shape = body.neutral().shape
        mesh, joints = body.rest(shape), body.rest_joints(shape)
        return cls(mesh.vertices[0].double().cpu().numpy(), mesh.faces.cpu().numpy(), joints[0].double().cpu().numpy())

    @property
    def shoulder(self) -> NDArray:
        """(3,) left shoulder joint."""
        return self.joints[16]

    @property
    def wrist_x(self) -> float:
        """Lateral position of the wrist [m]."""
        return float(self.joints[20, 0])

    @property
    def elbow_x(self) -> float:
        """Lateral position of the elbow [m]."""
        return float(self.joints[18, 0])

    @property
    def knee_y(self) -> float:
        """Height of the knee [m]."""
        return float(self.joints[4, 1])

    @property
    def ankle_y(self) -> float:
        """Height of the ankle [m]."""
        return float(self.joints[7, 1])

    @cached_property
    def crotch_y(self) -> float:
        """Height of the crotch: the lowest point of the body's middle slice below the waist [m]."""
        points = slice_points(self.vertices, self.faces, 0, 0.0)
        points = points[(points[:, 0] > self.knee_y) & (points[:, 0] < self.joints[3, 1])]
        return float(points[:, 0].min())

    @cached_property
    def trunk(self) -> Profile:
        """Slices at heights from the ankle to the armpit (both legs together below the crotch); axes x, z."""
        heights = np.arange(self.ankle_y, self.armpit_y, STEP)
        return _profile(heights, [slice_points(self.vertices, self.faces, 1, y) for y in heights])

    @cached_property
    def leg(self) -> Profile:
        """Slices of the left leg at heights from the ankle to the crotch; axes x, z."""
        heights = np.arange(self.ankle_y, self.crotch_y - 0.01, STEP)
        slices = [slice_points(self.vertices, self.faces, 1, y) for y in heights]
        return _profile(heights, [p[p[:, 0] > 0] for p in slices])

    @cached_property
    def arm(self) -> Profile:
        """Slices of the left arm at x from just outside the torso to the wrist; axes y, z."""
        positions = np.arange(self.shoulder[0] + 0.03, self.wrist_x, STEP)
        slices = [slice_points(self.vertices, self.faces, 0, x) for x in positions]
        return _profile(positions, [p[np.abs(p[:, 0] - self.shoulder[1]) < 0.12] for p in slices])

    @cached_property
    def top(self) -> Profile:
        """Slices at x from the middle to the wrist, above the armpit: their greatest y is the shoulder line."""
        positions = np.arange(0.0, self.wrist_x, STEP)
        slices = [slice_points(self.vertices, self.faces, 0, x + 1e-5) for x in positions]
        limit = self.joints[12, 1] + 0.02  # the head is wider than the neck
        return _profile(positions, [p[(p[:, 0] > self.armpit_y) & (p[:, 0] < limit)] for p in slices])

    @cached_property
    def armpit_y(self) -> float:
        """Height of the armpit: the arm's underside close to the torso [m]."""
        points = slice_points(self.vertices, self.faces, 0, float(self.shoulder[0]) + 0.05)
        return float(points[np.abs(points[:, 0] - self.shoulder[1]) < 0.12][:, 0].min())

    @cached_property
    def waist_y(self) -> float:
        """Height of the narrowest trunk between hip joint and armpit [m]."""
        at = (self.trunk.at > self.joints[0, 1]) & (self.trunk.at < self.armpit_y - 0.05)
        return float(self.trunk.at[at][self.trunk.girth[at].argmin()])

    @cached_property
    def hip_y(self) -> float:
        """Height of the widest trunk between crotch and waist [m]."""
        at = (self.trunk.at > self.crotch_y + 0.03) & (self.trunk.at < self.waist_y)
        return float(self.trunk.at[at][self.trunk.girth[at].argmax()])

    @cached_property
    def chest_y(self) -> float:
        """Height at which a top's chest is measured: a hand below the armpit [m]."""
        return self.armpit_y - 0.06

    @cached_property
    def neck_x(self) -> float:
        """Half of the neck's width, halfway between neck and head joint [m]."""
        points = slice_points(self.vertices, self.faces, 1, float(self.joints[12, 1]) + 0.03)
        return float(np.abs(points[:, 0]).max())

    def crotch_path(self, waist_y: float) -> float:
        """Length of a tape from the front at ``waist_y`` under the crotch to the back, over the hollows [m]."""
        points = slice_points(self.vertices, self.faces, 0, 0.0)
        points = points[(points[:, 0] < waist_y) & (points[:, 0] > self.knee_y)]
        hull = points[_hull(points)]
        following = np.roll(hull, -1, 0)
        across = np.minimum(hull[:, 0], following[:, 0]) > waist_y - 0.03  # the chord that closes the hull on top
        return float(np.linalg.norm(following - hull, axis=1)[~across].sum())


def slice_points(vertices: NDArray, faces: NDArray, axis: int, at: float) -> NDArray:
    """(N, 2) points where the mesh's edges cross the plane ``coordinate[axis] = at``, in the two other coordinates."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    crosses = (a[:, axis] < at) != (b[:, axis] < at)
    a, b = a[crosses], b[crosses]
    t = (at - a[:, axis]) / (b[:, axis] - a[:, axis])
    points = a + t[:, None] * (b - a)
    return np.delete(points, axis, 1)


def _hull(points: NDArray) -> NDArray:
    from scipy.spatial import ConvexHull

    return ConvexHull(points).vertices


def _profile(at: NDArray, slices: list[NDArray]) -> Profile:
    loops = [p[_hull(p)] for p in slices]
    girth = np.array([np.linalg.norm(np.roll(p, -1, 0) - p, axis=1).sum() for p in loops])
    return Profile(at, girth, np.array([p.min(0) for p in loops]), np.array([p.max(0) for p in loops]))
