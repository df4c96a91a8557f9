# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Lever arm and clock of the position fixes as variables of the state.

`A(0)` is the position of the antenna in the body (m), `O(0)` the time (s) that is missing from the
stamps of the fixes beyond the given offset. They enter the state when the world is aligned with the
fixes, with the covariance that the alignment gives them, and are never marginalized. Variables are
in the order clock, lever arm everywhere.

A fix z between two frames is seen from one of them. With m, Q the pose of the body at its time in
that frame, u the velocity of the antenna there (in axes of the body), a the lever arm and τ the
time offset, which was τ₀ when m, Q were taken,

    q(a, τ) = m + Q a + u (τ - τ₀),    e = R q + p - z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, O

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.aiding.fix_factors import PositionFix
from slam_graph.backend.backend_config import GnssConfig
from slam_graph.sensors import AidingData

CLOCK, ARM = int(O(0)), int(A(0))
_ARM = slice(1, 4)
_COLUMNS = {CLOCK: slice(0, 1), ARM: _ARM}


class FixVariables:
    """Which of the two are variables, and what is known of them before.

    Attributes:
        keys: of the variables.
        columns: numbers of their components among those of time offset and lever arm, (n,).
        given: (4,) time offset (zero: beyond the given one) and lever arm, as they were given.
        sigmas: (n,) standard deviations of the variables as they were given, s and m.
    """

    def __init__(self, config: GnssConfig) -> None:
        clock = config.time_offset_sigma_s > 0.0
        arm = config.lever_arm_sigma_m > 0.0
        self.keys = (CLOCK,) * clock + (ARM,) * arm
        self.columns = np.flatnonzero([clock, arm, arm, arm])
        self.given = np.array([0.0, *config.lever_arm_m])
        every = np.array([config.time_offset_sigma_s, *[config.lever_arm_sigma_m] * 3])
        self.sigmas = every[self.columns]

    def values(self, calibration: FloatArray) -> gtsam.Values:
        """The variables, of a time offset and a lever arm (4,)."""
        values = gtsam.Values()
        for key in self.keys:
            values.insert(key, calibration[_COLUMNS[key]])
        return values

    def in_values(self, values: gtsam.Values, held: FloatArray) -> FloatArray:
        """Time offset and lever arm (4,), those that are not variables as in `held` (4,)."""
        calibration = held.copy()
        for key in self.keys:
            calibration[_COLUMNS[key]] = values.atVector(key)
        return calibration

    def calibration(self, values: FloatArray, covariance: FloatArray) -> AidingData.Calibration:
        """Of time offset (s) and lever arm (m), (4,), and the covariance (n, n) of variables."""
        whole = np.zeros((4, 4))
        whole[np.ix_(self.columns, self.columns)] = covariance
        return AidingData.Calibration(float(values[0]), values[_ARM].copy(), whole)


@dataclass(frozen=True, slots=True, eq=False)
class SeenFixes:
    """N position fixes, each seen from a pose of the body near it.

    Attributes:
        positions: (N, 3) of the antenna as measured, in the world, m.
        translations: (N, 3) m of the formula: the body then, in the frame of the pose, m.
        rotations: (N, 3, 3) Q, pose_R_body then.
        velocities: (N, 3) u, of the antenna then, in the frame of the pose, m/s.
        time_offset_s: τ₀, with which the fixes got their times.
    """

    positions: FloatArray
    translations: FloatArray
    rotations: FloatArray
    velocities: FloatArray
    time_offset_s: float

    @staticmethod
    def of(
        fixes: Sequence[PositionFix],
        poses: Sequence[tuple[gtsam.Pose3, gtsam.Pose3]],
        velocities: FloatArray,
        time_offset_s: float,
    ) -> SeenFixes:
        """Of fixes at their times by the present offset.

        Args:
            fixes: N measurements.
            poses: for each that of the body then, and that from which it is seen.
            velocities: (N, 3) of the antenna, in the world of the poses.
            time_offset_s: by which they have their times.
        """
        moves = [now.between(then) for then, now in poses]
        back = np.array([now.rotation().matrix().T for _, now in poses]).reshape(-1, 3, 3)
        return SeenFixes(
            np.array([fix.position for fix in fixes]).reshape(-1, 3),
            np.array([move.translation() for move in moves]).reshape(-1, 3),
            np.array([move.rotation().matrix() for move in moves]).reshape(-1, 3, 3),
            np.einsum("nij,nj->ni", back, np.asarray(velocities).reshape(-1, 3)),
            time_offset_s,
        )

    def in_body(self, calibration: FloatArray) -> FloatArray:
        """Where the antenna was (N, 3), seen from the poses: q, by time offset and arm (4,)."""
        late = float(calibration[0]) - self.time_offset_s
        return self.translations + self.rotations @ calibration[_ARM] + late * self.velocities

    def residuals(
        self, rotations: FloatArray, positions: FloatArray, calibration: FloatArray
    ) -> FloatArray:
        """What the fixes are off (N, 3): e, m.

        Args:
            rotations: (N, 3, 3) world_R_body of the poses.
            positions: (N, 3) of them.
            calibration: (4,) time offset and lever arm.
        """
        antennas: FloatArray = np.einsum("nij,nj->ni", rotations, self.in_body(calibration))
        return antennas + positions - self.positions

    def jacobians(
        self, rotations: FloatArray, calibration: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of e by pose (N, 3, 6), and by time offset and lever arm (N, 3, 4)."""
        by_pose = np.empty((len(rotations), 3, 6))
        by_pose[:, :, :3] = -rotations @ skew(self.in_body(calibration))
        by_pose[:, :, 3:] = rotations
        by_calibration = np.empty((len(rotations), 3, 4))
        by_calibration[:, :, 0] = np.einsum("nij,nj->ni", rotations, self.velocities)
        by_calibration[:, :, _ARM] = rotations @ self.rotations
        return by_pose, by_calibration


def calibrated_factor(
    pose: int,
    seen: SeenFixes,
    covariance: FloatArray,
    variables: FixVariables,
    held: FloatArray,
) -> gtsam.NoiseModelFactor:
    """A fix as a factor of a pose and of the variables.

    Args:
        pose: key of the pose from which it is seen.
        seen: one fix.
        covariance: (3, 3) of it.
        variables: which there are.
        held: (4,) time offset and lever arm where they are none.
    """

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None
    ) -> FloatArray:
        at = values.atPose3(pose)
        R, p = at.rotation().matrix()[None], np.asarray(at.translation())[None]
        calibration = variables.in_values(values, held)
        if H is not None:
            by_pose, by_calibration = seen.jacobians(R, calibration)
            H[0] = np.asfortranarray(by_pose[0])
            for number, key in enumerate(variables.keys, 1):
                H[number] = np.asfortranarray(by_calibration[0][:, _COLUMNS[key]])
        return np.asarray(seen.residuals(R, p, calibration)[0])

    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.CustomFactor(noise, [pose, *variables.keys], error)
