# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Triangulation of features from rays: the point nearest to them, then Gauss-Newton.

Gauss-Newton is on the error on the plane z = 1, over (α, β, ρ): the feature is at (α, β, 1) / ρ in
the camera that saw it first, its anchor.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["triangulate_rays", "triangulate_rays_numpy"]

STEPS = 5
"""Damped Gauss-Newton steps that refine the linear solution, at most."""
_REGULARISATION = 1e-9
"""Added to diagonals, so that features without parallax have a solution too (which is refused)."""
_NEAREST = 1e-3
"""Points nearer than this, in units of their distance to the anchor, are projected as if there."""
_CONVERGED = 1e-7
"""Steps of all features that are smaller are the last."""


@compiled()
def _solve(A: FloatArray, b: FloatArray, x: FloatArray) -> None:
    """The solution x (3,) of A x = b for a positive definite A (3, 3), by LDLᵀ."""
    d0, a10, a20, b0 = A[0, 0], A[1, 0], A[2, 0], b[0]
    l10, l20 = a10 / d0, a20 / d0
    d1 = A[1, 1] - l10 * a10
    l21 = (A[2, 1] - l20 * a10) / d1
    d2 = A[2, 2] - l20 * a20 - l21 * l21 * d1
    y1 = b[1] - l10 * b0
    x2 = (b[2] - l20 * b0 - l21 * y1) / d2
    x1 = y1 / d1 - l21 * x2
    x[0], x[1], x[2] = b0 / d0 - l10 * x1 - l20 * x2, x1, x2


@compiled()
def _nearest_to_rays(
    R: FloatArray, p: FloatArray, normalized: FloatArray, first: int, last: int, point: FloatArray
) -> None:
    """The point (3,) with the least sum of squared distances to the rays of one feature."""
    lhs, rhs, b, offset = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        rhs[i] = 0.0
        for k in range(3):
            lhs[i, k] = _REGULARISATION if i == k else 0.0
    for n in range(first, last):
        u, v = normalized[n, 0], normalized[n, 1]
        length = math.sqrt(u * u + v * v + 1.0)
        for i in range(3):
            b[i] = (R[n, i, 0] * u + R[n, i, 1] * v + R[n, i, 2]) / length
            offset[i] = p[n, i] - p[first, i]
        for i in range(3):
            for k in range(3):
                A = (1.0 if i == k else 0.0) - b[i] * b[k]
                lhs[i, k] += A
                rhs[i] += A * offset[k]
    _solve(lhs, rhs, point)
    for i in range(3):
        point[i] += p[first, i]


