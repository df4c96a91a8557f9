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
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.bundle_adjustment.bal_cost import BalCost
from slam_graph.bundle_adjustment.bal_problem import (
    CAMERA_DIM,
    BalEstimates,
    BalPart,
    BalProblem,
)
from slam_graph.errors import EstimationError

GAUGE_DIM = 7
"""Unobservable directions: translation, rotation and scale of the world."""

_RowArray = NDArray[np.int32]

_MAX_CAMERAS = 1_800
"""The dense reduced system of more cameras needs over 2 GB, and 6 GB to be solved."""
_MAX_PAIRS = 100_000_000
"""The table of more pairs of observations needs over 1 GB."""
_BLOCK = 8_000
"""Observations whose B are computed at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class _CommonPoints:
    """Pairs of observations of the same point: one in a camera, one in a later camera.

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
        pairs: the common points of each camera with the later ones.
    """

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
    pairs = int(np.sum(views * (views - 1) // 2))
    if problem.cameras > _MAX_CAMERAS or pairs > _MAX_PAIRS:
        raise EstimationError(
            f"{problem.name}: too large: {problem.cameras} cameras and {pairs} pairs of "
            f"observations of the same point; the most are {_MAX_CAMERAS} and {_MAX_PAIRS}"
        )
    return Structure(list(_common_points(cost.part, views)))


def _common_points(part: BalPart, views: NDArray[np.int64]) -> Iterator[_CommonPoints]:
    """The common points of each camera."""
    problem, starts = part.problem, part.camera_starts
    by_point = np.argsort(problem.point, kind="stable").astype(np.int32)
    place = np.empty_like(by_point)
    place[by_point] = np.arange(len(by_point))
    ends = np.cumsum(views)[problem.point]
    cameras = problem.camera.astype(np.int16)  # sorted much faster than longer integers
    for camera in range(problem.cameras):
        rows = np.arange(starts[camera], starts[camera + 1], dtype=np.int32)
        counts = ends[rows] - place[rows] - 1
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        first = np.repeat(rows, counts)
        second = by_point[place[first] + 1 + within]
        order = np.argsort(cameras[second], kind="stable")
        common = np.bincount(cameras[second])
        others = np.flatnonzero(common)
        bounds = np.append(0, np.cumsum(common[others]))
        yield _CommonPoints(
            first[order], second[order], others.astype(np.int32), bounds.astype(np.int32)
        )


def normal_equations(cost: BalCost, estimates: BalEstimates) -> NormalEquations:
    """Linearise a cost."""
    linear, part = cost.linearized(estimates), cost.part
    by_camera, by_point = linear.by_camera, linear.by_point
    rows = np.empty((*linear.r.shape, CAMERA_DIM + 1))
    rows[:, :, :-1], rows[:, :, -1] = by_camera, linear.r
    squares = np.empty((part.problem.cameras, CAMERA_DIM + 1, CAMERA_DIM + 1))
    for camera, (a, b) in enumerate(zip(part.camera_starts, part.camera_starts[1:], strict=False)):
        block = rows[a:b].reshape(-1, CAMERA_DIM + 1)
        squares[camera] = block.T @ block
    V, g_p = _squares_of_points(part.problem, by_point, linear.r)
    gauge = gauge_directions(estimates, part.groups)
    return NormalEquations(
        by_camera, by_point, squares[:, :-1, :-1], squares[:, :-1, -1], V, g_p, gauge
    )


def _squares_of_points(
    problem: BalProblem, by_point: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Information (P, 3, 3) and gradient (P, 3) of the points, entry by entry."""
    columns = [*by_point.T, r.T]
    sums = np.empty((problem.points, 3, 4))
    for i in range(3):
        for j in range(i, 4):
            products = columns[i][0] * columns[j][0] + columns[i][1] * columns[j][1]
            sums[:, i, j] = np.bincount(problem.point, products, problem.points)
            if j < 3:
                sums[:, j, i] = sums[:, i, j]
    return sums[:, :, :3], sums[:, :, 3]


def damped_step(
    cost: BalCost, fixed: Structure, equations: NormalEquations, damping: float
) -> BalStep:
    """The step that minimises the linearised cost, damped relative to its diagonal (Marquardt).

    Raises:
        LinAlgError: if the equations are not positive definite.
    """
    problem, E = cost.part.problem, cost.variables
    D_p = _positive(np.diagonal(equations.V, axis1=1, axis2=2))
    inverse_root = _inverse_root(equations.V + damping * D_p[:, :, None] * np.eye(3))
    B = _eliminated(inverse_root, problem.point, equations)
    b_p = np.einsum("pij,pj->pi", inverse_root, equations.g_p)

    S, g = _reduced_system(cost, fixed, equations, B, b_p[problem.point])
    if E.shape[1] < len(S):
        S = E.T @ (np.triu(S) + np.triu(S, 1).T) @ E
    D_c = _positive(E.T @ np.diagonal(equations.U, axis1=1, axis2=2).ravel())
    δ, along_gauge = _solved(S, E.T @ g, D_c, E.T @ equations.gauge, damping)

    by_camera = (E @ δ).reshape(-1, CAMERA_DIM)
    pushed = b_p + _pushed(cost.part, B, by_camera)
    by_point = -np.einsum("pji,pj->pi", inverse_root, pushed)
    slope = np.sum(equations.g_c * by_camera) + np.sum(equations.g_p * by_point)
    held = damping * (np.sum(D_c * δ**2) + np.sum(D_p * by_point**2)) + along_gauge
    return BalStep(by_camera, by_point, 0.5 * float(held - slope))


