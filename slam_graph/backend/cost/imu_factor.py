# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The dynamics model: the state of a new frame predicted by the IMU, and the factor between frames.

The residual x_{t+1} - g(x_t) of the dynamics is the preintegrated IMU factor of Forster et al. 2017
with the random walk of the biases (GTSAM's `CombinedImuFactor`); the integration itself is in
`ImuData.preintegrated` (`sensors.measurements`), the noise in `adaptive_imu_noise.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import lapack

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.aiding_factors import Aiding
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.adaptive_imu_noise import (
    FEWEST_FEATURES,
    DynamicsNoise,
    MotionChange,
)
from slam_graph.backend.cost.vibration_covariance import VibrationCovariance
from slam_graph.backend.cost.zero_velocity import zero_velocity_factors
from slam_graph.backend.solve.state import State, dims_of
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import ImuBuffer, ImuData, ImuNoise

IMU_GAP_SCALE = 1000.0
"""Factor on the white noise between two frames where samples are missing: the IMU then hardly
counts."""

_VELOCITY = slice(6, 9)
"""Rows of a state's covariance."""
_UNIT = np.eye(15)
_BEFORE, _AFTER = np.r_[0:9, 18:24], np.r_[9:18, 24:30]
"""Columns of the two states of a dynamics factor: poses and velocities come before the biases."""


@dataclass(frozen=True, slots=True, eq=False)
class _Transition:
    """A dynamics factor, linearised: e' = F e + noise.

    The errors e and e' of the two states have the tangents of `NavState.covariance`.

    Attributes:
        matrix: (15, 15) F.
        noise: (15, 15) root N of the covariance of the noise, N Nᵀ.
    """

    matrix: FloatArray
    noise: FloatArray

    @staticmethod
    def of(factor: gtsam.CombinedImuFactor, values: gtsam.Values) -> _Transition:
        """That of a factor at the values of its states."""
        A, _ = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
        # A_before e + A_after e' is white noise of 1
        right = np.zeros((15, 30), order="F")
        right[:, :15], right[:, 15:] = -A[:, _BEFORE], _UNIT
        _, _, solved, info = lapack.dgesv(A[:, _AFTER], right, overwrite_b=True)
        if info != 0:
            raise np.linalg.LinAlgError("the dynamics do not determine the later state")
        return _Transition(solved[:, :15], solved[:, 15:])

    def predicted(self, covariance: FloatArray) -> FloatArray:
        """The covariance (15, 15) of the later state from that of the earlier one."""
        F, N = self.matrix, self.noise
        return np.asarray(F @ covariance @ F.T + N @ N.T, dtype=np.float64)


def _known_of(window: Window) -> FloatArray | None:
    """Covariance (6, 6) of the newest pose by the prior and the factors that are not in it yet.

    After a beginning no state was reported from which it could be predicted. None where they leave
    the pose undetermined.
    """
    keys = {key for of_factor in map(gtsam.Factor.keys, window.factors) for key in of_factor}
    known = window.prior.extended(dims_of(sorted(keys - window.prior.layout.dims.keys())))
    for factor in window.factors:
        jacobian = gtsam.JacobianFactor(factor.linearize(window.state.first_frames))
        A, _ = jacobian.jacobian()
        rows = np.zeros((len(A), known.layout.size + 1))
        rows[:, known.layout.indices(jacobian.keys())] = A
        known = known.updated(rows)
    try:
        return known.covariance_of([int(X(window.frame))])
    except np.linalg.LinAlgError:
        return None


def imu_factor(
    i: int, j: int, pim: gtsam.PreintegratedCombinedMeasurements
) -> gtsam.CombinedImuFactor:
    """The dynamics residual between frames i and j."""
    return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)


@dataclass(frozen=True, slots=True)
class VelocityCorrection:
    """How far an estimate is from the velocity that the IMU predicted.

    Both are in variances of the prediction, over the three axes.

    Attributes:
        square: squared Mahalanobis distance.
        expected: its mean if covariances are right. A correction has the covariance P⁻ - P⁺, so
            this is between 0, where images tell nothing, and 1, where they tell all.
    """

    square: float
    expected: float

    @staticmethod
    def of(predicted: NavState, state: NavState) -> VelocityCorrection:
        """Compare an estimate with its prediction; both have a covariance."""
        assert predicted.covariance is not None
        assert state.covariance is not None
        prior, off = predicted.covariance[_VELOCITY, _VELOCITY], state.velocity - predicted.velocity
        columns = np.empty((3, 4), order="F")
        columns[:, 0], columns[:, 1:] = off, state.covariance[_VELOCITY, _VELOCITY]
        _, _, solved, info = lapack.dgesv(prior, columns)
        if info != 0:
            raise np.linalg.LinAlgError("the covariance of the predicted velocity is singular")
        expected = 1.0 - float(solved[0, 1] + solved[1, 2] + solved[2, 3]) / 3.0
        return VelocityCorrection(float(off @ solved[:, 0]) / 3.0, max(expected, 0.0))


class Propagation:
    """Appends a new frame to a window by the dynamics model.

    Attributes:
        noise: of the IMU; it adapts to the innovations where the settings ask for it.
        aiding: fixes and odometry between the frames; None for none.
        guesses: whether the motion is a guess, without an IMU.
        missed: whether samples were missing up to the last frame.
    """

    def __init__(
        self,
        imu: ImuNoise,
        config: BackendConfig,
        diagnostics: Diagnostics,
        guesses: bool = False,
    ) -> None:
        self.config = config
        self.diagnostics = diagnostics
        self.noise = DynamicsNoise(imu, config.noise)
        self.aiding: Aiding | None = None
        self.guesses = guesses
        self._density = config.noise.imu_scale * imu.accel_noise_density
        self.restart()

    def restart(self) -> None:
        """Forget the last state: the next one is not its successor. What was learned stays."""
        self._vibration = VibrationCovariance(self._density)
        self._last: NavState | None = None
        self._predicted: NavState | None = None
        self._still = False
        self.missed = False
        self._samples: ImuData | None = None

    @property
    def predicted(self) -> gtsam.Pose3 | None:
        """`world_T_body` of the last frame as the IMU predicts it from the estimate before.

        None where samples were missing, without an IMU, and without a covariance.
        """
        if self._predicted is None or self.guesses or self.missed:
            return None
        return self._predicted.world_T_body

    def append_frame(
        self,
        window: Window,
        imu: ImuBuffer,
        stamp_ns: int,
        still_sigma: float | None,
        corrected: Callable[[NavState, NavState], NavState] | None = None,
    ) -> None:
        """Make a new frame the current one.

        Args:
            window: gets the predicted state of the new frame, and the factors between it and the
                frame before.
            imu: samples up to the frame.
            stamp_ns: time of the frame on the clock of the IMU.
            still_sigma: standard deviation of the velocity from zero at a standstill, m/s; None if
                the platform moves.
            corrected: gives the state at which the new frame is linearised, from the last state and
                the predicted one, where this is a guess or samples are missing. An estimate would
                not find its way from there: the motion may be far from it.
        """
        i, j = window.frame, window.frame + 1
        previous = window.state.nav_state(i, window.stamp_ns, None)
        samples = imu.between(window.stamp_ns, stamp_ns)
        bias = window.state.frames.atConstantBias(B(i))
        missing = self.missed = self._misses_samples(imu, samples)
        pim = samples.preintegrated(bias, self._params(samples, missing))
        self._samples = samples
        predicted = previous.predicted(pim, stamp_ns)
        if not (missing or self.guesses):
            corrected = None
        first = predicted if corrected is None else corrected(previous, predicted)
        if self.guesses and corrected is not None and self.aiding is not None:
            first = self.aiding.by_odometry(previous, predicted) or first
        window.state.insert_imu_state(j, first)
        window.past.append(i)
        window.past_stamps_ns[i] = window.stamp_ns
        window.moving.append(i)
        window.frame, window.stamp_ns = j, stamp_ns
        factor = imu_factor(i, j, pim)
        window.factors.append(factor)
        self._predict_covariance(predicted, factor, window)
        self._still = still_sigma is not None
        if still_sigma is not None:
            window.factors += zero_velocity_factors(i, j, still_sigma)
        if self.aiding is not None and self.aiding.used:
            self._append_aiding(self.aiding, window, (i, j), (previous.stamp_ns, stamp_ns))

    def _append_aiding(
        self, aiding: Aiding, window: Window, frames: tuple[int, int], stamps_ns: tuple[int, int]
    ) -> None:
        """Append what fixes and odometry say of the motion to the new frame."""
        predicted = self._predicted
        known = None if predicted is None or predicted.covariance is None else predicted.covariance
        known = _known_of(window) if known is None else known[:6, :6]
        window.factors += aiding.factors(window.state, frames, stamps_ns, known, window.prior)

    def _predict_covariance(
        self, predicted: NavState, factor: gtsam.CombinedImuFactor, window: Window
    ) -> None:
        """Note the prediction with its covariance, where that of the last state is known."""
        self._predicted, last = None, self._last
        if last is None or last.covariance is None:
            return
        transition = _Transition.of(factor, window.state.frames)
        self._predicted = NavState(
            predicted.stamp_ns,
            predicted.world_T_body,
            predicted.velocity,
            accel_bias=predicted.accel_bias,
            gyro_bias=predicted.gyro_bias,
            covariance=transition.predicted(last.covariance),
        )
        if self._counts_vibration():
            dt_s = (window.stamp_ns - last.stamp_ns) * 1e-9
            self._vibration.predict(transition.matrix, dt_s, self.noise.vibrates)

    def _counts_vibration(self) -> bool:
        return self.noise.vibrates or not self._vibration.vanishes

    def predict(self, state: NavState, imu: ImuBuffer, stamp_ns: int) -> NavState:
        """The state at a later time by the IMU alone, with its covariance.

        Args:
            state: with its covariance.
            imu: samples from the time of the state on.
            stamp_ns: the later time.
        """
        samples = imu.between(state.stamp_ns, stamp_ns)
        bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
        missing = self._misses_samples(imu, samples)
        pim = samples.preintegrated(bias, self._params(samples, missing))
        predicted = state.predicted(pim, stamp_ns)
        if state.covariance is None:
            return predicted
        both = State()
        both.insert_imu_state(0, state)
        both.insert_imu_state(1, predicted)
        transition = _Transition.of(imu_factor(0, 1, pim), both.frames)
        return replace(predicted, covariance=transition.predicted(state.covariance))

    def reported(self, state: NavState) -> NavState:
        """The state of the last frame with the covariance that vibration gives it."""
        return self._vibration.added_to(state)

    def learn(self, state: NavState, features: int) -> VelocityCorrection | None:
        """Adapt the noise of the IMU to the difference of an estimate from its prediction.

        Not at a standstill, whose zero velocity is no measurement of images, and not where an IMU
        is corrected by a few features: the error of one track then biases all corrections.

        Args:
            state: the estimate of the last frame, with its covariance.
            features: how many the frame has in the camera that sees most of them.

        Returns:
            How the velocity was corrected; None at a standstill and in the first frame.
        """
        correction = None
        if self._last is not None and self._predicted is not None:
            if not self._still:
                dt_s = (state.stamp_ns - self._last.stamp_ns) * 1e-9
                correction = VelocityCorrection.of(self._predicted, state)
                if self.guesses or features >= FEWEST_FEATURES:
                    self.noise.learn(self._predicted, state, dt_s)
            if self._counts_vibration():
                assert self._predicted.covariance is not None
                assert state.covariance is not None
                self._vibration.correct(self._predicted.covariance, state.covariance)
        self._last = state
        return correction

    def _misses_samples(self, imu: ImuBuffer, samples: ImuData) -> bool:
        """Whether there is a gap between samples from frame to frame; it is counted."""
        gap_s = imu.largest_gap_s(*samples.stamps_ns[[0, -1]].tolist())
        if gap_s <= self.config.noise.max_imu_gap_s:
            return False
        self.diagnostics.warn("imu_gap_bridged", f"{gap_s:.3f} s without IMU samples")
        return True

    def _params(
        self, samples: ImuData, missing: bool = False
    ) -> gtsam.PreintegrationCombinedParams:
        """Parameters of the preintegration; where samples are missing, with much larger noise."""
        change = MotionChange.between(self._samples, samples)
        return self.noise.params(IMU_GAP_SCALE if missing else 1.0, change=change)