@compiled()
def _normal_equations(
    R: FloatArray,
    t: FloatArray,
    normalized: FloatArray,
    weights: FloatArray,
    first: int,
    last: int,
    x: FloatArray,
    lhs: FloatArray,
    rhs: FloatArray,
) -> float:
    """Squared error, JᵀJ (3, 3) and Jᵀr (3,) of one feature at x (3,)."""
    l00 = l10 = l11 = l20 = l21 = l22 = 0.0
    b0 = b1 = b2 = error = 0.0
    x0, x1, x2 = x[0], x[1], x[2]
    for n in range(first, last):
        a00, a01 = R[n, 0, 0], R[n, 0, 1]
        a10, a11 = R[n, 1, 0], R[n, 1, 1]
        a20, a21 = R[n, 2, 0], R[n, 2, 1]
        d0, d1, d2 = t[n, 0], t[n, 1], t[n, 2]
        z = a20 * x0 + a21 * x1 + R[n, 2, 2] + x2 * d2
        inverse = 1.0 / max(z, _NEAREST)
        u = (a00 * x0 + a01 * x1 + R[n, 0, 2] + x2 * d0) * inverse
        v = (a10 * x0 + a11 * x1 + R[n, 1, 2] + x2 * d1) * inverse
        r, s = normalized[n, 0] - u, normalized[n, 1] - v
        u0, v0 = (a00 - u * a20) * inverse, (a10 - v * a20) * inverse
        u1, v1 = (a01 - u * a21) * inverse, (a11 - v * a21) * inverse
        u2, v2 = (d0 - u * d2) * inverse, (d1 - v * d2) * inverse
        if len(weights):
            a, b = weights[n, 0, 0], weights[n, 0, 1]
            c, d = weights[n, 1, 0], weights[n, 1, 1]
            r, s = a * r + b * s, c * r + d * s
            u0, v0 = a * u0 + b * v0, c * u0 + d * v0
            u1, v1 = a * u1 + b * v1, c * u1 + d * v1
            u2, v2 = a * u2 + b * v2, c * u2 + d * v2
        error += r * r + s * s
        b0 += u0 * r + v0 * s
        b1 += u1 * r + v1 * s
        b2 += u2 * r + v2 * s
        l00 += u0 * u0 + v0 * v0
        l10 += u1 * u0 + v1 * v0
        l11 += u1 * u1 + v1 * v1
        l20 += u2 * u0 + v2 * v0
        l21 += u2 * u1 + v2 * v1
        l22 += u2 * u2 + v2 * v2
    rhs[0], rhs[1], rhs[2] = b0, b1, b2
    lhs[0, 0], lhs[1, 1], lhs[2, 2] = l00, l11, l22
    lhs[0, 1] = lhs[1, 0] = l10
    lhs[0, 2] = lhs[2, 0] = l20
    lhs[1, 2] = lhs[2, 1] = l21
    return error


@compiled()
def _start(
    R: FloatArray, p: FloatArray, seen: FloatArray, point: FloatArray, x: FloatArray
) -> None:
    """(α, β, ρ) of a point in its anchor, where that saw it at `seen` (2,)."""
    local = np.empty(3)
    for i in range(3):
        local[i] = (
            R[0, i] * (point[0] - p[0]) + R[1, i] * (point[1] - p[1]) + R[2, i] * (point[2] - p[2])
        )
    z = local[2] if abs(local[2]) > 1e-3 else 1e-3
    if z < 0.0:  # behind the camera: a distant point and noise
        z = 1e3
    x[0], x[1], x[2] = local[0] / z, local[1] / z, 1.0 / z
    if local[2] <= 1e-3:
        x[0], x[1] = seen[0], seen[1]


@compiled()
def _refine(
    R: FloatArray,
    t: FloatArray,
    normalized: FloatArray,
    weights: FloatArray,
    starts: IntArray,
    x: FloatArray,
    lhs: FloatArray,
) -> None:
    """Move x (J, 3) by damped steps; JᵀJ (J, 3, 3) there is filled."""
    count = len(x)
    rhs, error = np.empty((count, 3)), np.empty(count)
    damping = np.empty(count)
    damped, step, trial = np.empty((3, 3)), np.empty(3), np.empty(3)
    trial_lhs, trial_rhs = np.empty((3, 3)), np.empty(3)
    for j in range(count):
        first, last = starts[j], starts[j + 1]
        damping[j] = 1e-3
        error[j] = _normal_equations(R, t, normalized, weights, first, last, x[j], lhs[j], rhs[j])
    for _ in range(STEPS):
        converged = True
        for j in range(count):
            for i in range(3):
                for k in range(3):
                    damped[i, k] = lhs[j, i, k]
                damped[i, i] += lhs[j, i, i] * damping[j] + _REGULARISATION
            _solve(damped, rhs[j], step)
            for i in range(3):
                trial[i] = x[j, i] + step[i]
                if not abs(step[i]) < _CONVERGED:
                    converged = False
            trial[2] = max(trial[2], 1e-6)
            first, last = starts[j], starts[j + 1]
            trial_error = _normal_equations(
                R, t, normalized, weights, first, last, trial, trial_lhs, trial_rhs
            )
            if trial_error < error[j]:
                error[j] = trial_error
                for i in range(3):
                    x[j, i], rhs[j, i] = trial[i], trial_rhs[i]
                    for k in range(3):
                        lhs[j, i, k] = trial_lhs[i, k]
                damping[j] *= 0.1
            else:
                damping[j] *= 10.0
        if converged:
            break


