# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Priors, IMU and standstill factors over a recording, in GTSAM, and averaged observations.

Averages the observations of the frames between keyframes into those of the keyframes. The IMU
predicts the motion from a keyframe to the neighbouring frames to a fraction of a pixel. So the
reprojection errors of these frames are those of the keyframe with other noise, and their mean
replaces the error of the keyframe's own observation. The cost keeps its size.

The variance of a mean depends on the tracks, whose errors are correlated from frame to frame: with
the correlation ρ of two errors of a group, the mean of n has the variance σ² (ρ + (1 - ρ) / n). ρ
is measured as the intraclass correlation over all groups (Fisher 1925).

Keyframe k has the pose X(k), the velocity V(k) and the bias B(k).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.adaptive_imu_noise import MotionChange
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.imu_factor import IMU_GAP_SCALE, imu_factor
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.zero_velocity import zero_velocity_factors
from slam_graph.backend.smoothing.imu_noise_estimation import (
    ImuNoiseFactors,
    TimesCovariance,
    variance_ratios,
)
from slam_graph.backend.smoothing.imu_noise_shares import noise_shares
from slam_graph.backend.smoothing.recording_segment import RecordingSegment
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.sensors import Rig


def nearest_keyframe(stamps_ns: IntArray, keyframes: IntArray) -> IntArray:
    """(N,) number of the keyframe nearest to each frame in time."""
    times = stamps_ns[keyframes]
    return np.searchsorted(times[:-1] + np.diff(times) // 2, stamps_ns)


def averaged(
    obs: Observations,
    own: Geometry,
    seen: Observations,
    all_frames: Geometry,
    nearest: IntArray,
    projections: tuple[RigProjection, RigProjection],
    limit_px: float,
) -> tuple[Observations, FloatArray]:
    """Observations of keyframes, averaged over the frames around them.

    Args:
        obs: of the keyframes; frame indices are those of keyframes.
        own: poses of the keyframes, points of the features of `obs`.
        seen: observations of the same features in all frames.
        all_frames: poses of all frames, points of the features of `obs`.
        nearest: (N,) number of the keyframe nearest to each frame.
        projections: of the rig; with the motions of keyframes, and with those of all frames, by
            which rolling shutters moved.
        limit_px: observations with a larger reprojection error are outliers.

    Returns:
        The observations, and their variances (M,) relative to that of a single observation;
        infinite where all observations of the group are outliers.
    """
    projection, everywhere = projections
    residuals, depths = everywhere.residuals(seen, all_frames)
    fits = (np.linalg.norm(residuals, axis=1) < limit_px) & (depths > 0.0)
    cameras = len(projection.cameras)
    key = _key(seen.feature, nearest[seen.frame], seen.camera, len(obs.frames), cameras)
    own_key = _key(obs.feature, obs.frame, obs.camera, len(obs.frames), cameras)
    row = np.minimum(np.searchsorted(own_key, key), len(own_key) - 1)
    counted = fits & (own_key[row] == key)
    row, residuals = row[counted], residuals[counted]
    counts = np.bincount(row, minlength=len(obs))
    sums = np.stack([np.bincount(row, residuals[:, i], len(obs)) for i in range(2)], axis=1)
    means = sums / np.maximum(counts, 1)[:, None]
    rho = _correlation(residuals, means[row], counts[row])
    predicted = obs.pixels - projection.residuals(obs, own)[0]
    variances = np.full(len(obs), np.inf)
    np.divide(1.0 - rho, counts, out=variances, where=counts > 0)
    return replace(obs, pixels=predicted + means), rho + variances


def _correlation(values: FloatArray, means: FloatArray, counts: IntArray) -> float:
    """Intraclass correlation, from 0 to 1, of values (N, 2) in groups.

    Args:
        values: of all groups.
        means: (N, 2) of the group of each value.
        counts: (N,) size of the group of each value.
    """
    shared = counts > 1
    values, means, counts = values[shared], means[shared], counts[shared]
    if len(values) == 0:
        return 0.0
    # groups of n have n - 1 degrees of freedom of their own
    within = float(np.mean(np.sum((values - means) ** 2, axis=1) * counts / (counts - 1)))
    total = float(np.mean(np.sum(values**2, axis=1)))
    return float(np.clip(1.0 - within / max(total, 1e-300), 0.0, 1.0))


def _key(
    feature: IntArray, keyframe: IntArray, camera: IntArray, keyframes: int, cameras: int
) -> IntArray:
    """A unique key of each observation, ascending in the order of observations."""
    return (feature * keyframes + keyframe) * cameras + camera


_ANCHOR_SIGMA = 1e-3
"""Prior on position (m) and yaw (rad) of the anchor, which are unobservable: it fixes the gauge."""
DEFINED_SIGMA = 1e-5
"""The same where position and yaw of the anchor define the world."""
_SCALE_SIGMA = 1e-4
"""Relative standard deviation of the scale where it is a convention: it fixes the gauge, too."""
_UNKNOWN_TILT_RAD = 10.0
"""Prior on roll and pitch of the anchor, which gravity determines: none."""
_UNKNOWN_GAUGE = 1e3
"""Prior on position and rotation of the anchor where position fixes determine them: none."""
GYRO_BIAS_SIGMA = 0.05
"""Prior on the first gyroscope bias, rad/s: loose, as the estimate of a filter after its start."""
ACCEL_BIAS_SIGMA = 0.3
"""Prior on the first accelerometer bias, m/s²: loose, as above."""
_LEAST_PART = 0.02
"""Least part of a variance of the IMU to which it is reduced without preintegration."""


class RecordingFactors:
    """Builds the factors of a segment.

    Args:
        segment: times and IMU samples.
        anchor: number of the keyframe whose position and yaw are fixed.
        rig: calibrated sensors, with cameras that GTSAM has (`with_gtsam_cameras`).
        backend: noise.
        config: the robust loss.
        noise: factors on the noise of the IMU beyond those that the causal run learned.

    Attributes:
        noise: as given, or as `learn_noise` has found it since.
    """

    def __init__(
        self,
        segment: RecordingSegment,
        anchor: int,
        rig: Rig,
        backend: BackendConfig,
        config: FinalBaConfig,
        noise: ImuNoiseFactors,
    ) -> None:
        self._segment, self._anchor, self._rig = segment, anchor, rig
        self._backend, self._config = backend, config
        self.noise = noise
        between = list(pairwise(segment.keyframe_stamps_ns.tolist()))
        samples = [segment.imu.between(*interval) for interval in between]
        self._steps = [block.short_steps() for block in samples]
        self._changes = [MotionChange()] * len(samples)
        if backend.noise.adaptive.enabled:
            self._changes = list(map(MotionChange.between, [None, *samples[:-1]], samples))
        # variances of non-stationary noise add up
        frames = [segment.noise[i + 1 : j + 1] for i, j in pairwise(segment.keyframes.tolist())]
        self._learned = [np.sqrt(np.mean(noise**2, axis=0)).tolist() for noise in frames]
        longest_s = backend.noise.max_imu_gap_s
        self._preintegrated = self._assumed = np.zeros((len(samples), 4))
        self._shares: FloatArray | None = None
        self._gaps = [segment.imu.largest_gap_s(*interval) > longest_s for interval in between]

    def inertial(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Priors, IMU and zero-velocity factors, preintegrated at the biases of `values`."""
        aiding = self._segment.aiding
        other = [*aiding.fixes, *aiding.odometry]
        self._preintegrated = self._assumed = self._variances()
        self._shares = None
        return _graph(self._prior(values) + self._dynamics(values) + other)

    def reweighted(
        self, inertial: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> gtsam.NonlinearFactorGraph:
        """The factors under the noise that was learned since they were made.

        Samples stay preintegrated at the same biases, and priors about the same values, unless the
        noise has become so much smaller that it would be a small difference of large numbers: then
        both are made anew.

        Args:
            inertial: what `inertial`, or this, gave last.
            values: biases at which samples are preintegrated otherwise.
        """
        if np.any(self._variances() < _LEAST_PART * self._preintegrated):
            return self.inertial(values)
        found = [inertial.at(i) for i in range(inertial.size())]
        factors = {i: f for i, f in enumerate(found) if isinstance(f, gtsam.CombinedImuFactor)}
        if self._shares is None:
            biases = [f.preintegratedMeasurements().biasHat() for f in factors.values()]
            self._shares = noise_shares(
                [steps.durations_s for steps in self._steps],
                [s.gyro - b.gyroscope() for s, b in zip(self._steps, biases, strict=True)],
                [s.accel - b.accelerometer() for s, b in zip(self._steps, biases, strict=True)],
            )
        before, self._assumed = self._assumed, self._variances()
        change = np.einsum("mk,mkij->mij", self._assumed - before, self._shares)
        for (i, factor), more in zip(factors.items(), change, strict=True):
            model: Any = factor.noiseModel()
            noise = gtsam.noiseModel.Gaussian.Covariance(model.covariance() + more)
            found[i] = factor.cloneWithNewNoiseModel(noise)
        return _graph(found)

    def gauge(self, values: gtsam.Values, sigma: float = DEFINED_SIGMA) -> gtsam.NonlinearFactor:
        """A prior that fixes position and yaw of the anchor, or all of its pose without an IMU.

        Args:
            values: with the pose of the anchor.
            sigma: of position (m) and yaw (rad); by default so small that they define the world.
                Where position fixes do, nothing is known of them.
        """
        if self._segment.aiding.absolute:
            sigma = _UNKNOWN_GAUGE
        pose = values.atPose3(X(self._anchor))
        tilt = _UNKNOWN_TILT_RAD if self._rig.has_imu else sigma
        sigmas = np.diag([tilt, tilt, sigma])
        root = pose.rotation().matrix().T @ sigmas
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = root @ root.T
        covariance[3:, 3:] = np.eye(3) * sigma**2
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        return gtsam.PriorFactorPose3(X(self._anchor), pose, noise)

    def densities(self) -> FloatArray:
        """(K-1, 2) noise densities of gyroscope and accelerometer between the keyframes.

        Zero without an IMU: frames in between follow the causal estimate, not the dynamics.
        """
        imu, count = self._rig.imu, len(self._segment.keyframes) - 1
        if not self._rig.has_imu:
            return np.zeros((count, 2))
        factors = np.array([self._noise_factors(k) for k in range(count)]).reshape(-1, 3)
        white = np.array([imu.gyro_noise_density, imu.accel_noise_density])
        return np.asarray(factors[:, :1] * factors[:, 1:] * white)

    def _prior(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Priors on position and yaw of the anchor, and a loose one on the first bias."""
        bias = values.atConstantBias(B(0))
        loose = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3))
        return [
            self.gauge(values, _ANCHOR_SIGMA),
            gtsam.PriorFactorConstantBias(B(0), bias, loose),
            *self._scale(values),
        ]

    def _scale(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """What holds the scale where nothing measures it: how far away one keyframe is."""
        if self._rig.has_scale or self._segment.aiding.absolute:
            return []
        centre = values.atPose3(X(self._anchor)).translation()
        poses = [values.atPose3(X(k)) for k in range(len(self._segment.keyframes))]
        away = [pose.translation() - centre for pose in poses]
        k = int(np.argmax(np.linalg.norm(away, axis=1)))
        sigma = _SCALE_SIGMA * float(np.linalg.norm(away[k]))
        toward = poses[k].rotation().unrotate(away[k] / np.linalg.norm(away[k]))
        information = np.eye(6) / _UNKNOWN_GAUGE**2
        information[3:, 3:] += np.outer(toward, toward) / sigma**2
        noise = gtsam.noiseModel.Gaussian.Information(information)
        return [gtsam.PriorFactorPose3(X(k), poses[k], noise)]

    def learn_noise(
        self,
        inertial: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        times_covariance: TimesCovariance,
    ) -> bool:
        """Estimate the noise of the IMU from the residuals at the minimum.

        Intervals of standstill say nothing: the zero-velocity factors are looser than it is.

        Args:
            inertial: the factors of `inertial` in the cost.
            values: the minimum.
            times_covariance: the product of the covariance of all states with what it is given.

        Returns:
            Whether it is another one than assumed; otherwise what was assumed stays.
        """
        found = [inertial.at(i) for i in range(inertial.size())]
        factors = [factor for factor in found if isinstance(factor, gtsam.CombinedImuFactor)]
        moving = [k for k in range(len(factors)) if not self._gaps[k] and not self._still(k)]
        keyframes = len(self._segment.keyframes)
        chosen = [factors[k] for k in moving]
        ratios = variance_ratios(chosen, values, keyframes, times_covariance)
        learned = np.sqrt(np.mean(self._segment.noise**2, axis=0)).tolist()
        noise = self.noise.times(ratios).bounded(*learned)
        if noise.near(self.noise, learned):
            return False
        self.noise = noise
        return True

    def _still(self, k: int) -> bool:
        """Whether the platform stands still at any time between keyframe k and the next one."""
        i, j = self._segment.keyframes[k : k + 2]
        return bool(np.isfinite(self._segment.still_sigmas[i : j + 1]).any())

    def _noise_factors(self, k: int) -> tuple[float, float, float]:
        """Factors on all noise after keyframe k; on white noise of gyroscope; of accelerometer."""
        scale = IMU_GAP_SCALE if self._gaps[k] else 1.0
        gyro, accel = self.noise.white(*self._learned[k])
        return self._backend.noise.imu_scale, scale * gyro, scale * accel

    def _variances(self) -> FloatArray:
        """(K-1, 4) squared densities between the keyframes, as `noise_shares` has them."""
        calibrated = self.noise.walks(self._rig.imu)
        densities = []
        for k, change in enumerate(self._changes):
            imu, (scale, gyro, accel) = change.added_to(calibrated), self._noise_factors(k)
            white = gyro * imu.gyro_noise_density, accel * imu.accel_noise_density
            walks = imu.accel_random_walk, imu.gyro_random_walk
            densities.append([scale * density for density in (*white, *walks)])
        return np.array(densities).reshape(-1, 4) ** 2

    def _dynamics(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """IMU factors between consecutive keyframes, and zero-velocity factors."""
        factors: list[gtsam.NonlinearFactor] = []
        noise = self._backend.noise
        calibrated = self.noise.walks(self._rig.imu)
        for k, (i, j) in enumerate(pairwise(self._segment.keyframes.tolist())):
            imu_noise = self._changes[k].added_to(calibrated)
            params = imu_noise.preintegration_params(noise.gravity, *self._noise_factors(k))
            pim = self._steps[k].preintegrated(values.atConstantBias(B(k)), params)
            factors.append(imu_factor(k, k + 1, pim))
            if np.isfinite(self._segment.still_sigmas[i + 1 : j + 1]).all():
                factors += zero_velocity_factors(k, k + 1, self._segment.still_sigmas[j])
        return factors


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """The factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
