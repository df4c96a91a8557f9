# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What vibration adds to a covariance: that of a Kalman filter which does not know of an error."""

import gtsam
import numpy as np

from slam_graph.backend.cost.vibration_covariance import (
    _CORRELATION_TIME_S,
    _RATIO,
    VibrationCovariance,
)
from slam_graph.geometry.trajectory import NavState

DENSITY, DT_S, STEPS = 2e-3, 0.05, 40


def state(covariance: np.ndarray) -> NavState:
    zero = np.zeros(3)
    return NavState(0, gtsam.Pose3(), zero, accel_bias=zero, gyro_bias=zero, covariance=covariance)


def test_it_is_the_error_of_a_filter_that_does_not_know_of_it() -> None:
    """A linear system of 15 states: the errors of state and disturbance, with the filter's gain."""
    rng = np.random.default_rng(2)
    F = 0.95 * np.linalg.qr(rng.normal(size=(15, 15)))[0]
    G = np.zeros((15, 3))
    G[:9] = F[:9, 9:12]
    Q, noise = 0.01 * np.eye(15), 0.1 * np.eye(6)
    memory, variance = np.exp(-DT_S / _CORRELATION_TIME_S), (_RATIO * DENSITY) ** 2
    P, vibration = np.eye(15), VibrationCovariance(DENSITY)
    truth = np.zeros((18, 18))  # of the error of the state and of c
    truth[:15, :15] = P
    for _ in range(STEPS):
        H = rng.normal(size=(6, 15))
        before = F @ P @ F.T + Q
        gain = before @ H.T @ np.linalg.inv(H @ before @ H.T + noise)
        P = (np.eye(15) - gain @ H) @ before
        vibration.predict(F, DT_S, vibrates=True)
        vibration.correct(before, P)
        step = np.zeros((18, 18))
        step[:15, :15], step[:15, 15:], step[15:, 15:] = F, G, memory * np.eye(3)
        truth = step @ truth @ step.T
        truth[:15, :15] += Q
        truth[15:, 15:] += (1.0 - memory**2) * variance * np.eye(3)
        A = np.eye(18)
        A[:15, :15] -= gain @ H
        truth = A @ truth @ A.T
        truth[:15, :15] += gain @ noise @ gain.T
    found = vibration.added_to(state(P)).covariance
    assert found is not None
    np.testing.assert_allclose(found, truth[:15, :15], atol=1e-9 * np.abs(truth).max())
    assert np.trace(found - P) > 0.0


def test_without_vibration_a_state_stays_as_it_is_and_afterwards_it_forgets() -> None:
    vibration, own = VibrationCovariance(DENSITY), state(0.1 * np.eye(15))
    F, P = np.eye(15), 0.1 * np.eye(15)
    F[6:9, 9:12] = -DT_S * np.eye(3)
    vibration.predict(F, DT_S, vibrates=False)
    assert vibration.vanishes
    assert vibration.added_to(own) is own
    added = []
    for step in range(400):
        vibration.predict(F, DT_S, vibrates=step < 100)
        vibration.correct(P, 0.9 * P)
        covariance = vibration.added_to(own).covariance
        assert covariance is not None
        added.append(np.trace(covariance - P))
    assert added[99] > 0.0
    assert added[-1] < 1e-3 * added[99]
