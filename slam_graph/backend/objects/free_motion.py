# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Poses that some tracks fit best, each free of all others, near a motion that is known already.

An estimator that begins anew takes all frames of the window one after the other. Poses that obey no
dynamics fit the same tracks at least as well, and are found from poses that are nearly right in a
few Gauss-Newton steps, at a tenth of the cost. So they tell whether it is worth while to begin.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import SummedFeatures, sum_features, whiten
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.objects.ego_motion import pose_arrays
from slam_graph.backend.solve.state import POSE_DIM

_STEPS, _TOLERANCE = 10, 1e-3
"""Most steps; they end when the cost falls by less than this part of it."""
_DAMPING, _RELIEF, _RAISE = 1e-2, 0.1, 100.0
"""Damping at first, and factors on it after a step that lowers the cost, and after another one."""
_FIXED, _LITTLE = 1e8, 1e-3
"""Information on the first pose, which defines the frame of the object, and on all of them, which
keeps the equations regular: per rad² and m²."""


def freely_fitted(
    obs: Observations,
    rig: RigProjection,
    poses: Sequence[gtsam.Pose3],
    points: FloatArray,
    sigma_px: float,
    loss: RobustLoss,
) -> list[gtsam.Pose3]:
    """Poses of the platform relative to the points of some tracks.

    Args:
        obs: of J tracks; the frames are numbers of poses.
        rig: the cameras.
        poses: object_T_body, nearly right.
        points: (J, 3) of the tracks in the frame of the object under these poses.
        sigma_px: standard deviation of the observations.
        loss: on their residuals.

    Returns:
        Those that fit better; the poses that were given where none do, or no track has seen them.
    """
    best = at = Geometry(*pose_arrays(tuple(poses[frame] for frame in obs.frames)), points)
    features: SummedFeatures | None = None
    least, damping = np.inf, _DAMPING
    for _ in range(_STEPS):
        linear = whiten(obs, rig, at, at, sigma_px, loss)
        cost = float(loss.value(linear.errors).sum())
        try:
            if cost < least:
                gain, best, least, damping = least - cost, at, cost, _RELIEF * damping
                if gain < _TOLERANCE * cost:
                    break
                features = sum_features(obs, linear)
            elif features is None:  # it is not finite
                break
            else:
                damping *= _RAISE
            at = _stepped(best, features, damping)
        except np.linalg.LinAlgError:
            break
    result = list(poses)
    for frame, R, p in zip(obs.frames, best.rotations, best.positions, strict=True):
        result[frame] = gtsam.Pose3(gtsam.Rot3(R), p)
    return result


def _stepped(at: Geometry, features: SummedFeatures, damping: float) -> Geometry:
    """Poses and points after a damped Gauss-Newton step; the first pose stays.

    Raises:
        numpy.linalg.LinAlgError: if the equations are singular.
    """
    A, b = features.rows[:, :-1], features.rows[:, -1]
    information = A.T @ A
    diagonal = information.diagonal() * (1.0 + damping) + _LITTLE
    diagonal[:POSE_DIM] += _FIXED
    np.fill_diagonal(information, diagonal)
    delta = np.asarray(np.linalg.solve(information, A.T @ b), dtype=np.float64)
    steps = delta.reshape(-1, POSE_DIM)
    turns = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    positions = at.positions + (at.rotations @ steps[:, 3:, None])[:, :, 0]
    points = at.points + features.point_increments(delta)
    return Geometry(at.rotations @ turns, positions, points)
