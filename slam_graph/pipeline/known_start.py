# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A first state that need not be found: one that comes with the data, or the truth itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.backend.estimator import Estimator
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import DataError
from slam_graph.geometry.interpolation import interpolate
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.results.run_result import RunResult

LEAD_NS = 1_000_000_000
"""How long before the first frame a given state may be: the IMU reaches back that far."""

DIFFERENCE_NS = 25_000_000
"""Half the time over which the velocity is taken from positions where the truth has none."""

TRUTH_SIGMAS = (0.01, 0.01, 0.05, 0.05, 0.01)
"""Of the true rotation (rad), position (m), velocity (m/s), accelerometer bias (m/s²) and gyroscope
bias (rad/s)."""

UNKNOWN_BIAS_SIGMAS = (0.2, 0.1)
"""Of the accelerometer and gyroscope bias where the truth does not tell them."""


@dataclass(frozen=True, eq=False)
class KnownStart:
    """Where the first state comes from, if not from the estimator's own initialisation.

    Attributes:
        state: a state that came with the data.
        truth: ground truth to start from at the first frame that it covers.
    """

    state: NavState | None = None
    truth: Trajectory | None = None

    @staticmethod
    def of(sequence: Sequence, result: RunResult, mode: str) -> KnownStart:
        """The known start under an initialisation mode (see `InitializationConfig.mode`).

        Raises:
            DataError: if the mode needs a state or a ground truth that the sequence has not.
        """
        name = result.info.name
        if mode == "groundtruth":
            if result.truth is None:
                raise DataError(f"{name}: no ground truth to start from; use another mode")
            return KnownStart(truth=result.truth)
        if mode not in ("auto", "given"):
            return KnownStart()
        state = sequence.initial_state()
        if state is not None and not (result.start_ns - LEAD_NS <= state.stamp_ns <= result.end_ns):
            state = None
        if state is None and mode == "given":
            raise DataError(
                f"{name}: no start state comes with the data at {result.config.start_s:g} s; "
                "use --set backend.initialization.mode=auto"
            )
        return KnownStart(state=state)

    def apply(self, estimator: Estimator, frame_ns: int, result: RunResult) -> None:
        """Start the estimator if the state is known by the time of a frame."""
        if estimator.initialized:
            return
        state = self.state
        if self.truth is not None:
            state = true_state(self.truth, frame_ns)
        if state is not None and state.stamp_ns <= frame_ns:
            estimator.start(state)
            result.start_was_given = True


def true_state(truth: Trajectory, stamp_ns: int) -> NavState | None:
    """The state at a time, with its covariance; None where the truth does not reach.

    Velocity is taken from positions where the truth has none, and biases are zero.
    """
    stamps = np.array([stamp_ns - DIFFERENCE_NS, stamp_ns, stamp_ns + DIFFERENCE_NS])
    near, valid = interpolate(truth, stamps)
    if not valid[1]:
        return None
    middle = int(valid[0])
    if near.velocities is not None:
        velocity = near.velocities[middle]
    elif len(near) > 1:
        seconds = (near.stamps_ns[-1] - near.stamps_ns[0]) * 1e-9
        velocity = (near.positions[-1] - near.positions[0]) / seconds
    else:
        return None
    sigmas = TRUTH_SIGMAS
    if near.accel_biases is None or near.gyro_biases is None:
        sigmas = TRUTH_SIGMAS[:3] + UNKNOWN_BIAS_SIGMAS
    return NavState(
        stamp_ns,
        near.pose(middle),
        velocity,
        accel_bias=np.zeros(3) if near.accel_biases is None else near.accel_biases[middle],
        gyro_bias=np.zeros(3) if near.gyro_biases is None else near.gyro_biases[middle],
        covariance=np.diag(np.repeat(np.square(sigmas), 3)),
    )
