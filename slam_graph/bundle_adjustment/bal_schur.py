# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Damped normal equations of bundle adjustment, solved by eliminating the points.

With J_c and J_p the Jacobians of an observation by its camera and its point, U = Σ J_cᵀ J_c of each
camera, V = Σ J_pᵀ J_p = L Lᵀ of each point (damped) and B = L⁻¹ J_pᵀ J_c, the reduced camera system
is the Schur complement

    S = U - Σ Bᵀ B over all pairs of observations of a point,

a block for every two cameras that observe a point in common, computed as one matrix product over
all such points.

Gauge: a similarity X ← s Q X + b of the world changes no pixel, so that seven degrees of freedom
are unobservable. Steps are taken without any part along these directions (inner constraints;
Triggs, McLauchlan, Hartley & Fitzgibbon 2000), and in the end the gauge of the start is restored:
the first camera has its pose, and the median distance of the points from it is what it was. Groups
of cameras without a common point have seven directions each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.bundle_adjustment.bal_cost import BalCost
from slam_graph.bundle_adjustment.bal_problem import CAMERA_DIM, BalEstimates, BalPart
from slam_graph.errors import EstimationError

GAUGE_DIM = 7
"""Unobservable directions: translation, rotation and scale of the world."""

_RowArray = NDArray[np.int32]

_MAX_CAMERAS = 1_800
"""The dense reduced system of more cameras needs over 2 GB, and 6 GB to be solved."""
_MAX_PAIRS = 100_000_000
"""The table of more pairs of observations needs over 1 GB."""


@dataclass(frozen=True, slots=True, eq=False)
class _CommonPoints:
    """Pairs of observations of the same point: one in a camera, one in it or a later camera.

    Attributes:
        first: (K,) observations in the camera.
        second: (K,) observations of the same points, sorted by camera.
        others: (M,) the cameras of the second observations.
        starts: (M + 1,) first pair of each of these cameras, and K.
    """

    first: _RowArray
    second: _RowArray
    others: _RowArray
    starts: _RowArray


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """The sparsity of the equations, which is the same at every step.

    Attributes:
        sum_by_point: (P, N) sums over the observations of each point.
        pairs: the common points of each camera with itself and the later ones.
    """

    sum_by_point: csr_array
    pairs: list[_CommonPoints]


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """A linearised cost.

    Attributes:
        by_camera: (N, 2, 9) Jacobians.
        by_point: (N, 2, 3).
        U: (C, 9, 9) information of the cameras.
        g_c: (C, 9) gradient.
        V: (P, 3, 3) information of the points.
        g_p: (P, 3) gradient.
        gauge: (9 C, 7 G) unobservable directions.
    """

    by_camera: FloatArray
    by_point: FloatArray
    U: FloatArray
    g_c: FloatArray
    V: FloatArray
    g_p: FloatArray
    gauge: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BalStep:
    """A solution of the damped equations.

    Attributes:
        by_camera: (C, 9) increments.
        by_point: (P, 3).
        predicted: decrease of the linearised cost.
    """

    by_camera: FloatArray
    by_point: FloatArray
    predicted: float


