# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes as factors: the antenna at a frame is where a fix near it in time says.

A fix between two frames is moved to one of them by how far the antenna came in between, which
images and IMU know to millimetres. The residual is that of GTSAM's `GPSFactorArm`.
"""

from __future__ import annotations

from collections import deque

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import chdtri

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.geometry import Trajectory, interpolate

_GATE = float(np.sqrt(chdtri(3, 0.001)))
_HUBER = float(np.sqrt(chdtri(3, 0.05)))
"""Mahalanobis distances of an innovation beyond which a fix is rejected, and counts less."""
_CAUCHY = 4.0
"""Width of the Cauchy loss (σ): a good fix counts for 0.84, one that is off by 10 σ for 0.14."""
_REMEMBERED, _MOST_REJECTED = 10, 7
"""Where more of the last fixes were rejected, not they are wrong but the estimate is."""
_LONGEST_GAP_S = 1.0
"""Poses farther apart are not interpolated."""


def fix_factor(
    key: int, position: FloatArray, covariance: FloatArray, arm: FloatArray, robust: bool = False
) -> gtsam.NoiseModelFactor:
    """A fix of the antenna at a pose.

    Args:
        key: of the pose.
        position: (3,) of the antenna, m.
        covariance: (3, 3) of it, m².
        arm: (3,) of the antenna in the body, m.
        robust: whether a Cauchy loss lets it count less the farther it is off.
    """
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if robust:
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
        noise = gtsam.noiseModel.Robust.Create(cauchy, noise)
    return gtsam.GPSFactorArm(key, position, arm, noise)


def antenna(pose: gtsam.Pose3, arm: FloatArray) -> FloatArray:
    """Position (3,) of the antenna in the world."""
    return np.asarray(pose.transformFrom(arm))


class FixGate:
    """The χ² gate of fixes, and the loss of those that pass it.

    The innovation decides, under the covariance that the prediction and the fix give it. A fix
    beyond the 95 % sphere counts less (Huber), one beyond the 99.9 % sphere not at all. If most of
    the last fixes were rejected the estimate is wrong, and they pull it back.

    Attributes:
        tested, rejected: number of fixes so far.
    """

    def __init__(self) -> None:
        self.tested = self.rejected = 0
        self._recent: deque[bool] = deque(maxlen=_REMEMBERED)

    def weight(
        self,
        pose: gtsam.Pose3,
        known: FloatArray,
        position: FloatArray,
        covariance: FloatArray,
        arm: FloatArray,
    ) -> float:
        """Factor on the information of a fix, from 0 to 1.

        Args:
            pose: predicted, of the body.
            known: (6, 6) its covariance, in the tangent of the pose.
            position: (3,) measured, of the antenna.
            covariance: (3, 3) of the measurement.
            arm: (3,) of the antenna in the body.
        """
        R = pose.rotation().matrix()
        H = np.hstack([-R @ gtsam.Rot3.Hat(arm), R])
        S = H @ known @ H.T + covariance
        innovation = position - antenna(pose, arm)
        distance = float(np.sqrt(innovation @ np.linalg.solve(S, innovation)))
        rejected = distance > _GATE
        self._recent.append(rejected)
        self.tested += 1
        if rejected and sum(self._recent) <= _MOST_REJECTED:
            self.rejected += 1
            return 0.0
        return min(1.0, _HUBER / max(distance, 1e-12))


def antenna_path(
    trajectory: Trajectory, stamps_ns: IntArray, arm: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Positions (N, 3) of the antenna at times (N,), NaN where the trajectory has none, and which.

    Args:
        trajectory: of the body.
        stamps_ns: ascending.
        arm: (3,) of the antenna in the body.
    """
    near, valid = interpolate(trajectory, stamps_ns, _LONGEST_GAP_S)
    places = np.full((len(stamps_ns), 3), np.nan)
    places[valid] = near.positions + Rotation.from_quat(near.quaternions).apply(arm)
    return places, valid


def between_poses(
    poses: tuple[gtsam.Pose3, gtsam.Pose3], share: float, arm: FloatArray
) -> FloatArray:
    """Position (3,) of the antenna between two poses, at a share of the time from 0 to 1."""
    first, last = poses
    ends = Rotation.from_matrix([first.rotation().matrix(), last.rotation().matrix()])
    turned = Slerp([0.0, 1.0], ends)(share).apply(arm)
    place: FloatArray = (1.0 - share) * first.translation() + share * last.translation() + turned
    return place


def pose_key(frame: int) -> int:
    """Key of the pose of a frame."""
    return int(X(frame))
