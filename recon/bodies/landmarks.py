"""BlazePose's 33 landmarks as fixed combinations of a body's joints and vertices."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from recon.bodies.rig import JOINT_NAMES

LANDMARK_JOINTS = {11: "l_shoulder", 12: "r_shoulder", 13: "l_elbow", 14: "r_elbow", 15: "l_wrist", 16: "r_wrist",
                   23: "l_hip", 24: "r_hip", 25: "l_knee", 26: "r_knee", 27: "l_ankle", 28: "r_ankle"}  # fmt: skip
"""Landmarks that are joints of the rig; all others are points of the skin or under it."""
NEIGHBOURS = 12


def combine(target: np.ndarray, vertices: np.ndarray, count: int = NEIGHBOURS) -> tuple[np.ndarray, np.ndarray]:
    """The nearest vertices and the smallest weights of sum 1 that combine them to the target point.

    The point then moves with the skin around it. Lengths are scaled to 2 cm, so that sum and place weigh alike.
    """
    near = np.argsort(((vertices - target) ** 2).sum(1))[:count]
    system = np.concatenate([(vertices[near] - target).T / 0.02, np.ones((1, count))])
    weight = np.linalg.pinv(system) @ np.array([0, 0, 0, 1.0])
    return near, weight / weight.sum()


def landmark_table(vertices: np.ndarray, targets: Mapping[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(33, 12) indices into [24 joints; V vertices] and (33, 12) weights of sum 1.

    targets: landmark -> its place on the neutral body (V, 3), for every landmark that is no joint.
    """
    index, weight = np.zeros((33, NEIGHBOURS), np.int64), np.zeros((33, NEIGHBOURS), np.float32)
    for i, joint in LANDMARK_JOINTS.items():
        index[i], weight[i, 0] = JOINT_NAMES.index(joint), 1.0
    for i, target in targets.items():
        near, w = combine(target, vertices)
        index[i], weight[i] = near + len(JOINT_NAMES), w
    return index, weight


def front_point(vertices: np.ndarray, x: float, y: float, radius: float = 0.004) -> np.ndarray:
    """(3,) the skin at (x, y) seen from the front [m]: exactly there, as deep as the foremost vertices around."""
    distance = np.hypot(vertices[:, 0] - x, vertices[:, 1] - y)
    near = distance < max(radius, np.partition(distance, 3)[3] * 1.01)
    z = vertices[near, 2]
    return np.array([x, y, z[z > z.max() - 0.015].mean()])