def structure(cost: BalCost) -> Structure:
    """Find the common points of all pairs of cameras.

    Raises:
        EstimationError: if the problem is too large for a dense reduced system.
    """
    problem = cost.part.problem
    views = np.bincount(problem.point)
    pairs = int(np.sum(views * (views + 1) // 2))
    if problem.cameras > _MAX_CAMERAS or pairs > _MAX_PAIRS:
        raise EstimationError(
            f"{problem.name}: too large: {problem.cameras} cameras and {pairs} pairs of "
            f"observations of the same point; the most are {_MAX_CAMERAS} and {_MAX_PAIRS}"
        )
    N = len(problem.point)
    where = (problem.point, np.arange(N))
    summed = csr_array((np.ones(N), where), shape=(problem.points, N))
    return Structure(summed, list(_common_points(cost.part, views)))


def _common_points(part: BalPart, views: NDArray[np.int64]) -> Iterator[_CommonPoints]:
    """The common points of each camera."""
    problem, starts = part.problem, part.camera_starts
    by_point = np.argsort(problem.point, kind="stable").astype(np.int32)
    place = np.empty_like(by_point)
    place[by_point] = np.arange(len(by_point))
    ends = np.cumsum(views)[problem.point]
    for camera in range(problem.cameras):
        rows = np.arange(starts[camera], starts[camera + 1], dtype=np.int32)
        counts = ends[rows] - place[rows]
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        first = np.repeat(rows, counts)
        second = by_point[place[first] + within]
        order = np.argsort(problem.camera[second], kind="stable")
        first, second = first[order], second[order]
        others, begin = np.unique(problem.camera[second], return_index=True)
        bounds = np.append(begin, len(second)).astype(np.int32)
        yield _CommonPoints(first, second, others.astype(np.int32), bounds)


def normal_equations(cost: BalCost, estimates: BalEstimates, fixed: Structure) -> NormalEquations:
    """Linearise a cost."""
    linear, part = cost.linearized(estimates), cost.part
    by_camera, by_point = linear.by_camera, linear.by_point
    rows = np.concatenate([by_camera, linear.r[:, :, None]], axis=2)
    squares = np.empty((part.problem.cameras, CAMERA_DIM + 1, CAMERA_DIM + 1))
    for camera, (a, b) in enumerate(zip(part.camera_starts, part.camera_starts[1:], strict=False)):
        block = rows[a:b].reshape(-1, CAMERA_DIM + 1)
        squares[camera] = block.T @ block
    gauge = gauge_directions(estimates, part.groups)
    rows = np.concatenate([by_point, linear.r[:, :, None]], axis=2)
    products = np.einsum("nai,naj->nij", by_point, rows).reshape(len(rows), -1)
    of_points = (fixed.sum_by_point @ products).reshape(-1, 3, 4)
    return NormalEquations(
        by_camera,
        by_point,
        squares[:, :-1, :-1],
        squares[:, :-1, -1],
        of_points[:, :, :3],
        of_points[:, :, 3],
        gauge,
    )


def damped_step(
    cost: BalCost, fixed: Structure, equations: NormalEquations, damping: float
) -> BalStep:
    """The step that minimises the linearised cost, damped relative to its diagonal (Marquardt).

    Raises:
        LinAlgError: if the equations are not positive definite.
    """
    problem, E = cost.part.problem, cost.variables
    D_p = _positive(np.diagonal(equations.V, axis1=1, axis2=2))
    V = equations.V + damping * D_p[:, :, None] * np.eye(3)
    inverse_root = np.linalg.inv(np.linalg.cholesky(V))
    K = inverse_root[problem.point] @ equations.by_point.transpose(0, 2, 1)
    B = K @ equations.by_camera
    b_p = np.einsum("pij,pj->pi", inverse_root, equations.g_p)

    S = _reduced_system(cost, fixed, equations, B)
    if E.shape[1] < len(S):
        S = E.T @ S @ E
    g = (
        E.T
        @ (
            equations.g_c - _per_camera(cost, np.einsum("nki,nk->ni", B, b_p[problem.point]))
        ).ravel()
    )
    D_c = _positive(E.T @ np.diagonal(equations.U, axis1=1, axis2=2).ravel())
    δ, along_gauge = _solved(S, g, D_c, E.T @ equations.gauge, damping)

    by_camera = (E @ δ).reshape(-1, CAMERA_DIM)
    pushed = fixed.sum_by_point @ np.einsum("nki,ni->nk", B, by_camera[problem.camera])
    by_point = -np.einsum("pji,pj->pi", inverse_root, b_p + pushed)
    slope = np.sum(equations.g_c * by_camera) + np.sum(equations.g_p * by_point)
    held = damping * (np.sum(D_c * δ**2) + np.sum(D_p * by_point**2)) + along_gauge
    return BalStep(by_camera, by_point, 0.5 * float(held - slope))


def _reduced_system(
    cost: BalCost, fixed: Structure, equations: NormalEquations, B: FloatArray
) -> FloatArray:
    """(9 C, 9 C) the reduced camera system S, both triangles."""
    C = cost.part.problem.cameras
    S = np.zeros((C, CAMERA_DIM, C, CAMERA_DIM))
    for i, pairs in enumerate(fixed.pairs):
        left = B[pairs.first].reshape(-1, CAMERA_DIM)
        right = B[pairs.second].reshape(-1, CAMERA_DIM)
        for j, a, b in zip(
            pairs.others.tolist(),
            (3 * pairs.starts[:-1]).tolist(),
            (3 * pairs.starts[1:]).tolist(),
            strict=True,
        ):
            block = left[a:b].T @ right[a:b]
            S[i, :, j] -= block
            if i != j:
                S[j, :, i] -= block.T
        S[i, :, i] += equations.U[i]
    return S.reshape(CAMERA_DIM * C, CAMERA_DIM * C)


def _solved(
    S: FloatArray, g: FloatArray, D: FloatArray, gauge: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """Increment of the camera variables, and the cost of its part along the gauge.

    Variables are scaled to unit information. The gauge directions, made orthonormal, get an
    information of 1, where they had none. `S` is overwritten.
    """
    scale = 1.0 / np.sqrt(D)
    N, _ = np.linalg.qr(gauge / scale[:, None])
    S *= scale[:, None]  # in its place: it may be large
    S *= scale
    S.flat[:: len(S) + 1] += damping
    S += N @ N.T
    factor = cho_factor(S.T, lower=True, overwrite_a=True, check_finite=False)
    scaled = -cho_solve(factor, scale * g, check_finite=False)
    return scale * scaled, float(np.sum((N.T @ scaled) ** 2))


def _per_camera(cost: BalCost, values: FloatArray) -> FloatArray:
    """(C, k) sums over the observations of each camera."""
    return np.add.reduceat(values, cost.part.camera_starts[:-1], axis=0)


def _positive(diagonal: FloatArray) -> FloatArray:
    """A diagonal to scale by: 1 where there is no information."""
    return np.where(diagonal > 0, diagonal, 1.0)


def gauge_directions(estimates: BalEstimates, groups: IntArray) -> FloatArray:
    """(9 C, 7 G) derivatives of the camera tangents by a similarity of each group.

    X ← (1 + σ)(I + [φ]ₓ) X + b gives δθ = -R φ and δt = σ t - R b.
    """
    C, G = len(groups), int(groups.max()) + 1
    R, rows = estimates.rotations, np.arange(C)
    directions = np.zeros((C, CAMERA_DIM, G, GAUGE_DIM))
    directions[rows, 0:3, groups, 0:3] = -R
    directions[rows, 3:6, groups, 3:6] = -R
    directions[rows, 3:6, groups, 6] = estimates.translations
    return directions.reshape(CAMERA_DIM * C, GAUGE_DIM * G)


def restore_gauge(part: BalPart, end: BalEstimates) -> BalEstimates:
    """Estimates moved by a similarity of each group into the gauge of the start."""
    start, problem = part.problem.estimates, part.problem
    group_of_point = np.zeros(problem.points, np.int64)
    group_of_point[problem.point] = part.groups[problem.camera]
    rotations, translations = end.rotations.copy(), end.translations.copy()
    points = end.points.copy()
    for group in range(int(part.groups.max()) + 1):
        cameras = np.flatnonzero(part.groups == group)
        rows, first = np.flatnonzero(group_of_point == group), cameras[0]
        scale = _median_distance(start, first, rows) / _median_distance(end, first, rows)
        R_0, t_0 = start.rotations[first], start.translations[first]
        Q = R_0.T @ end.rotations[first]
        b = R_0.T @ (scale * end.translations[first] - t_0)
        points[rows] = scale * end.points[rows] @ Q.T + b
        rotations[cameras] = end.rotations[cameras] @ Q.T
        translations[cameras] = scale * end.translations[cameras] - rotations[cameras] @ b
    return BalEstimates(rotations, translations, end.intrinsics, points)


def _median_distance(estimates: BalEstimates, camera: int, points: IntArray) -> float:
    """Median distance of some points from a camera."""
    away = estimates.points[points] - estimates.centres()[camera]
    return float(np.median(np.linalg.norm(away, axis=1)))
