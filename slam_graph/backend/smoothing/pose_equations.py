# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A minimum to which information on poses can be added, as features add theirs.

The normal equations of the keyframes are kept. What is learned later of their poses, with the
variables that it depends on eliminated, is added to the information of the images, and step and
covariances follow from the same elimination (`state_elimination.py`). It is exact to first order:
nothing is linearised anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.learned_imu_noise import EliminatedMinimum
from slam_graph.backend.smoothing.recording_factors import nearest_keyframe
from slam_graph.backend.smoothing.state_covariances import (
    FrameInterpolation,
    KeyframeCovariances,
    bridge_variances,
    keyframe_covariances,
)
from slam_graph.backend.smoothing.state_elimination import STATE, EliminatedStates
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.backend.solve.state import POSE_DIM
from slam_graph.geometry import NavState


@dataclass(frozen=True, slots=True, eq=False)
class PoseEquations:
    """The normal equations of K keyframes at a minimum.

    Attributes:
        minimum: the equations, with a fixed gauge.
        stamps_ns: (N,) of all frames.
        keyframes: (K,) numbers of those that are keyframes.
        frames: where the frames are among the keyframes.
        weights: (K,) of the keyframes in an alignment.
        level: whether gravity is measured.
        features: (J,) ids of the features that images say this by.
    """

    minimum: EliminatedMinimum
    stamps_ns: IntArray
    keyframes: IntArray
    frames: FrameInterpolation
    weights: FloatArray
    level: bool
    features: IntArray

    @classmethod
    def of(
        cls,
        minimum: EliminatedMinimum,
        stamps_ns: IntArray,
        keyframes: IntArray,
        densities: FloatArray,
        level: bool,
        features: IntArray,
    ) -> PoseEquations:
        """The equations at a minimum; see the class, and `FrameInterpolation.of` for densities."""
        frames = FrameInterpolation.of(stamps_ns, keyframes, densities)
        nearest = nearest_keyframe(stamps_ns, keyframes)
        weights = np.bincount(nearest, minlength=len(keyframes)) / len(nearest)
        return cls(minimum, stamps_ns, keyframes, frames, weights, level, features)

    @property
    def states(self) -> EliminatedStates:
        """The factor."""
        return self.minimum.states

    def with_information(self, added: FloatArray) -> PoseEquations:
        """The equations with information (6 K, 6 K) added on the poses.

        Raises:
            LinAlgError: if they are not positive definite then.
        """
        minimum, size = self.minimum, len(added)
        assert minimum.images is not None
        information = minimum.images.information.copy()
        information[:size, :size] += added
        images = replace(minimum.images, information=information)
        states = EliminatedStates(information.copy(), minimum.chain())
        return replace(self, minimum=replace(minimum, images=images, states=states))

    def without_images(self) -> PoseEquations:
        """The same for covariances alone; the information of the images is large."""
        return replace(self, minimum=replace(self.minimum, images=None))

    def images(self) -> tuple[FloatArray, FloatArray]:
        """What images say of the poses: information (6 K, 6 K) and gradient (6 K,)."""
        known = self.minimum.images
        assert known is not None
        size = known.gradient.size
        lower = np.tril(known.information[:size, :size])
        return lower + np.tril(lower, -1).T, known.gradient.ravel()

    def step(self, by_pose: FloatArray) -> FloatArray:
        """What the states (K, 15) move by for a gradient (6 K,) on the poses."""
        right = np.zeros((len(self.keyframes), STATE, 1))
        right[:, :POSE_DIM, 0] = by_pose.reshape(-1, POSE_DIM)
        return self.states.times_covariance(right)[:, :, 0]

    def rest(self) -> FloatArray:
        """What the states (K, 15) would move by in one more step without anything added."""
        assert self.minimum.images is not None
        gradient = self.minimum.chain().gradient
        gradient[:, :POSE_DIM] += self.minimum.images.gradient
        return self.states.times_covariance(gradient[:, :, None])[:, :, 0]

    def covariances(self) -> KeyframeCovariances:
        """Covariances of the keyframes."""
        return keyframe_covariances(self.states, self.minimum.values, self.weights, self.level)

    def errors_by(self, keyframe: int, states: list[NavState]) -> FloatArray:
        """How (N, 15, 6) errors of all frames follow from that of the pose of a keyframe.

        Args:
            keyframe: its number.
            states: of the N frames.
        """
        rotations = np.array([state.world_T_body.rotation().matrix() for state in states])
        right = np.zeros((len(self.keyframes), STATE, POSE_DIM))
        right[keyframe, :POSE_DIM] = np.eye(POSE_DIM)
        covariances = self.states.times_covariance(right)
        gains = covariances @ np.linalg.inv(covariances[keyframe, :POSE_DIM])
        known, _ = stacked_poses(self.minimum.values, range(len(self.keyframes)))
        back, part = rotations.transpose(0, 2, 1), self.frames.part[:, None, None]
        for rows in (slice(0, 3), slice(3, 6)):
            gains[:, rows] = known @ gains[:, rows]
        found = (1.0 - part) * gains[self.frames.before] + part * gains[self.frames.before + 1]
        for rows in (slice(0, 3), slice(3, 6)):
            found[:, rows] = back @ found[:, rows]
        return np.asarray(found)

    def error_rows(self, stamps_ns: IntArray, rotations: FloatArray) -> sparse.csr_array:
        """How pose errors (6 M) at some times follow from those (6 K) of the keyframes.

        Args:
            stamps_ns: (M,) ascending.
            rotations: (M, 3, 3) world_R_body then.
        """
        before, part = self._places(stamps_ns)
        known, _ = stacked_poses(self.minimum.values, range(len(self.keyframes)))
        back = rotations.transpose(0, 2, 1)
        first = (1.0 - part)[:, None, None] * (back @ known[before])
        second = part[:, None, None] * (back @ known[before + 1])
        blocks = np.stack([first, second, first, second], axis=1).reshape(-1, 3, 3)
        columns = 2 * before[:, None] + [0, 2, 1, 3]
        starts = np.arange(0, 4 * len(before) + 1, 2)
        shape = (POSE_DIM * len(before), POSE_DIM * len(self.keyframes))
        return sparse.bsr_array((blocks, columns.ravel(), starts), shape=shape).tocsr()

    def noise_between(self, stamps_ns: IntArray, rotations: FloatArray) -> FloatArray:
        """Joint covariance (6 M, 6 M) of what the noise of the IMU adds between the keyframes.

        Args:
            stamps_ns: (M,).
            rotations: (M, 3, 3) world_R_body then.
        """
        count = len(stamps_ns)
        turns = np.einsum("iba,jbc->ijac", rotations, rotations)
        N = np.zeros((count, POSE_DIM, count, POSE_DIM))
        variances = bridge_variances(self.frames, *self._places(stamps_ns))
        for rows, variance in zip((slice(0, 3), slice(3, 6)), variances, strict=True):
            N[:, rows, :, rows] = (variance[:, :, None, None] * turns).transpose(0, 2, 1, 3)
        return N.reshape(POSE_DIM * count, -1)

    def times_covariance(self, columns: FloatArray) -> FloatArray:
        """The product (6 K, m) of the covariance of all poses with a matrix (6 K, m)."""
        right = np.zeros((len(self.keyframes), STATE, columns.shape[1]))
        right[:, :POSE_DIM] = columns.reshape(-1, POSE_DIM, columns.shape[1])
        return self.states.times_covariance(right)[:, :POSE_DIM].reshape(columns.shape)

    def _places(self, stamps_ns: IntArray) -> tuple[IntArray, FloatArray]:
        """Last keyframe (M,) before each time, and the part (M,) of the way to the next one."""
        times = self.stamps_ns[self.keyframes]
        before = np.clip(np.searchsorted(times, stamps_ns, "right") - 1, 0, len(times) - 2)
        return before, (stamps_ns - times[before]) / np.diff(times)[before]
