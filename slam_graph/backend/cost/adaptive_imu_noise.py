# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive noise of the IMU: found from the vibration of its samples and the corrections by images.

The noise densities of a data sheet do not hold on a vibrating airframe. If the densities are right,
the corrections of successive steps are white and have the covariance P⁻ - P⁺ (Mehra 1970; Mohamed
and Schwarz 1999). If the true noise is larger, corrections are larger, and because the filter
follows slowly they keep their direction over many steps. So densities are raised while corrections
are both too large and persistent, and fall back otherwise, never below those of the calibration.
Both conditions are needed: image errors that last, such as a feature that slides along an edge,
make small corrections persistent, and a noisier IMU would trust such images even more.

Corrections of the rotation are attributed to the white noise of the gyroscope, those of the
velocity to that of the accelerometer, and those of the biases to their random walks: errors of
scale and alignment of a real IMU change with the motion, slower than white noise and faster than a
bias at rest. What was learned of a random walk is kept for longer, as it shows in some motions.

All of this takes seconds, in which a start has gone wrong. Vibration shows at once: samples are
then many times noisier than the calibration says. And what a calibration leaves of the errors of
scale and alignment adds to the biases, in proportion to the specific force, and to the square of
the angular rate: that of a gyroscope shows in fast rotation only. So the biases change as the
motion does, and their random walks are larger there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, median
from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.robust_loss import MEDIAN_1D
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise

PERSISTENCE_TIME_S = 0.5
"""Time constant of the mean correction, which shows whether corrections keep their direction."""
SIZE_TIME_S = 2.0
"""Time constant of the mean squared correction."""
RESPONSE_TIME_S = 1.0
"""Time in which the variance grows by a factor of e if squares are twice as large as expected."""
_SLOW_FALL_TIME_S = 10.0
"""The same for random walks, and for the accelerometer as long as it vibrates, while they fall."""
_VIBRATION_TIME_S = 0.5
"""Samples of so long show whether the IMU vibrates."""
_VIBRATION_RATIO = 5.0
"""It does if their noise is so many times that of the calibration."""
_VIBRATING_ACCEL = 5.0
"""Factor on the white noise of the accelerometer when a vibration begins. Learning would come too
late for it: meanwhile vibration is taken for a tilt. Most of it is at high frequencies, which
integration takes out, so that this is much smaller than the noise of single samples."""
_FEWEST_SAMPLES = 20
"""Fewer samples within that time tell nothing."""
_THIRD_DIFFERENCE = np.sqrt(20.0)
"""Standard deviation of the third difference of white noise of 1."""
GYRO_SCALE_SIGMA, ACCEL_SCALE_SIGMA = 1.25e-4, 1e-3
"""Standard deviations of scale and alignment after calibration, relative; that of the gyroscope per
rad/s."""
FEWEST_FEATURES = 20
"""Corrections by fewer features tell nothing of the IMU: lasting errors of a few tracks make them
large and persistent, and larger noise of the IMU gives these tracks even more weight."""
MAX_FACTOR = 30.0
"""Largest factor on a density."""
_MAX_SQUARE = 4.0
"""Mean squares are clipped here, which limits how fast the noise grows."""
_GYRO, _ACCEL, _GYRO_WALK, _ACCEL_WALK = range(4)
"""The densities."""
_CORRECTED = slice(0, 3), slice(6, 9), slice(12, 15), slice(9, 12)
"""Rows of a state's covariance whose corrections tell of each: rotation, velocity, biases."""


