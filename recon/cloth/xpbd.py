"""A small XPBD cloth simulator (Macklin et al. 2016) that settles a sewn garment on a body, on the CPU through Warp.

All substeps between two contact searches run inside ONE compiled kernel on one thread: constraints are swept one
after the other (Gauss-Seidel), which is deterministic and, for a few thousand vertices, many times faster than one
launch per constraint colour. Parallelism comes from one process a garment.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from recon.cloth.constraints import Constraints, close_strangers, held_height, open_rim

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False, "fast_math": True})

DEVICE = "cpu"
CONTACT_REACH = 0.06
"""Body contact is searched for within this distance of a vertex [m]."""
ON_BORDER = wp.constant(1e-3)
"""Corners of a face with less weight than this play no part in a closest point."""


@dataclass(frozen=True)
class Settings:
    """How a garment is settled."""

    step: float = 1 / 2000
    """Substep [s]."""
    fit_steps: int = 300
    """Substeps without gravity, strongly damped: the placed pillow shrinks onto the body."""
    fall_steps: int = 800
    """Substeps with gravity, hardly damped."""
    rest_steps: int = 300
    """Substeps with gravity, strongly damped: the motion ends."""
    stretch_compliance: float = 1e-7
    """Compliance of the edges (unit masses)."""
    bend_compliance: float = 3e-3
    """Compliance of the distances across edges (unit masses)."""
    offset: float = 0.004
    """Distance kept from the body [m]."""
    friction: float = 0.4
    """Coulomb friction with the body."""
    self_distance: float = 0.75
    """Distance that vertices far apart in the pattern keep, in mean edge lengths."""


@wp.struct
class _Cloth:
    x: wp.array(dtype=wp.vec3)
    previous: wp.array(dtype=wp.vec3)
    velocity: wp.array(dtype=wp.vec3)
    pair: wp.array(dtype=wp.vec2i)
    length: wp.array(dtype=float)
    compliance: wp.array(dtype=float)
    held: wp.array(dtype=int)
    held_y: wp.array(dtype=float)
    side: wp.array(dtype=float)
    near: wp.array(dtype=wp.vec2i)
    near_length: wp.array(dtype=float)
    plane_point: wp.array(dtype=wp.vec3)
    plane_normal: wp.array(dtype=wp.vec3)
    touching: wp.array(dtype=float)


@wp.struct
class _Motion:
    step: float
    gravity: float
    damping: float
    speed_limit: float
    offset: float
    friction: float


@wp.func
def _on_rim(mesh: wp.uint64, rim: wp.array(dtype=int), face: int, u: float, v: float):
    weights = wp.vec3(u, v, 1.0 - u - v)
    for k in range(3):
        if weights[k] > ON_BORDER and rim[wp.mesh_get_index(mesh, 3 * face + k)] == 0:
            return False
    return True


@wp.kernel
def _search(mesh: wp.uint64, rim: wp.array(dtype=int), reach: float, cloth: _Cloth):
    i = wp.tid()
    x = cloth.x[i]
    hit = wp.mesh_query_point_sign_normal(mesh, x, reach)
    cloth.touching[i] = 0.0
    if hit.result:
        on = wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
        normal = wp.mesh_eval_face_normal(mesh, hit.face)
        away = x - on
        if wp.length(away) > 1.0e-5:
            side = hit.sign
            if _on_rim(mesh, rim, hit.face, hit.u, hit.v):
                side = 1.0  # beside an open border there are no sides: keep away from it
            normal = wp.normalize(away) * side
        cloth.plane_point[i] = on
        cloth.plane_normal[i] = normal
        cloth.touching[i] = 1.0


@wp.func
def _pull(cloth: _Cloth, a: int, b: int, rest: float, softness: float):
    d = cloth.x[a] - cloth.x[b]
    length = wp.length(d)
    if length > 1.0e-9:
        move = d * (-(length - rest) / ((2.0 + softness) * length))
        cloth.x[a] = cloth.x[a] + move
        cloth.x[b] = cloth.x[b] - move


@wp.kernel
def _advance(cloth: _Cloth, motion: _Motion, vertices: int, pairs: int, nears: int, steps: int):
    inverse = 1.0 / motion.step
    for _s in range(steps):
        for i in range(vertices):
            v = (cloth.velocity[i] - wp.vec3(0.0, motion.gravity * motion.step, 0.0)) * motion.damping
            speed = wp.length(v)
            if speed > motion.speed_limit:
                v = v * (motion.speed_limit / speed)
            cloth.previous[i] = cloth.x[i]
            cloth.x[i] = cloth.x[i] + v * motion.step
        for c in range(pairs):
            p = cloth.pair[c]
            _pull(cloth, p[0], p[1], cloth.length[c], cloth.compliance[c] * inverse * inverse)
        for c in range(nears):
            p = cloth.near[c]
            d = cloth.x[p[0]] - cloth.x[p[1]]
            if wp.length(d) < cloth.near_length[c]:
                _pull(cloth, p[0], p[1], cloth.near_length[c], 2.0)
        for c in range(cloth.held.shape[0]):
            i = cloth.held[c]
            x = cloth.x[i]
            cloth.x[i] = wp.vec3(x[0], cloth.held_y[c], x[2])
        for i in range(vertices):
            if cloth.touching[i] > 0.0:
                n = cloth.plane_normal[i]
                depth = motion.offset - wp.dot(cloth.x[i] - cloth.plane_point[i], n)
                if depth > 0.0:
                    x = cloth.x[i] + n * depth
                    moved = x - cloth.previous[i]
                    slide = moved - n * wp.dot(n, moved)
                    distance = wp.length(slide)
                    if distance > 1.0e-9:
                        x = x - slide * wp.min(1.0, motion.friction * depth / distance)
                    cloth.x[i] = x
            side = cloth.side[i]
            if side != 0.0:
                x = cloth.x[i]
                if x[0] * side < 0.0015:
                    cloth.x[i] = wp.vec3(0.0015 * side, x[1], x[2])
        for i in range(vertices):
            cloth.velocity[i] = (cloth.x[i] - cloth.previous[i]) * inverse


def body_mesh(vertices: NDArray, faces: NDArray) -> wp.Mesh:
    """The body as Warp's search structure."""
    points = wp.array(np.ascontiguousarray(vertices, np.float32), dtype=wp.vec3, device=DEVICE)
    return wp.Mesh(points, wp.array(faces.astype(np.int32).ravel(), dtype=int, device=DEVICE))