def _eliminated(
    inverse_root: FloatArray, point: IntArray, equations: NormalEquations
) -> FloatArray:
    """B (N, 3, 9) of each observation, with L⁻¹ (P, 3, 3) of each point."""
    roots = np.ascontiguousarray(inverse_root.transpose(1, 2, 0))
    J_p, J_c = equations.by_point.transpose(1, 2, 0), equations.by_camera.transpose(1, 2, 0)
    B = np.empty((len(point), 3, CAMERA_DIM))
    for first in range(0, len(point), _BLOCK):  # blocks stay in the cache of the processor
        some = slice(first, first + _BLOCK)
        root, columns = roots.take(point[some], axis=2), np.empty((3, CAMERA_DIM, len(B[some])))
        for k, column in enumerate(columns):
            K = root[k, 0] * J_p[:, 0, some]
            for i in range(1, k + 1):
                K += root[k, i] * J_p[:, i, some]
            np.multiply(K[0], J_c[0, :, some], out=column)
            column += K[1] * J_c[1, :, some]
        B[some] = columns.transpose(2, 0, 1)
    return B


def _inverse_root(V: FloatArray) -> FloatArray:
    """L⁻¹ (P, 3, 3) of V = L Lᵀ, entry by entry.

    Raises:
        LinAlgError: if one is not positive definite.
    """
    pivots = np.empty((3, len(V)))
    pivots[0] = V[:, 0, 0]
    l10, l20 = V[:, 1, 0] / np.sqrt(pivots[0]), V[:, 2, 0] / np.sqrt(pivots[0])
    pivots[1] = V[:, 1, 1] - l10**2
    l21 = (V[:, 2, 1] - l20 * l10) / np.sqrt(pivots[1])
    pivots[2] = V[:, 2, 2] - l20**2 - l21**2
    if not (pivots > 0.0).all():
        raise np.linalg.LinAlgError("the information of a point is not positive definite")
    a, b, c = 1.0 / np.sqrt(pivots)
    inverse = np.zeros(V.shape)
    inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 2, 2] = a, b, c
    inverse[:, 1, 0] = -a * b * l10
    inverse[:, 2, 1] = -b * c * l21
    inverse[:, 2, 0] = c * (a * b * l10 * l21 - a * l20)
    return inverse


def _reduced_system(
    cost: BalCost, fixed: Structure, equations: NormalEquations, B: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The upper triangle of the reduced camera system S (9 C, 9 C), and its gradient (9 C,).

    Args:
        cost: the cost.
        fixed: its sparsity.
        equations: its linearisation.
        B: (N, 3, 9) of each observation.
        b: (N, 3) L⁻¹ g_p of the point of each observation.
    """
    part, C = cost.part, cost.part.problem.cameras
    blocks, g = np.zeros((C, C, CAMERA_DIM, CAMERA_DIM)), equations.g_c.copy()
    for i, pairs in enumerate(fixed.pairs):
        own = slice(part.camera_starts[i], part.camera_starts[i + 1])
        of_camera = B[own].reshape(-1, CAMERA_DIM)
        blocks[i, i] = of_camera.T @ of_camera - equations.U[i]
        g[i] -= of_camera.T @ b[own].ravel()
        left = B[pairs.first].reshape(-1, CAMERA_DIM)
        right = B[pairs.second].reshape(-1, CAMERA_DIM)
        bounds, row = (3 * pairs.starts).tolist(), blocks[i]
        for j, first, last in zip(pairs.others.tolist(), bounds, bounds[1:], strict=False):
            np.dot(left[first:last].T, right[first:last], out=row[j])
    S = np.empty((C, CAMERA_DIM, C, CAMERA_DIM))
    np.negative(blocks.transpose(0, 2, 1, 3), out=S)
    return S.reshape(CAMERA_DIM * C, CAMERA_DIM * C), g.ravel()


def _pushed(part: BalPart, B: FloatArray, by_camera: FloatArray) -> FloatArray:
    """(P, 3) sums of B δ over the observations of each point, with the steps δ (C, 9)."""
    moved = np.empty(B.shape[:2])
    for camera, (first, last) in enumerate(pairwise(part.camera_starts.tolist())):
        of_camera = B[first:last].reshape(-1, CAMERA_DIM)
        moved[first:last] = (of_camera @ by_camera[camera]).reshape(-1, 3)
    point, points = part.problem.point, part.problem.points
    return np.stack([np.bincount(point, column, points) for column in moved.T], axis=1)


def _solved(
    S: FloatArray, g: FloatArray, D: FloatArray, gauge: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """Increment of the camera variables, and the cost of its part along the gauge.

    Variables are scaled to unit information. The gauge directions, made orthonormal, get an
    information of 1, where they had none. Of `S`, which is overwritten, the upper triangle is used.
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