@dataclass(frozen=True, slots=True)
class MotionChange:
    """How the motion changes from one frame interval to the next, as if it were a random walk.

    Attributes:
        rate: change of the mean angular rate times its magnitude over the square root of the time,
            rad²/s²/√s.
        force: that of the mean specific force, m/s²/√s.
    """

    rate: float = 0.0
    force: float = 0.0

    @staticmethod
    def between(before: ImuData | None, samples: ImuData) -> MotionChange:
        """That from the samples of one interval, if there is one, to those of the next."""
        if before is None:
            return MotionChange()
        root_s = math.sqrt(float(samples.stamps_ns[-1] - samples.stamps_ns[0]) * 1e-9)
        earlier, later = _mean(before.gyro), _mean(samples.gyro)
        rate = _length(_length(later) * later - _length(earlier) * earlier)
        force = _length(_mean(samples.accel) - _mean(before.accel))
        return MotionChange(rate / root_s, force / root_s)

    def added_to(self, imu: ImuNoise) -> ImuNoise:
        """Noise whose random walks have errors of scale and alignment in them."""
        return replace(
            imu,
            gyro_random_walk=math.hypot(imu.gyro_random_walk, GYRO_SCALE_SIGMA * self.rate),
            accel_random_walk=math.hypot(imu.accel_random_walk, ACCEL_SCALE_SIGMA * self.force),
        )


_STEADY = MotionChange()


def _mean(values: FloatArray) -> FloatArray:
    """The mean (3,) of samples (N, 3); NumPy's takes twice as long."""
    return np.asarray(np.add.reduce(values) / len(values))


def _length(vector: FloatArray) -> float:
    """The length of a vector (3,)."""
    return math.sqrt(vector @ vector)


class DensityScales:
    """The factors on K densities, each of one sensor.

    Attributes:
        factors: (K,) on the noise densities, at least one.
        fall_times_s: (K,) take the place of `RESPONSE_TIME_S` while a factor falls.
    """

    def __init__(self, fall_times_s: Sequence[float]) -> None:
        """Begin with the calibrated densities.

        Args:
            fall_times_s: K of them; see the class.
        """
        self.fall_times_s = np.array(fall_times_s)
        self._directions = np.zeros((len(fall_times_s), 3))
        self._sizes, self.factors = np.ones((2, len(fall_times_s)))

    def observe(self, corrections: FloatArray, covariances: FloatArray, dt_s: float) -> None:
        """Update the factors by the corrections of one step.

        Args:
            corrections: (K, 3) of the predicted quantities, each in the body frame or in the world.
            covariances: (K, 3, 3) that they have if the densities are right, in the same frames.
            dt_s: time since the step before.
        """
        variances, axes = np.linalg.eigh(covariances)
        known = variances[:, 0] > 0.0  # otherwise there is no information in some direction
        roots = np.sqrt(np.where(known[:, None], variances, 1.0))
        # whitened by the symmetric root, which keeps the axes, so that directions can be compared
        along = (corrections[:, None] @ axes)[:, 0] / roots
        white = (axes @ along[:, :, None])[:, :, 0]
        memory = math.exp(-dt_s / PERSISTENCE_TIME_S)
        directions = memory * self._directions + math.sqrt(1.0 - memory**2) * white
        memory = math.exp(-dt_s / SIZE_TIME_S)
        sizes = memory * self._sizes + (1.0 - memory) * np.add.reduce(white * white, axis=1) / 3.0
        persistence = np.add.reduce(directions * directions, axis=1) / 3.0
        surprise = np.minimum(np.minimum(persistence, sizes), _MAX_SQUARE) - 1.0
        responses_s = np.where(surprise > 0.0, RESPONSE_TIME_S, self.fall_times_s)
        factors = self.factors * np.exp(0.5 * surprise * dt_s / responses_s)
        factors = np.minimum(np.maximum(factors, 1.0), MAX_FACTOR)
        if np.count_nonzero(known) == len(known):
            self._directions, self._sizes, self.factors = directions, sizes, factors
            return
        self._directions[known], self._sizes[known] = directions[known], sizes[known]
        self.factors[known] = factors[known]