def settle(start: NDArray, constraints: Constraints, body: wp.Mesh, settings: Settings | None = None) -> NDArray:
    """(V, 3) positions of a garment at rest on the body, from its placed ones ``start`` (V, 3) [m]."""
    s = settings or Settings()
    state = _begin(start, constraints, body, s)
    _run(state, s.fit_steps, gravity=0.0, damping=0.96, friction=0.02, search=8, limit=1.5)
    _run(state, s.fall_steps, gravity=9.81, damping=0.997, friction=s.friction, search=16, limit=3.0)
    _run(state, s.rest_steps, gravity=9.81, damping=0.97, friction=s.friction, search=20, limit=3.0)
    return state.cloth.x.numpy().astype(np.float64)


@dataclass(frozen=True)
class Carry:
    """How a garment is carried along by a moving body."""

    first_steps: int = 200
    """Substeps before the body moves."""
    steps: int = 16
    """Substeps per frame."""
    last_steps: int = 400
    """Substeps after it moved."""
    damping: float = 0.97
    """Share of the velocity that a substep keeps: the motion is quasi-static."""


def carry(
    transport: NDArray,
    constraints: Constraints,
    frames: NDArray,
    faces: NDArray,
    settings: Settings | None = None,
    how: Carry | None = None,
) -> Iterator[NDArray]:
    """Carry a garment from the body's first frame to its last; yields its (V, 3) positions after each frame [m].

    Between frames the cloth first moves as ``transport`` does, then relaxes: so it neither lags behind nor is dragged
    along by contact alone, and folds grow as the pose does.

    Args:
        transport: (T, V, 3) where skinning alone takes the garment [m]; its first frame is the start.
        constraints: the garment's; a waistband keeps the height that ``transport`` gives it.
        frames: (T, B, 3) what it collides with: the body and layers beneath [m].
        faces: (F, 3) of those, outward.
    """
    s, how = settings or Settings(), how or Carry()
    mesh = body_mesh(frames[0], faces)
    state = _begin(transport[0], constraints, mesh, s, open_rim(faces, frames.shape[1]))
    state.cloth.held_y.numpy()[:] = transport[0, constraints.held, 1]

    def relax(steps: int) -> None:
        _run(state, steps, gravity=9.81, damping=how.damping, friction=s.friction, search=8, limit=1.5)

    relax(how.first_steps)
    yield state.cloth.x.numpy().astype(np.float64)
    for k in range(1, len(frames)):
        mesh.points.numpy()[:] = frames[k]
        mesh.refit()
        state.cloth.x.numpy()[:] += (transport[k] - transport[k - 1]).astype(np.float32)
        state.cloth.held_y.numpy()[:] = transport[k, constraints.held, 1]
        last = k + 1 == len(frames)
        relax(how.steps + (how.last_steps if last else 0))
        yield state.cloth.x.numpy().astype(np.float64)


@dataclass
class _State:
    cloth: _Cloth
    pairs: int
    count: int
    constraints: Constraints
    body: wp.Mesh
    rim: wp.array
    settings: Settings


