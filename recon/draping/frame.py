"""A skeleton posed one frame at a time, in one compiled kernel.

The same numbers as ``rig.joint_transforms`` and ``gaps.motion_features``, which know batches and gradients: for one
frame of 24 joints, calling their sixty small operations takes twenty times as long as the arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})

DEVICE = "cpu"


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch works in one thread meanwhile: products of one frame are too small to share out, and where another program
    has the second core, waiting for it takes longer than all of the work."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


class FrameRig:
    """A body's skeleton, posed frame after frame; it remembers the pelvis of the frame before."""

    def __init__(self, joints: Tensor, parents: Sequence[int], speed: float, before: FrameRig | None = None):
        """
        Args:
            joints: (24, 3) at rest [m].
            parents: of each joint, before it in the list; -1 for the root.
            speed: factor on velocities in the features.
            before: the rig of the frame before, where another one was posed then; None = the first frame stands still.
        """
        count = len(joints)
        self.speed = speed
        self.joints = wp.array(joints.detach().cpu().float().contiguous().numpy(), dtype=wp.vec3, device=DEVICE)
        self.parents = wp.array(np.asarray(parents, np.int32), dtype=int, device=DEVICE)
        self.pose = wp.zeros(count, dtype=wp.vec3, device=DEVICE)
        self.place = wp.zeros(1, dtype=wp.vec3, device=DEVICE)
        self.pelvis: tuple[wp.array, wp.array] = before.pelvis if before else _standing()
        """The last frame's rotation and place."""
        self.posed = wp.zeros(count, dtype=wp.mat44, device=DEVICE)
        self.seen = wp.zeros(6 * (count - 1) + 9, dtype=float, device=DEVICE)
        self._pose, self._place = self.pose.numpy(), self.place.numpy()[0]  # views: the memory is shared
        self._features = torch.from_numpy(self.seen.numpy())
        self.transforms = torch.from_numpy(self.posed.numpy())[None]
        self._still = before is None
        self._command = wp.launch(
            _pose_rig,
            1,
            [self.pose, self.place, self.joints, self.parents, *self.pelvis, 0.0],
            [self.posed, self.seen],
            device=DEVICE,
            record_cmd=True,
        )

    def __call__(self, pose: Tensor, place: Tensor, fps: float) -> Tensor:
        """Pose (24, 3) [rad] and place (3,) [m] -> features (FEATURES,), valid until the next call.

        ``transforms`` (1, 24, 4, 4) lead from rest to the world afterwards.
        """
        self._pose[:] = pose.detach().cpu().numpy()
        self._place[:] = place.detach().cpu().numpy()
        self._command.set_param_at_index(6, 0.0 if self._still else fps * self.speed)
        self._command.launch()
        self._still = False
        return self._features


def _standing() -> tuple[wp.array, wp.array]:
    return wp.zeros(1, dtype=wp.mat33, device=DEVICE), wp.zeros(1, dtype=wp.vec3, device=DEVICE)


@wp.func
def _rotation(r: wp.vec3):
    square = wp.dot(r, r)
    a = 1.0 - square / 6.0
    b = 0.5 - square / 24.0
    if square > 1.0e-6:
        angle = wp.sqrt(square)
        a = wp.sin(angle) / angle
        b = (1.0 - wp.cos(angle)) / square
    k = wp.skew(r)
    return wp.identity(n=3, dtype=float) + k * a + (k * k) * b


@wp.func
def _transform(r: wp.mat33, t: wp.vec3):
    return wp.mat44(
        r[0, 0], r[0, 1], r[0, 2], t[0],
        r[1, 0], r[1, 1], r[1, 2], t[1],
        r[2, 0], r[2, 1], r[2, 2], t[2],
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


@wp.kernel
def _pose_rig(
    pose: wp.array(dtype=wp.vec3),
    place: wp.array(dtype=wp.vec3),
    joints: wp.array(dtype=wp.vec3),
    parents: wp.array(dtype=int),
    last_turned: wp.array(dtype=wp.mat33),
    last_place: wp.array(dtype=wp.vec3),
    rate: float,
    posed: wp.array(dtype=wp.mat44),
    seen: wp.array(dtype=float),
):
    count = pose.shape[0]
    root = _rotation(pose[0])
    posed[0] = _transform(root, joints[0] + place[0] - root * joints[0])
    for j in range(1, count):  # parents come before their children
        local = _rotation(pose[j])
        for i in range(3):
            seen[6 * (j - 1) + 2 * i] = local[i, 0]
            seen[6 * (j - 1) + 2 * i + 1] = local[i, 1]
        # Seen from its parent a joint turns about itself.
        posed[j] = posed[parents[j]] * _transform(local, joints[j] - local * joints[j])
    to_own = wp.transpose(root)
    velocity = to_own * (place[0] - last_place[0]) * rate
    turn = to_own * last_turned[0]
    n = 6 * (count - 1)
    for i in range(3):
        seen[n + i] = to_own[i, 1]
        seen[n + 3 + i] = velocity[i]
    half = 0.5 * rate
    seen[n + 6] = (turn[1, 2] - turn[2, 1]) * half
    seen[n + 7] = (turn[2, 0] - turn[0, 2]) * half
    seen[n + 8] = (turn[0, 1] - turn[1, 0]) * half
    last_turned[0] = root
    last_place[0] = place[0]
