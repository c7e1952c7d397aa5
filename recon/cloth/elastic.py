"""Compiled elastic energies of cloth: membrane and bending of one triangle or hinge, with their gradients.

Building blocks of the kernels in ``solve`` and ``frames``; the same formulas as :mod:`recon.cloth.energies`, in
doubles, a hundred times cheaper than automatic differentiation on a CPU.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from recon.cloth.energies import GRAVITY, Cloth

wp.config.log_level = wp.LOG_ERROR  # else it prints what it finds and compiles
wp.set_module_options({"enable_backward": False})


@wp.struct
class Elastic:
    """A cloth as kernels see it."""

    faces: wp.array(dtype=wp.vec3i)
    inverse: wp.array(dtype=wp.mat22d)
    areas: wp.array(dtype=wp.float64)
    hinges: wp.array(dtype=wp.vec4i)
    hinge_weights: wp.array(dtype=wp.float64)
    rest_angles: wp.array(dtype=wp.float64)
    weights: wp.array(dtype=wp.float64)
    mu: wp.float64
    lam: wp.float64
    bending: wp.float64


def elastic(cloth: Cloth, device: str) -> Elastic:
    """The struct of a cloth; areas are times the thickness, weights are forces of gravity [N]."""
    e = Elastic()

    def array(values: NDArray, dtype):
        return wp.array(values, dtype=dtype, device=device)

    e.faces = array(ints(cloth.faces), wp.vec3i)
    e.inverse = array(doubles(cloth.inverse), wp.mat22d)
    e.areas = array(doubles(cloth.areas) * cloth.fabric.thickness, wp.float64)
    e.hinges = array(ints(cloth.hinges), wp.vec4i)
    e.hinge_weights = array(doubles(cloth.hinge_weights), wp.float64)
    e.rest_angles = array(doubles(cloth.rest_angles), wp.float64)
    e.weights = array(doubles(cloth.masses) * GRAVITY, wp.float64)
    e.mu, e.lam, e.bending = cloth.fabric.lame_mu, cloth.fabric.lame_lambda, cloth.fabric.bending
    return e


@wp.func
def membrane(x: wp.array(dtype=wp.vec3d), g: wp.array(dtype=wp.vec3d), e: Elastic, t: int, first: int):
    """StVK energy [J] of triangle t, vertices counted from ``first``; adds its gradient [N] to g."""
    f = e.faces[t] + wp.vec3i(first, first, first)
    i = e.inverse[t]
    b = x[f[1]] - x[f[0]]
    c = x[f[2]] - x[f[0]]
    u = b * i[0, 0] + c * i[1, 0]
    v = b * i[0, 1] + c * i[1, 1]
    half = wp.float64(0.5)
    uu = half * (wp.dot(u, u) - wp.float64(1.0))
    vv = half * (wp.dot(v, v) - wp.float64(1.0))
    uv = half * wp.dot(u, v)
    trace = uu + vv
    two_mu = wp.float64(2.0) * e.mu
    a = e.areas[t]
    du = (u * (two_mu * uu + e.lam * trace) + v * (two_mu * uv)) * a
    dv = (v * (two_mu * vv + e.lam * trace) + u * (two_mu * uv)) * a
    gb = du * i[0, 0] + dv * i[0, 1]
    gc = du * i[1, 0] + dv * i[1, 1]
    g[f[1]] = g[f[1]] + gb
    g[f[2]] = g[f[2]] + gc
    g[f[0]] = g[f[0]] - gb - gc
    return a * (e.mu * (uu * uu + vv * vv + wp.float64(2.0) * uv * uv) + half * e.lam * trace * trace)


@wp.func
def hinge(x: wp.array(dtype=wp.vec3d), g: wp.array(dtype=wp.vec3d), e: Elastic, k: int, first: int):
    """Bending energy [J] of hinge k, as ``membrane``. Degenerate hinges give nothing."""
    h = e.hinges[k] + wp.vec4i(first, first, first, first)
    a = x[h[0]]
    b = x[h[1]]
    edge = b - a
    c = x[h[2]]
    d = x[h[3]]
    left = wp.cross(edge, c - a)
    right = wp.cross(d - a, edge)
    ll = wp.dot(left, left)
    rr = wp.dot(right, right)
    length = wp.length(edge)
    energy = wp.float64(0.0)
    if ll * rr > wp.float64(1.0e-26) and length > wp.float64(1.0e-6):
        angle = wp.atan2(wp.dot(wp.cross(left, right), edge) / length, wp.dot(left, right)) - e.rest_angles[k]
        scale = wp.float64(2.0) * e.bending * e.hinge_weights[k] * angle
        # Gradient of a dihedral angle (Bridson et al. 2003): along the two normals, shared out at the edge's ends.
        nl = left * (scale / ll)
        nr = right * (scale / rr)
        gc = nl * (-length)
        gd = nr * (-length)
        ga = nl * (-wp.dot(c - b, edge) / length) + nr * (-wp.dot(d - b, edge) / length)
        gb = nl * (wp.dot(c - a, edge) / length) + nr * (wp.dot(d - a, edge) / length)
        g[h[0]] = g[h[0]] + ga
        g[h[1]] = g[h[1]] + gb
        g[h[2]] = g[h[2]] + gc
        g[h[3]] = g[h[3]] + gd
        energy = e.bending * e.hinge_weights[k] * angle * angle
    return energy


def ints(tensor) -> NDArray:
    """A tensor as 32-bit integers for Warp."""
    return np.ascontiguousarray(tensor.cpu().numpy(), np.int32)


def doubles(tensor) -> NDArray:
    """A tensor as doubles for Warp."""
    return np.ascontiguousarray(tensor.detach().cpu().double().numpy())
