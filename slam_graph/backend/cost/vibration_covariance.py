# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the vibration of an accelerometer adds to the covariance of a state.

A vibrating accelerometer has an error that lasts for seconds. It is neither white nor a random
walk: against a path that agrees with the IMU, the mean specific force over one second is off by 7
to 12 times what the calibrated white noise gives, with a correlation time of 1 to 4 s, and is not
more after ten seconds (EuRoC, whose accelerometer vibrates; on TUM-VI, which does not, 1.2 to 2.8
times). White noise that is as large over seconds would be far too large from frame to frame, and
the estimate would follow its images too much.

So the estimate is left as it is, and the error is considered (Schmidt 1966; Maybeck 1979, sec.
6.8): a first-order Gauss-Markov process c (m/s², body frame) beside the bias of the accelerometer,
which is not in the model that the Kalman gain is computed from. With the error e of a state, the
transition F of a step and its effect G of the bias on pose and velocity, what c adds to the
covariance of e follows from

    e⁻ = F e + G c,    e⁺ = A e⁻,    A = E[e⁺ e⁻ᵀ] (P⁻)⁻¹ = P⁺ (P⁻)⁻¹,

as the error after an optimal step is uncorrelated with the correction. This neglects that c is
correlated with the other variables of the window.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.geometry import NavState

_RATIO = 10.0
"""Standard deviation of c, in units of the mean of calibrated white noise over one second. Measured
on V1_02 and V2_01: 0.02 m/s², for a calibrated density of 0.002 m/s²/√Hz."""
_CORRELATION_TIME_S = 2.0
_STATE, _ACCEL_BIAS, _MARKOV = slice(0, 15), slice(9, 12), slice(15, 18)
_DRIVEN = slice(0, 9)
"""Pose and velocity, which an error of the specific force drives."""


class VibrationCovariance:
    """What c adds to the covariance of a state, and its covariance with c.

    Both are one matrix (18, 18): the tangent of `NavState.covariance` (15), then c (3).
    """

    def __init__(self, accel_noise_density: float) -> None:
        """Begin without vibration.

        Args:
            accel_noise_density: of the calibrated white noise, m/s²/√Hz.
        """
        self._variance = (_RATIO * accel_noise_density) ** 2
        self._X = self._ahead = np.zeros((18, 18))

    @property
    def vanishes(self) -> bool:
        """Whether nothing has vibrated so far."""
        return not np.count_nonzero(self._X)

    def predict(self, transition: FloatArray, dt_s: float, vibrates: bool) -> None:
        """Predict a frame from the last one that was corrected.

        Args:
            transition: (15, 15) of the error of the state.
            dt_s: time between the two.
            vibrates: whether the accelerometer does.
        """
        F, memory = np.zeros((18, 18)), np.exp(-dt_s / _CORRELATION_TIME_S)
        F[_STATE, _STATE] = transition
        F[_DRIVEN, _MARKOV] = transition[_DRIVEN, _ACCEL_BIAS]
        F[_MARKOV, _MARKOV] = memory * np.eye(3)
        self._ahead = F @ self._X @ F.T
        if vibrates:
            self._ahead[_MARKOV, _MARKOV] += (1.0 - memory**2) * self._variance * np.eye(3)

    def correct(self, before: FloatArray, after: FloatArray) -> None:
        """Take the measurements of the predicted frame into account.

        Args:
            before: (15, 15) covariance of the predicted state.
            after: (15, 15) of the state after the step.
        """
        A = np.eye(18)
        A[_STATE, _STATE] = np.linalg.solve(before, after).T
        self._X = self._ahead = A @ self._ahead @ A.T

    def added_to(self, state: NavState) -> NavState:
        """The state of the frame that was predicted or corrected last, with what vibration adds."""
        if state.covariance is None or not self._ahead.any():
            return state
        added = self._ahead[_STATE, _STATE]
        return replace(state, covariance=state.covariance + 0.5 * (added + added.T))