def _run(state: _State, steps: int, *, gravity: float, damping: float, friction: float, search: int, limit: float):
    motion = _Motion()
    motion.step, motion.gravity, motion.damping, motion.speed_limit = state.settings.step, gravity, damping, limit
    motion.offset, motion.friction = state.settings.offset, friction
    done = 0
    while done < steps:
        now = min(search, steps - done)
        wp.launch(_search, state.count, inputs=[state.body.id, state.rim, CONTACT_REACH, state.cloth], device=DEVICE)
        nears = _search_self(state) if gravity > 0 else 0
        inputs = [state.cloth, motion, state.count, state.pairs, nears, now]
        wp.launch(_advance, 1, inputs=inputs, device=DEVICE)
        done += now


def _search_self(state: _State) -> int:
    """Fill the list of close strangers; they are kept ``self_distance`` apart."""
    distance = state.settings.self_distance * float(state.constraints.edge_lengths.mean())
    pairs = close_strangers(state.cloth.x.numpy(), state.constraints.rest, distance)
    pairs = pairs[: state.cloth.near.shape[0]]
    if len(pairs):
        state.cloth.near.numpy()[: len(pairs)] = pairs
        state.cloth.near_length.numpy()[: len(pairs)] = distance
    return len(pairs)


def _begin(start: NDArray, constraints: Constraints, body: wp.Mesh, s: Settings, rim: NDArray | None = None) -> _State:
    cloth, pairs = _allocate(start, constraints, s)
    open_ends = wp.array(np.zeros(len(body.points)) if rim is None else rim, dtype=int, device=DEVICE)
    return _State(cloth, pairs, len(start), constraints, body, open_ends, s)


def _allocate(start: NDArray, constraints: Constraints, s: Settings) -> tuple[_Cloth, int]:
    n = len(start)
    pair = np.concatenate([constraints.edges, constraints.bends]).astype(np.int32)
    compliance = np.repeat([s.stretch_compliance, s.bend_compliance], [len(constraints.edges), len(constraints.bends)])
    side = np.zeros(n) if constraints.side is None else constraints.side
    cloth = _Cloth()

    def floats(values):
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=float, device=DEVICE)

    cloth.x = wp.array(np.ascontiguousarray(start, np.float32), dtype=wp.vec3, device=DEVICE)
    for name in ("previous", "velocity", "plane_point", "plane_normal"):
        setattr(cloth, name, wp.zeros(n, dtype=wp.vec3, device=DEVICE))
    cloth.touching = wp.zeros(n, dtype=float, device=DEVICE)
    cloth.pair = wp.array(pair, dtype=wp.vec2i, device=DEVICE)
    cloth.length = floats(np.concatenate([constraints.edge_lengths, constraints.bend_lengths]))
    cloth.compliance = floats(compliance)
    cloth.held = wp.array(constraints.held.astype(np.int32), dtype=int, device=DEVICE)
    cloth.held_y = floats(np.full(len(constraints.held), held_height(start, constraints.held)))
    cloth.side = floats(side)
    cloth.near = wp.zeros(20 * n, dtype=wp.vec2i, device=DEVICE)
    cloth.near_length = wp.zeros(20 * n, dtype=float, device=DEVICE)
    return cloth, len(pair)


@wp.kernel
def _keep_lengths(
    x: wp.array(dtype=wp.vec3d),
    pair: wp.array(dtype=wp.vec2i),
    length: wp.array(dtype=wp.float64),
    stiffness: wp.float64,
    sweeps: int,
):
    for _s in range(sweeps):
        for k in range(pair.shape[0]):
            p = pair[k]
            d = x[p[0]] - x[p[1]]
            now = wp.length(d)
            if now > wp.float64(1.0e-9):
                move = d * (wp.float64(0.5) * stiffness * (length[k] - now) / now)
                x[p[0]] = x[p[0]] + move
                x[p[1]] = x[p[1]] - move


def keep_lengths(x: NDArray, pairs: NDArray, lengths: NDArray, stiffness: float, sweeps: int) -> NDArray:
    """(V, 3) vertices after ``sweeps`` over ``pairs`` (E, 2), each giving back a share of its error in length."""
    moved = wp.array(np.ascontiguousarray(x, np.float64), dtype=wp.vec3d, device=DEVICE)
    pair = wp.array(pairs.astype(np.int32), dtype=wp.vec2i, device=DEVICE)
    length = wp.array(np.ascontiguousarray(lengths, np.float64), dtype=wp.float64, device=DEVICE)
    wp.launch(_keep_lengths, 1, inputs=[moved, pair, length, stiffness, sweeps], device=DEVICE)
    return moved.numpy().astype(np.float64)
