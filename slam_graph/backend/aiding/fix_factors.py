# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Absolute measurements of a sensor on the body as factors: its position, or its orientation.

A measurement between two frames is moved to one of them by how far the sensor came and turned in
between, which images and IMU know to millimetres. The residuals are those of GTSAM's
`GPSFactorArm` and `PoseRotationPrior3D`. A known pose is both measurements: their errors are
independent, and a tag whose orientation is ambiguous may still be in the right place.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar, TypeAlias

import gtsam
import numpy as np
import scipy  # its parts are imported when they are first used
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.sensors import AidingData

_REJECTED, _REDUCED = 0.001, 0.05
"""Shares of good fixes that are rejected, and that count less, as their innovation is large."""
FIX_LOSS = RobustLoss("cauchy", 4.0)
"""The loss in the final adjustment: a good fix counts for 0.84, one that is off by 10 σ for
0.14."""
_REMEMBERED, _MOST_REJECTED = 10, 7
"""Where more of the last fixes were rejected, not they are wrong but the estimate is."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionFix:
    """A position of a sensor.

    Attributes:
        stamp_ns: time.
        position: (3,) in the world, m.
        covariance: (3, 3) of it, m².
        arm: (3,) position of the sensor in the body, m.
        source: what measured it.
    """

    stamp_ns: int
    position: FloatArray
    covariance: FloatArray
    arm: FloatArray
    source: str = "gnss"

    @property
    def is_timed(self) -> bool:
        """Whether the time offset of its source may be estimated."""
        return self.source == "gnss"

    @property
    def is_of_pose(self) -> bool:
        """Whether it is part of a known pose, whose orientation may be measured as well."""
        return self.source == "poses"

    def moved(self, then: gtsam.Pose3, now: gtsam.Pose3) -> PositionFix:
        """The same measurement at another pose of the body.

        Args:
            then: estimated pose of the body at the time of the measurement.
            now: the pose to which it is moved.
        """
        return replace(self, position=self.position + self.of(now) - self.of(then))

    def of(self, pose: gtsam.Pose3) -> FloatArray:
        """Position (3,) of the sensor in the world, at a pose of the body."""
        return np.asarray(pose.transformFrom(self.arm))

    def velocity(self, before: gtsam.Pose3, after: gtsam.Pose3, seconds: float) -> FloatArray:
        """Mean velocity (3,) of the sensor in the world between two poses of the body, m/s."""
        return (self.of(after) - self.of(before)) / seconds

    def factor(self, key: int, weight: float = 1.0, robust: bool = False) -> gtsam.NoiseModelFactor:
        """The measurement of a pose.

        Args:
            key: of the pose.
            weight: on its information.
            robust: whether a Cauchy loss lets it count less the farther it is off.
        """
        noise = _noise(self.covariance / weight, robust)
        return gtsam.GPSFactorArm(key, self.position, self.arm, noise)


@dataclass(frozen=True, slots=True, eq=False)
class OrientationFix:
    """An orientation of a sensor.

    Attributes:
        stamp_ns: time.
        world_R_body: the orientation of the body that it means.
        covariance: (3, 3) of a rotation about the axes of the world, rad².
        source: what measured it.
    """

    stamp_ns: int
    world_R_body: gtsam.Rot3
    covariance: FloatArray
    source: str = "orientations"
    is_timed: ClassVar[bool] = False
    is_of_pose: ClassVar[bool] = True

    def moved(self, then: gtsam.Pose3, now: gtsam.Pose3) -> OrientationFix:
        """See `PositionFix`."""
        turn = then.rotation().between(now.rotation())
        return replace(self, world_R_body=self.world_R_body.compose(turn))

    def factor(self, key: int, weight: float = 1.0, robust: bool = False) -> gtsam.NoiseModelFactor:
        """See `PositionFix`."""
        body_R_world = self.world_R_body.matrix().T
        covariance = body_R_world @ self.covariance @ body_R_world.T
        pose = gtsam.Pose3(self.world_R_body, np.zeros(3))
        return gtsam.PoseRotationPrior3D(key, pose, _noise(covariance / weight, robust))


Fix: TypeAlias = PositionFix | OrientationFix
"""An absolute measurement of a sensor at one time."""


def _noise(covariance: FloatArray, robust: bool) -> gtsam.noiseModel.Base:
    """Gaussian noise of a covariance (3, 3), under a Cauchy loss or not."""
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if robust:
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(FIX_LOSS.width)
        noise = gtsam.noiseModel.Robust.Create(cauchy, noise)
    return noise


def fixes_of(data: AidingData, config: BackendConfig, arm_m: FloatArray | None = None) -> list[Fix]:
    """Absolute measurements of a stretch of time: positions by the fixes, then the known poses.

    Args:
        data: with times on the clock of the estimate.
        config: lever arms and the mounting of the sensor of known poses.
        arm_m: (3,) lever arm of the position fixes, where it is not that of the settings.
    """
    arm = np.array(config.gnss.lever_arm_m) if arm_m is None else arm_m
    rows = zip(data.fix_stamps_ns.tolist(), data.fix_positions, data.fix_covariances, strict=True)
    fixes: list[Fix] = [PositionFix(*row, arm) for row in rows]
    arm = np.array(config.known_poses.lever_arm_m)
    x, y, z, w = config.known_poses.quaternion
    sensor_R_body = gtsam.Rot3.Quaternion(w, x, y, z).inverse()
    for k, stamp_ns in enumerate(data.pose_stamps_ns.tolist()):
        of_position, of_rotation = data.pose_sigmas[k].reshape(2, 3)
        if np.isfinite(of_position).all():
            covariance = np.diag(of_position**2)
            fixes.append(PositionFix(stamp_ns, data.pose_positions[k], covariance, arm, "poses"))
        if np.isfinite(of_rotation).all():
            x, y, z, w = data.pose_quaternions[k].tolist()
            turned = gtsam.Rot3.Quaternion(w, x, y, z).compose(sensor_R_body)
            fixes.append(OrientationFix(stamp_ns, turned, np.diag(of_rotation**2)))
    return fixes


class FixGate:
    """The χ² gate of absolute measurements of three numbers, and the loss of those that pass it.

    The innovation decides, under the covariance that the prediction and the fix give it. A fix
    beyond the 95 % sphere counts less (Huber), one beyond the 99.9 % sphere not at all. If most of
    the last fixes were rejected the estimate is wrong, and they pull it back.

    Attributes:
        tested, rejected: number of fixes so far.
    """

    def __init__(self) -> None:
        self.tested = self.rejected = 0
        self._recent: deque[bool] = deque(maxlen=_REMEMBERED)

    def restart(self) -> None:
        """The estimate begins anew: the last fixes say nothing of it. What was counted stays."""
        self._recent.clear()

    def weight(self, fix: Fix, pose: gtsam.Pose3, known: FloatArray) -> float:
        """Factor on the information of a fix, from 0 to 1.

        Args:
            fix: at this pose.
            pose: predicted, of the body.
            known: (6, 6) its covariance, in the tangent of the pose.
        """
        values = gtsam.Values()
        values.insert(pose_key(0), pose)
        # whitened: the innovation has the covariance H P Hᵀ + I
        whitened = gtsam.JacobianFactor(fix.factor(pose_key(0)).linearize(values))
        H, innovation = whitened.jacobian()
        S = H @ known @ H.T + np.eye(3)
        distance = float(np.sqrt(innovation @ np.linalg.solve(S, innovation)))
        rejected = distance > _farthest(_REJECTED)
        self._recent.append(rejected)
        self.tested += 1
        if rejected and sum(self._recent) <= _MOST_REJECTED:
            self.rejected += 1
            return 0.0
        return min(1.0, _farthest(_REDUCED) / max(distance, 1e-12))


@cache
def _farthest(share: float) -> float:
    """The Mahalanobis distance of an innovation beyond which there is such a share of good ones."""
    return float(np.sqrt(scipy.special.chdtri(3, share)))


def pose_between(first: gtsam.Pose3, last: gtsam.Pose3, share: float) -> gtsam.Pose3:
    """The pose between two, at a share of the time from 0 to 1."""
    place = (1.0 - share) * first.translation() + share * last.translation()
    return gtsam.Pose3(first.rotation().slerp(share, last.rotation()), place)


def pose_key(frame: int) -> int:
    """Key of the pose of a frame."""
    return int(X(frame))