class DynamicsNoise:
    """Noise parameters of the preintegration that adapt during the run.

    Attributes:
        vibrates: whether the accelerometer does.
    """

    def __init__(self, imu: ImuNoise, config: NoiseConfig) -> None:
        self._imu = imu
        self._config = config
        slow = _SLOW_FALL_TIME_S
        self._scales = DensityScales([RESPONSE_TIME_S, RESPONSE_TIME_S, slow, slow])
        self.vibrates = False

    def params(
        self, scale: float = 1.0, least_factor: float = 1.0, change: MotionChange = _STEADY
    ) -> gtsam.PreintegrationCombinedParams:
        """Current parameters.

        Args:
            scale: on white noise, such as where samples are missing. Biases do not drift faster
                then: how they are known is worth keeping until there are samples again.
            least_factor: least factor on white noise.
            change: of the motion since the interval before.
        """
        factors = self._scales.factors
        imu = replace(
            self._imu,
            gyro_random_walk=self._imu.gyro_random_walk * float(factors[_GYRO_WALK]),
            accel_random_walk=self._imu.accel_random_walk * float(factors[_ACCEL_WALK]),
        )
        if self._config.adaptive.enabled:
            imu = change.added_to(imu)
        gyro, accel = (scale * max(factor, least_factor) for factor in self.factors)
        return imu.preintegration_params(self._config.gravity, self._config.imu_scale, gyro, accel)

    @property
    def factors(self) -> tuple[float, float]:
        """Factors on the white noise densities of gyroscope and accelerometer, at least one."""
        factors = self._scales.factors
        return float(factors[_GYRO]), float(factors[_ACCEL])

    @property
    def at_limit(self) -> bool:
        """Whether the factor on a density is as large as it may become."""
        return bool(self._scales.factors.max() >= MAX_FACTOR)

    def watch_vibration(self, imu: ImuBuffer, stamp_ns: int) -> None:
        """Raise the noise of the accelerometer at once when the IMU begins to vibrate.

        Args:
            imu: samples up to a frame.
            stamp_ns: time of the frame on the clock of the IMU.
        """
        if not self._config.adaptive.enabled:
            return
        vibrated, self.vibrates = self.vibrates, self._is_vibrating(imu, stamp_ns)
        scales = self._scales
        scales.fall_times_s[_ACCEL] = _SLOW_FALL_TIME_S if self.vibrates else RESPONSE_TIME_S
        if self.vibrates and not vibrated:
            scales.factors[_ACCEL] = max(scales.factors[_ACCEL], _VIBRATING_ACCEL)

    def _is_vibrating(self, imu: ImuBuffer, stamp_ns: int) -> bool:
        """Whether the samples of the accelerometer are much noisier than calibrated.

        Third differences hardly know the motion of a body.
        """
        since_ns = stamp_ns - round(_VIBRATION_TIME_S * 1e9)
        first = int(imu.data.stamps_ns.searchsorted(since_ns))
        stamps, accel = imu.data.stamps_ns[first:], imu.data.accel[first:]
        if len(stamps) < _FEWEST_SAMPLES:
            return self.vibrates
        spacing_s = float(median(stamps[1:] - stamps[:-1])) * 1e-9
        for _ in range(3):  # NumPy's `diff` takes as long again
            accel = accel[1:] - accel[:-1]
        size = float(median(np.abs(accel).ravel()))
        sigma = size / (MEDIAN_1D * _THIRD_DIFFERENCE)
        density = self._config.imu_scale * self._imu.accel_noise_density
        return bool(sigma > _VIBRATION_RATIO * density / np.sqrt(spacing_s))

    def learn(self, predicted: NavState, corrected: NavState, dt_s: float) -> None:
        """Compare the state that the IMU predicted with the state after the step.

        Args:
            predicted: with the covariance before the step's measurements.
            corrected: with the covariance after them.
            dt_s: time since the step before.
        """
        if not self._config.adaptive.enabled:
            return
        assert predicted.covariance is not None
        assert corrected.covariance is not None
        gained = predicted.covariance - corrected.covariance
        before, after = predicted.world_T_body.rotation(), corrected.world_T_body.rotation()
        corrections = (
            gtsam.Rot3.Logmap(before.between(after)),
            corrected.velocity - predicted.velocity,
            corrected.gyro_bias - predicted.gyro_bias,
            corrected.accel_bias - predicted.accel_bias,
        )
        covariances = np.array([gained[rows, rows] for rows in _CORRECTED])
        self._scales.observe(np.array(corrections), covariances, dt_s)
