# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Joint errors of the poses of frames, against those of single frames and random errors."""

from typing import Any, cast

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.learned_imu_noise import EliminatedMinimum
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    frame_covariances,
)

RNG = np.random.default_rng(3)


def equations(stamps_ns: IntArray, keyframes: IntArray, rotations: FloatArray) -> PoseEquations:
    """Of keyframes of which the rotations (K, 3, 3) are known, and nothing else."""
    values = gtsam.Values()
    for k, R in enumerate(rotations):
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(R), np.zeros(3)))
    minimum = EliminatedMinimum(None, gtsam.NonlinearFactorGraph(), values, cast(Any, None))
    densities = np.tile([0.7, 2.0], (len(keyframes) - 1, 1))
    frames = FrameInterpolation.of(stamps_ns, keyframes, densities)
    return PoseEquations(minimum, stamps_ns, keyframes, frames, np.zeros(0), True, keyframes)


def test_the_joint_covariance_of_frames_has_that_of_each() -> None:
    stamps_ns = np.cumsum(RNG.integers(10**7, 10**8, 12)).astype(np.int64)
    keyframes = np.array([0, 3, 4, 9, 11])
    rotations = Rotation.random(len(stamps_ns), random_state=1).as_matrix()
    known = equations(stamps_ns, keyframes, rotations[keyframes])
    root = RNG.normal(size=(15 * 5, 15 * 5))
    whole = root @ root.T
    pairs = np.array([whole[15 * k : 15 * k + 30, 15 * k : 15 * k + 30] for k in range(4)])
    single = frame_covariances(
        KeyframeCovariances(rotations[keyframes], pairs, None, np.zeros((4, 4)), np.zeros(3)),
        known.frames,
        rotations,
    )
    rows = known.error_rows(stamps_ns, rotations)
    poses = np.concatenate([15 * k + np.arange(6) for k in range(5)])
    joint = rows @ (rows @ whole[np.ix_(poses, poses)]).T
    joint += known.noise_between(stamps_ns, rotations)
    np.testing.assert_allclose(joint, joint.T, atol=1e-9)
    assert np.linalg.eigvalsh(joint).min() > -1e-9
    for k, covariance in enumerate(single):
        own = slice(6 * k, 6 * k + 6)
        np.testing.assert_allclose(joint[own, own], covariance[:6, :6], atol=1e-9)


def test_the_noise_in_between_is_that_of_white_noise_integrated() -> None:
    """Two frames within an interval: a Monte-Carlo simulation."""
    stamps_ns, still = np.array([0, 3, 6, 10]) * 10**8, np.tile(np.eye(3), (4, 1, 1))
    known = equations(stamps_ns, np.array([0, 3]), still[:2])
    joint = known.noise_between(stamps_ns[1:3], still[1:3])
    steps, draws = 1000, 4000
    rate = RNG.normal(0.0, 1.0 / np.sqrt(1e-3), (draws, steps))
    once = np.cumsum(rate, axis=1) * 1e-3
    twice = np.cumsum(once, axis=1) * 1e-3
    for path, density, row in ((once, 0.7, 0), (twice, 2.0, 3)):
        bridged = [path[:, k - 1] - k / steps * path[:, -1] for k in (300, 600)]
        expected = density**2 * np.cov(bridged)
        np.testing.assert_allclose(
            joint[np.ix_([row, row + 6], [row, row + 6])], expected, rtol=0.1
        )