@compiled(
    "void(f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], i8[::1],"
    " f8[:, ::1], f8[::1], f8[::1])"
)
def triangulate_rays(
    world_R_camera: FloatArray,
    world_p_camera: FloatArray,
    normalized: FloatArray,
    weights: FloatArray,
    starts: IntArray,
    points: FloatArray,
    depth_error: FloatArray,
    parallax: FloatArray,
) -> None:
    """Triangulate J features from N observations, those of one feature after the other.

    Args:
        world_R_camera: (N, 3, 3) of the observing cameras.
        world_p_camera: (N, 3) of the same.
        normalized: (N, 2) where they saw the feature.
        weights: (N, 2, 2) of errors on the plane z = 1; (0, 2, 2) where all count the same.
        starts: (J + 1,) first observation of each feature, and N.
        points: (J, 3) in the world, filled.
        depth_error: (J,), filled: relative standard deviation of the inverse depth, for known poses
            and a standard deviation of the errors of 1.
        parallax: (J,), filled: largest angle in rad between the first ray and any other, from the
            point to the cameras.
    """
    N = len(normalized)
    R, t = np.empty((N, 3, 3)), np.empty((N, 3))
    x, lhs = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for j in range(len(points)):
        home = starts[j]
        for n in range(home, starts[j + 1]):
            for i in range(3):
                moved = 0.0
                for k in range(3):
                    away = world_p_camera[home, k] - world_p_camera[n, k]
                    moved += world_R_camera[n, k, i] * away
                    turned = 0.0
                    for m in range(3):
                        turned += world_R_camera[n, m, i] * world_R_camera[home, m, k]
                    R[n, i, k] = turned
                t[n, i] = moved
        _nearest_to_rays(world_R_camera, world_p_camera, normalized, home, starts[j + 1], points[j])
        _start(world_R_camera[home], world_p_camera[home], normalized[home], points[j], x[j])
    _refine(R, t, normalized, weights, starts, x, lhs)
    known, unit, toward = np.empty(3), np.empty(3), np.empty((2, 3))
    unit[0], unit[1], unit[2] = 0.0, 0.0, 1.0
    for j in range(len(points)):
        home = starts[j]
        x0, x1, x2 = x[j, 0], x[j, 1], x[j, 2]
        for i in range(3):
            along = world_R_camera[home, i, 0] * x0 + world_R_camera[home, i, 1] * x1
            along += world_R_camera[home, i, 2]
            points[j, i] = world_p_camera[home, i] + along / x2
            lhs[j, i, i] += _REGULARISATION
        _solve(lhs[j], unit, known)
        depth_error[j] = math.sqrt(known[2]) / x2
        smallest = 1.0
        for n in range(home, starts[j + 1]):
            row = 0 if n == home else 1
            length = 0.0
            for i in range(3):
                toward[row, i] = points[j, i] - world_p_camera[n, i]
                length += toward[row, i] ** 2
            cosine = 0.0
            for i in range(3):
                toward[row, i] /= math.sqrt(length) + 1e-12
                cosine += toward[row, i] * toward[0, i]
            smallest = min(smallest, cosine)
        parallax[j] = math.acos(max(smallest, -1.0))


