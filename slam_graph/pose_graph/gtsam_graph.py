# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph in GTSAM: factors, values, errors. The key of a pose is its row."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.pose_graph.graph import PoseGraph, Poses

_LOSSES: dict[str, Callable[[float], Any]] = {
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
    "dcs": gtsam.noiseModel.mEstimator.DCS.Create,
    "truncated": gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create,
}

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""GTSAM's order of a 3D tangent in terms of the order of files. In 2D they are the same."""


def edge_factors(
    graph: PoseGraph, loss: str = "none", width: float = 1.0
) -> list[gtsam.NonlinearFactor]:
    """Between factors of all edges, with a robust loss on the whitened residual.

    The width of `dcs` is the Φ of Agarwal et al. 2013, which is compared with the squared residual.
    """
    between: Any = gtsam.BetweenFactorPose2 if graph.dimension == 2 else gtsam.BetweenFactorPose3
    information = graph.angle_information
    if graph.dimension == 3:
        information = information[:, ROTATION_FIRST[:, None], ROTATION_FIRST]
    estimator = None if loss == "none" else robust_estimator(loss, width)
    gaussian, robust = gtsam.noiseModel.Gaussian.Information, gtsam.noiseModel.Robust.Create
    noises: list[Any] = []
    for matrix, like_last in zip(information, _repeated(information).tolist(), strict=True):
        if like_last:
            noises.append(noises[-1])
            continue
        noise = gaussian(matrix, False)
        noises.append(noise if estimator is None else robust(estimator, noise))
    return list(map(between, *graph.edges.T.tolist(), gtsam_poses(graph.measured), noises))


def _repeated(information: FloatArray) -> BoolArray:
    """(M,) whether a matrix equals the one before it, so that their edges can share a noise."""
    repeated = np.zeros(len(information), bool)
    repeated[1:] = (information[1:] == information[:-1]).all(axis=(1, 2))
    return repeated


def robust_estimator(loss: str, width: float) -> Any:
    """The M-estimator of a robust loss."""
    return _LOSSES[loss](width)


def anchor_factors(
    graph: PoseGraph, held: bool = False, anchor: int | None = None
) -> list[gtsam.NonlinearFactor]:
    """Priors on the first pose of each connected component, which fix the gauge.

    They are zero at a minimum.

    Args:
        graph: the pose graph.
        held: as hard constraints, so that covariances are relative to the first pose.
        anchor: row of the pose that is held in place of the first ones, if the graph has estimates.
    """
    prior, k = (gtsam.PriorFactorPose2, 3) if graph.dimension == 2 else (gtsam.PriorFactorPose3, 6)
    noise = (
        gtsam.noiseModel.Constrained.All(k)
        if held
        else gtsam.noiseModel.Isotropic.Precision(k, _typical_information(graph))
    )
    rows, at = graph.anchors, graph.anchor_poses()
    if anchor is not None:
        if graph.estimates is None:
            raise ValueError("the pose of an anchor is known by estimates only")
        rows = np.array([anchor], np.int64)
        at = graph.estimates.select(rows)
    poses = gtsam_poses(at)
    return [prior(key, pose, noise) for key, pose in zip(rows.tolist(), poses, strict=True)]


def _typical_information(graph: PoseGraph) -> float:
    """The median of the diagonals of the information: a well conditioned gauge prior."""
    return float(np.median(np.diagonal(graph.angle_information, axis1=1, axis2=2)))


def factor_graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)  # a third of the time of `push_back`, which tries more types
    return graph


def values_of(poses: Poses) -> gtsam.Values:
    """Poses as GTSAM's values."""
    values = gtsam.Values()
    for key, pose in enumerate(gtsam_poses(poses)):
        values.insert(key, pose)
    return values


def poses_of(values: gtsam.Values, dimension: int) -> Poses:
    """Values of GTSAM with the keys 0 to N - 1 as poses."""
    if dimension == 2:
        x, y, theta = np.asarray(gtsam.utilities.extractPose2(values)).T
        cos, sin = np.cos(theta), np.sin(theta)
        rotations = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
        return Poses(rotations, np.column_stack([x, y]))
    rows = np.asarray(gtsam.utilities.extractPose3(values))
    return Poses(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])


def edge_chi2(factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values) -> FloatArray:
    """(M,) squared whitened residuals of factors without a robust loss."""
    return np.array([2.0 * factor.error(values) for factor in factors])


def gtsam_poses(poses: Poses) -> list[Any]:
    """Poses as a list of `Pose2` or `Pose3`."""
    R, t = poses.rotations, poses.translations
    if poses.dimension == 2:
        angles = np.arctan2(R[:, 1, 0], R[:, 0, 0])
        return list(map(gtsam.Pose2, *t.T.tolist(), angles.tolist()))
    return list(map(gtsam.Pose3, map(gtsam.Rot3, R), t))
