# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Module 1 of bundle adjustment, cost construction: all cameras, all points, no pose costs.

The cost is half the sum of the squared reprojection errors, or their robust loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.bundle_adjustment.bal_policy import BalCostPolicy, Intrinsics
from slam_graph.bundle_adjustment.bal_problem import (
    CAMERA_DIM,
    POSE_DIM,
    BalEstimates,
    BalLinearization,
    BalPart,
    BalProblem,
    linearize,
    project,
)


@dataclass(frozen=True, slots=True, eq=False)
class BalCost:
    """A cost over all cameras and points of a part.

    Attributes:
        part: cameras, points and observations.
        policy: which intrinsics are variables, and the loss.
        variables: (9 C, n) entries 0 or 1: the components of the camera tangents that each of the n
            variables stands for.
    """

    part: BalPart
    policy: BalCostPolicy
    variables: csr_array

    def __call__(self, estimates: BalEstimates) -> float:
        """The cost; infinite if a point has zero depth."""
        errors = reprojection_errors(self.part.problem, estimates)
        with np.errstate(all="ignore"):
            cost = float(np.sum(self.policy.loss.value(errors)))
        return cost if np.isfinite(cost) else np.inf

    def linearized(self, estimates: BalEstimates) -> BalLinearization:
        """Residuals and Jacobians, scaled by the root of the robust weights (IRLS)."""
        problem = self.part.problem
        linear = linearize(estimates, problem.camera, problem.point, problem.pixels)
        if self.policy.robust == "none":
            return linear
        weights = self.policy.loss.weights(np.linalg.norm(linear.r, axis=1))
        root = np.sqrt(weights)[:, None]
        return BalLinearization(
            linear.by_camera * root[:, :, None], linear.by_point * root[:, :, None], linear.r * root
        )


def construct(part: BalPart, policy: BalCostPolicy) -> BalCost:
    """The cost of a part."""
    return BalCost(part, policy, _variables(part.problem, policy.intrinsics))


def initial_estimates(part: BalPart, policy: BalCostPolicy) -> BalEstimates:
    """Initial estimates: those of the file; shared intrinsics begin at their median."""
    start = part.problem.estimates
    if policy.intrinsics != "shared":
        return start
    median = np.median(start.intrinsics, axis=0)
    return replace(start, intrinsics=np.tile(median, (part.problem.cameras, 1)))


def reprojection_errors(problem: BalProblem, estimates: BalEstimates) -> FloatArray:
    """(N,) reprojection errors in pixels; not finite for points of zero depth."""
    pixels, _ = project(estimates, problem.camera, problem.point)
    with np.errstate(all="ignore"):
        return np.asarray(np.linalg.norm(pixels - problem.pixels, axis=1), dtype=np.float64)


def retract(estimates: BalEstimates, by_camera: FloatArray, by_point: FloatArray) -> BalEstimates:
    """Estimates moved by an increment of their tangent.

    Args:
        estimates: before the step.
        by_camera: (C, 9) increments δθ, δt, f, k1, k2.
        by_point: (P, 3).
    """
    return BalEstimates(
        Rotation.from_rotvec(by_camera[:, :3]).as_matrix() @ estimates.rotations,
        estimates.translations + by_camera[:, 3:POSE_DIM],
        estimates.intrinsics + by_camera[:, POSE_DIM:],
        estimates.points + by_point,
    )


def _variables(problem: BalProblem, intrinsics: Intrinsics) -> csr_array:
    """(9 C, n): all poses, and the intrinsics that are estimated."""
    cameras = problem.cameras
    tangents = np.arange(CAMERA_DIM * cameras).reshape(cameras, CAMERA_DIM)
    columns = tangents
    if intrinsics != "per_camera":
        columns = np.arange(POSE_DIM * cameras).reshape(cameras, POSE_DIM)
    if intrinsics == "shared":
        common = np.tile(POSE_DIM * cameras + np.arange(3), (cameras, 1))
        columns = np.hstack([columns, common])
    rows = tangents[:, : columns.shape[1]]
    shape = (tangents.size, int(columns.max()) + 1)
    return csr_array((np.ones(rows.size), (rows.ravel(), columns.ravel())), shape=shape)