def triangulate_rays_numpy(
    world_R_camera: FloatArray,
    world_p_camera: FloatArray,
    normalized: FloatArray,
    weights: FloatArray,
    starts: IntArray,
    points: FloatArray,
    depth_error: FloatArray,
    parallax: FloatArray,
) -> None:
    """`triangulate_rays` in NumPy."""
    anchor, feature = starts[:-1], np.repeat(np.arange(len(points)), np.diff(starts))
    home = anchor[feature]
    camera_R_world = world_R_camera.transpose(0, 2, 1)
    R = camera_R_world @ world_R_camera[home]
    offset = world_p_camera - world_p_camera[home]
    t = -np.einsum("nij,nj->ni", camera_R_world, offset)
    bearings = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    b = np.einsum("nij,nj->ni", world_R_camera, bearings)
    A = np.eye(3) - b[:, :, None] * b[:, None, :]
    lhs = np.add.reduceat(A, anchor) + _REGULARISATION * np.eye(3)
    rhs = np.add.reduceat(np.einsum("nij,nj->ni", A, offset), anchor)
    linear = np.linalg.solve(lhs, rhs[:, :, None])[:, :, 0]
    local = np.einsum("jik,ji->jk", world_R_camera[anchor], linear)
    z = np.where(np.abs(local[:, 2]) > 1e-3, local[:, 2], 1e-3)
    z = np.where(z < 0, 1e3, z)
    x = np.stack([local[:, 0] / z, local[:, 1] / z, 1.0 / z], axis=1)
    behind: BoolArray = local[:, 2] <= 1e-3
    x[behind, :2] = normalized[anchor][behind]
    x, lhs = _refine_numpy(R, t, normalized, weights, anchor, feature, x)
    local = np.concatenate([x[:, :2], np.ones((len(x), 1))], axis=1) / x[:, 2:]
    points[:] = world_p_camera[anchor] + np.einsum("jik,jk->ji", world_R_camera[anchor], local)
    variance = np.linalg.inv(lhs + _REGULARISATION * np.eye(3))[:, 2, 2]
    depth_error[:] = np.sqrt(variance) / x[:, 2]
    toward = points[feature] - world_p_camera
    toward /= np.linalg.norm(toward, axis=1, keepdims=True) + 1e-12
    cosine = np.sum(toward * toward[home], axis=1)
    parallax[:] = np.arccos(np.clip(np.minimum.reduceat(cosine, anchor), -1.0, 1.0))


def _refine_numpy(
    R: FloatArray,
    t: FloatArray,
    normalized: FloatArray,
    weights: FloatArray,
    anchor: IntArray,
    feature: IntArray,
    x: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The refined x (J, 3), and JᵀJ (J, 3, 3) there."""

    def normal_equations(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        xi = x[feature]
        direction = np.concatenate([xi[:, :2], np.ones((len(xi), 1))], axis=1)
        p = np.einsum("nij,nj->ni", R, direction) + xi[:, 2:] * t
        z = np.maximum(p[:, 2:], _NEAREST)
        m = p[:, :2] / z
        r = normalized - m
        by_x = np.concatenate([R[:, :, :2], t[:, :, None]], axis=2)
        J = (by_x[:, :2, :] - m[:, :, None] * by_x[:, 2:, :]) / z[:, :, None]
        if len(weights):
            J, r = weights @ J, np.einsum("nij,nj->ni", weights, r)
        lhs = np.add.reduceat(J.transpose(0, 2, 1) @ J, anchor)
        rhs = np.add.reduceat(np.einsum("nij,ni->nj", J, r), anchor)
        return np.add.reduceat(np.sum(r * r, axis=1), anchor), lhs, rhs

    damping = np.full(len(x), 1e-3)
    error, lhs, rhs = normal_equations(x)
    for _ in range(STEPS):
        diagonal = np.einsum("jii->ji", lhs) * damping[:, None] + _REGULARISATION
        step = np.linalg.solve(lhs + diagonal[:, :, None] * np.eye(3), rhs[:, :, None])[:, :, 0]
        trial = x + step
        trial[:, 2] = np.maximum(trial[:, 2], 1e-6)
        trial_error, trial_lhs, trial_rhs = normal_equations(trial)
        better = trial_error < error
        x = np.where(better[:, None], trial, x)
        lhs = np.where(better[:, None, None], trial_lhs, lhs)
        rhs = np.where(better[:, None], trial_rhs, rhs)
        error = np.where(better, trial_error, error)
        damping = np.where(better, damping * 0.1, damping * 10.0)
        if np.max(np.abs(step), initial=0.0) < _CONVERGED:
            break
    return x, lhs
