# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Start in motion: a first guess of a short window, from static features and the IMU.

Static features of a start in motion: RANSAC over whole tracks with one inertial motion as model.
The equations of the alignment, with the position of each feature eliminated, hold for static
features only: no velocity and gravity explain the tracks of an object that accelerates or turns
together with the measured specific force. So RANSAC (Fischler & Bolles 1981, with the score of Torr
& Zisserman 2000) with the closed-form alignment as model finds the static features even where most
features are dynamic. An object in uniform motion is an inertial frame like any other: against it
the larger group wins.

Gyroscope bias from epipolar geometry, static features by consensus, then velocity, gravity and
scale in closed form. The engine refines the guess (see dynamic_refinement.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.feature_factors import eliminate_points
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.initialization.first_state import level_rotation
from slam_graph.backend.initialization.visual_inertial_alignment import (
    MIN_DEPTH_M,
    Alignment,
    Motion,
    align,
    alignment_equations,
    constrained_solution,
    estimate_gyro_bias,
)
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData

_SAMPLES = 100
"""If half of the features are static, one sample of four has only such with a probability of
0.998."""
_SAMPLE_FEATURES = 4
"""Features in a sample."""
_REFINED = 5
"""How many of the best samples are refined by their inliers."""
_REFINEMENTS = 3
"""How often a sample is refined by its inliers."""


class _Model:
    """The equations of J features with their positions eliminated, for the motion alone."""

    def __init__(
        self, obs: Observations, motion: Motion, rig: RigProjection, gravity: float
    ) -> None:
        weights = np.ones(len(obs))
        if rig.wide:  # errors are divided by distances, which are not depths towards the edge
            weights = np.sqrt(1.0 + np.sum(obs.normalized**2, axis=1))
        by_point, by_motion, b = alignment_equations(obs, motion, rig, weights)
        others = np.concatenate([by_motion, b[:, :, None]], axis=2)
        self._R, rest = eliminate_points(obs, by_point, others)
        self._R = self._R + 1e-9 * np.eye(3)
        self._top, self._rows = rest[:, :3], rest[:, 3:]
        self._squares = self._rows.transpose(0, 2, 1) @ self._rows
        self._gravity = gravity
        self._dof = np.maximum(2 * obs.counts - 3, 1)
        self._counts = obs.counts
        t = motion.times_s[obs.frame]
        self._t, self._tt = self._mean(obs, t), self._mean(obs, t**2)
        self._shift = np.column_stack(
            [self._mean(obs, column) for column in motion.displacements[obs.frame].T]
        )

    def _mean(self, obs: Observations, values: FloatArray) -> FloatArray:
        """Mean (J,) over the observations of each feature."""
        return np.asarray(np.bincount(obs.feature, values, len(obs.ids)) / self._counts)

    def solve(self, features: NDArray[np.int64], weights: FloatArray | None) -> FloatArray | None:
        """Velocity and gravity (6,) from some features, None if they do not determine them."""
        rows = self._rows[features]
        if weights is not None:
            rows = rows * weights[features, None, None]
        A = rows.reshape(-1, 7)
        try:
            found: Alignment = constrained_solution(A[:, :6], A[:, 6], self._gravity)
        except (np.linalg.LinAlgError, ValueError):
            return None
        x = np.concatenate([found.velocity, found.gravity])
        return x if np.isfinite(x).all() else None

    def distances(self, x: FloatArray) -> FloatArray:
        """Mean distances (J,) of the features from the body under a motion x (6,), m."""
        right = self._top[:, :, 6] - self._top[:, :, :6] @ x
        points = np.linalg.solve(self._R, right[:, :, None])[:, :, 0]
        eyes = self._t[:, None] * x[:3] + 0.5 * self._tt[:, None] * x[3:] + self._shift
        return np.asarray(np.maximum(np.linalg.norm(points - eyes, axis=1), MIN_DEPTH_M))

    def errors(self, x: FloatArray) -> FloatArray:
        """Mean squared residual (J,) of the features on the plane z = 1 under a motion x (6,)."""
        y = np.append(x, -1.0)
        squares = np.einsum("i,jik,k->j", y, self._squares, y)
        return np.asarray(np.maximum(squares, 0.0) / self._dof / self.distances(x) ** 2)


def static_features(
    obs: Observations,
    motion: Motion,
    rig: RigProjection,
    gravity: float,
    tolerance: float,
    rng: np.random.Generator,
) -> BoolArray:
    """Which features (J,) are static: those that agree on one motion of the body.

    Args:
        obs: features seen from at least three of the frames.
        motion: inertial motion between the frames.
        rig: mounting of the cameras.
        gravity: its magnitude, m/s².
        tolerance: largest root mean square residual on the plane z = 1.
        rng: draws the samples.
    """
    model, count, limit = _Model(obs, motion, rig, gravity), len(obs.ids), tolerance**2

    def score(x: FloatArray) -> float:
        return float(np.sum(np.minimum(model.errors(x), limit)))

    motions = [model.solve(np.arange(count), None)]
    for _ in range(_SAMPLES):
        sample = rng.choice(count, min(_SAMPLE_FEATURES, count), replace=False)
        motions.append(model.solve(sample, None))
    best = sorted((x for x in motions if x is not None), key=score)[:_REFINED]
    if not best:
        return np.ones(count, np.bool_)
    x = min((_refined(model, x, limit) for x in best), key=score)
    return np.asarray(model.errors(x) < limit)


def _refined(model: _Model, x: FloatArray, limit: float) -> FloatArray:
    """A motion that is computed from its inliers again and again."""
    for _ in range(_REFINEMENTS):
        agree = np.flatnonzero(model.errors(x) < limit)
        better = model.solve(agree, 1.0 / model.distances(x)) if len(agree) else None
        if better is None:
            break
        x = better
    return x


OUTLIER_SIGMAS = 3.0
"""Features with a larger root mean square reprojection error are outliers, in units of σ."""

MIN_FEATURES = 10
"""Smallest number of features that a start in motion is computed from."""


@dataclass(frozen=True, slots=True, eq=False)
class StartFrames:
    """The frames from which a start in motion is computed.

    Attributes:
        stamps_ns: times on the clock of the IMU.
        frames: their features.
    """

    stamps_ns: list[int]
    frames: list[FeatureFrame]

    @staticmethod
    def thinned(stamps_ns: list[int], frames: list[FeatureFrame], spacing_s: float) -> StartFrames:
        """The last frame, and going back every frame about `spacing_s` before the one chosen."""
        chosen = [len(frames) - 1]
        for k in range(len(frames) - 2, -1, -1):
            if stamps_ns[chosen[-1]] - stamps_ns[k] >= round(spacing_s * 0.95e9):
                chosen.append(k)
        chosen.reverse()
        return StartFrames([stamps_ns[k] for k in chosen], [frames[k] for k in chosen])

    def imu_between(self, imu: ImuBuffer) -> list[ImuData]:
        """IMU samples between each frame and the next."""
        ends = zip(self.stamps_ns[:-1], self.stamps_ns[1:], strict=True)
        return [imu.between(a, b) for a, b in ends]

    def only(self, ids: IntArray) -> StartFrames:
        """The same frames with only some features (N,)."""
        return StartFrames(self.stamps_ns, [frame.only(ids) for frame in self.frames])

    def tracks(self) -> FeatureTracks:
        """The observations of all frames, numbered from 0."""
        window = FeatureTracks()
        for k, frame in enumerate(self.frames):
            window.add(k, frame)
        return window


@dataclass(frozen=True, slots=True, eq=False)
class StartGuess:
    """First estimates for the batch problem of a start in motion.

    Attributes:
        states: of all frames; the first body is at the origin of the world with zero yaw.
        static: ids (J,) of the static features that are tracked for long enough, ascending.
    """

    states: list[NavState]
    static: IntArray


def guess_states(
    frames: StartFrames,
    imu: ImuBuffer,
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> StartGuess | str:
    """States of all frames of a window, or what is missing for them.

    Args:
        frames: at least two frames with features in common.
        imu: samples over them.
        rig: mounting of the cameras.
        params: of the preintegration.
        config: gravity and the noise of the features.
        rng: draws the samples of RANSAC.
    """
    samples = frames.imu_between(imu)
    tracks = frames.tracks()
    ids, lengths = tracks.lengths()
    ids = ids[lengths >= max(3, len(frames.frames) // 3)]
    if len(ids) < MIN_FEATURES:
        return f"more features with long tracks ({len(ids)} so far)"
    obs = tracks.observations(ids)
    tolerance = OUTLIER_SIGMAS * config.pixel_sigma / rig.cameras[0].fx

    def consensus(seen: StartFrames) -> tuple[FloatArray, Motion, BoolArray] | None:
        """Gyroscope bias by some features, the motion that it gives, and the static features."""
        gyro_bias = estimate_gyro_bias(seen.frames, samples, rig, params)
        if gyro_bias is None:
            return None
        motion = _integrate(frames, samples, gyro_bias, params)
        static = static_features(obs, motion, rig, config.gravity, tolerance, rng)
        return gyro_bias, motion, static

    found = consensus(frames)
    if found is not None and not found[2].all():
        # dynamic features have biased the gyroscope bias, and with it the consensus
        found = consensus(frames.only(ids[found[2]]))
    if found is None:
        return "features in common between frames"
    gyro_bias, motion, static = found
    if np.sum(static) < MIN_FEATURES:
        return "features that agree on a motion"
    alignment = align(obs.subset(static), motion, rig, config.gravity)
    if alignment is None:
        return "motion that determines gravity and scale"
    return StartGuess(_states(frames, motion, alignment, gyro_bias), ids[static])


def _integrate(
    frames: StartFrames,
    samples: list[ImuData],
    gyro_bias: FloatArray,
    params: gtsam.PreintegrationCombinedParams,
) -> Motion:
    """The inertial motion from the first frame to every other."""
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    R, p, v = np.eye(3), np.zeros(3), np.zeros(3)
    rotations, displacements, velocities = [R], [p], [v]
    for block in samples:
        pim = block.preintegrated(bias, params)
        p = p + v * pim.deltaTij() + R @ pim.deltaPij()
        v = v + R @ pim.deltaVij()
        R = R @ pim.deltaRij().matrix()
        rotations.append(R)
        displacements.append(p)
        velocities.append(v)
    times_s = (np.array(frames.stamps_ns) - frames.stamps_ns[0]) * 1e-9
    return Motion(times_s, np.array(rotations), np.array(displacements), np.array(velocities))


def _states(
    frames: StartFrames, motion: Motion, alignment: Alignment, gyro_bias: FloatArray
) -> list[NavState]:
    world_R_first = level_rotation(-alignment.gravity).matrix()
    positions = alignment.positions(motion) @ world_R_first.T
    velocities = alignment.velocities(motion) @ world_R_first.T
    rotations = world_R_first @ motion.rotations
    return [
        NavState(
            stamp_ns,
            gtsam.Pose3(gtsam.Rot3.ClosestTo(rotations[k]), positions[k]),
            velocities[k],
            accel_bias=np.zeros(3),
            gyro_bias=gyro_bias,
        )
        for k, stamp_ns in enumerate(frames.stamps_ns)
    ]
