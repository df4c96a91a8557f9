# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Joint covariances of neighbouring frames, against those of single frames and random errors."""

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.frame_motions import FrameMotions
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    frame_covariances,
)

RNG = np.random.default_rng(3)


def known(count: int, stamps_ns: IntArray, keyframes: IntArray) -> tuple[FrameMotions, FloatArray]:
    """Keyframes with drawn covariances, which agree where they meet; rotations of all frames."""
    root = RNG.normal(size=(15 * count, 15 * count))
    whole = root @ root.T
    pairs = np.array([whole[15 * k : 15 * k + 30, 15 * k : 15 * k + 30] for k in range(count - 1)])
    rotations = Rotation.random(len(stamps_ns), random_state=1).as_matrix()
    nothing = np.zeros((4, 4))
    covariances = KeyframeCovariances(rotations[keyframes], pairs, None, nothing, np.zeros(3))
    densities = np.tile([0.7, 2.0], (count - 1, 1))
    frames = FrameInterpolation.of(stamps_ns, keyframes, densities)
    return FrameMotions(covariances, frames), rotations


def test_the_joint_covariance_has_those_of_both_frames() -> None:
    stamps_ns = np.cumsum(RNG.integers(10**7, 10**8, 12)).astype(np.int64)
    keyframes = np.array([0, 3, 4, 9, 11])
    motions, rotations = known(len(keyframes), stamps_ns, keyframes)
    joint = motions.joint_covariances(rotations)
    single = frame_covariances(motions.known, motions.frames, rotations)[:, :6, :6]
    np.testing.assert_allclose(joint[:, :6, :6], single[:-1], atol=1e-9)
    np.testing.assert_allclose(joint[:, 6:, 6:], single[1:], atol=1e-9)
    np.testing.assert_allclose(joint, joint.transpose(0, 2, 1), atol=1e-9)
    assert np.linalg.eigvalsh(joint).min() > -1e-9


def test_the_noise_in_between_is_that_of_white_noise_integrated() -> None:
    """Two frames within an interval, without errors of the keyframes: a Monte-Carlo simulation."""
    stamps_ns, keyframes = np.array([0, 3, 6, 10]) * 10**8, np.array([0, 3])
    motions, _ = known(2, stamps_ns, keyframes)
    motions.known.pairs[:] = 0.0
    still = np.tile(np.eye(3), (4, 1, 1))
    joint = motions.joint_covariances(still)[1]
    steps, draws = 1000, 4000
    rate = RNG.normal(0.0, 1.0 / np.sqrt(1e-3), (draws, steps))
    once = np.cumsum(rate, axis=1) * 1e-3
    twice = np.cumsum(once, axis=1) * 1e-3
    for path, density, row in ((once, 0.7, 0), (twice, 2.0, 3)):
        bridged = [path[:, k - 1] - k / steps * path[:, -1] for k in (300, 600)]
        expected = density**2 * np.cov(bridged)
        found = joint[np.ix_([row, row + 6], [row, row + 6])]
        np.testing.assert_allclose(found, expected, rtol=0.1)
