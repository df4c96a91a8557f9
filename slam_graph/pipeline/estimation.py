# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Estimation: the back end at work on one frame after the other, from a known start or its own.

A known start is a first state that comes with the data, or is taken from the ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from slam_graph.backend import Estimator
from slam_graph.datasets import Sequence
from slam_graph.errors import DataError
from slam_graph.geometry import NavState, Trajectory, interpolate
from slam_graph.pipeline.divergence import DivergenceError, check_sane
from slam_graph.pipeline.recovery import Recovery
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.pipeline.tracking import TrackedPacket
from slam_graph.pipeline.world_of_fixes import usable_aiding
from slam_graph.results import RunInput, RunResult

_DIFFERENCE_NS = 25_000_000
"""Half the step of the central difference that gives the velocity where the truth has none."""

_TRUTH_SIGMAS = (0.01, 0.01, 0.05, 0.05, 0.01)
"""Standard deviations of the true rotation (rad), position (m), velocity (m/s), accelerometer bias
(m/s²) and gyroscope bias (rad/s)."""

_UNKNOWN_BIAS_SIGMAS = (0.2, 0.1)
"""Standard deviations of the accelerometer and gyroscope bias where the truth has none."""

ODOMETRY_UNUSED = (
    "the odometry reaches from no frame to the next one: it is on another clock, or its samples "
    "are more than 0.5 s apart"
)


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
    def of(sequence: Sequence, asked: RunInput) -> KnownStart:
        """The known start that the initialisation mode asks for (`backend.initialization.mode`).

        Raises:
            DataError: if the mode needs a state or a ground truth that the sequence does not have.
        """
        name, mode = asked.info.name, asked.config.backend.initialization.mode
        if mode == "groundtruth":
            if asked.truth is None:
                raise DataError(f"{name}: no ground truth to start from; use another mode")
            return KnownStart(truth=asked.truth)
        if mode not in ("auto", "given") or (mode == "auto" and asked.rig.needs_two_views):
            return KnownStart()  # a state does not say how far away things are
        state = sequence.initial_state()
        first_ns, last_ns = asked.states_ns
        if state is not None and not first_ns - Estimator.LEAD_NS <= state.stamp_ns <= last_ns:
            state = None
        if state is None and mode == "given":
            raise DataError(
                f"{name}: no start state comes with the data at {asked.config.start_s:g} s; "
                "use --set backend.initialization.mode=auto"
            )
        return KnownStart(state=state)

    def at(self, time_ns: int) -> NavState | None:
        """The state to start from at a time of a frame, or None if it is not known by then.

        The time is on the clock of the states, as those of the truth and of a given state are.
        """
        if self.truth is not None:
            return true_state(self.truth, time_ns)
        if self.state is not None and self.state.stamp_ns <= time_ns:
            return self.state
        return None


def true_state(truth: Trajectory, stamp_ns: int) -> NavState | None:
    """The state at a time, with its covariance; None where the truth does not reach.

    Velocity is taken from positions where the truth has none, and biases are zero.
    """
    stamps = np.array([stamp_ns - _DIFFERENCE_NS, stamp_ns, stamp_ns + _DIFFERENCE_NS])
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
    sigmas = _TRUTH_SIGMAS
    if near.accel_biases is None or near.gyro_biases is None:
        sigmas = _TRUTH_SIGMAS[:3] + _UNKNOWN_BIAS_SIGMAS
    return NavState(
        stamp_ns,
        near.pose(middle),
        velocity,
        accel_bias=np.zeros(3) if near.accel_biases is None else near.accel_biases[middle],
        gyro_bias=np.zeros(3) if near.gyro_biases is None else near.gyro_biases[middle],
        covariance=np.diag(np.repeat(np.square(sigmas), 3)),
    )


@contextmanager
def _solvable(where: str) -> Iterator[None]:
    """Turn a failure of the linear algebra into a divergence: sane states do not cause one.

    Args:
        where: of the recording, for the message.

    Raises:
        DivergenceError: if a system is singular.
    """
    try:
        yield
    except (RuntimeError, np.linalg.LinAlgError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DivergenceError(
            f"diverged at {where}: the equations cannot be solved ({reason})"
        ) from error


class Estimation:
    """Estimates the state at each frame and notes it in the result.

    Args:
        sequence: the recording, which may come with a start state.
        result: of the run; it is given states, landmarks and logs.

    Attributes:
        estimator: the back end.

    Raises:
        DataError: if the settings ask for a start state that the sequence does not have.
    """

    def __init__(self, sequence: Sequence, result: RunResult) -> None:
        config = result.config
        self.estimator = Estimator(
            result.input.rig, config.algorithm, config.backend, sequence.diagnostics
        )
        self._start = KnownStart.of(sequence, result.input)
        self._diagnostics = sequence.diagnostics
        self._recovery = Recovery(result, self.estimator, sequence.diagnostics)
        self._result = result

    def estimate(self, tracked: TrackedPacket) -> EstimatedFrame:
        """Estimate the state at the next frame.

        Raises:
            DivergenceError: if the estimate is lost for good.
        """
        estimator, lost = self.estimator, False
        try:
            state = self._solve(tracked)
        except DivergenceError as error:
            self._start_again(error, tracked.features.stamp_ns + self._recovery.offset_ns)
            state, lost = None, True
        tracked.clock.lap("backend", {k: 1e3 * s for k, s in estimator.report.timings.items()})
        ids, points = estimator.landmarks()
        features = tracked.features
        frame = EstimatedFrame(
            tracked.packet,
            features,
            state,
            ids,
            points,
            rejected=estimator.rejected,
            imu_noise=estimator.imu_noise,
            initialized=estimator.initialized,
            corrected_rig=estimator.corrected_rig,
            restarted=estimator.replayed is not None or lost,
            world_motion=self._recovery.world_motion,
            world_scale=self._recovery.world_scale,
            waits=not lost and estimator.solved_ns != features.stamp_ns,
            milliseconds=tracked.clock.milliseconds,
            counts=tracked.frame_stats,
            georeferenced=estimator.aiding.aligned,
            fix_offset_s=estimator.aiding.offset_s,
            fix_calibration=self._result.fix_calibration,
            imu_noise_at_limit=estimator.imu_noise_at_limit,
            rig_on_raw_clock=estimator.rig_on_raw_clock,
            clock_changes=estimator.clock_changes,
            dynamic=estimator.dynamic,
        )
        self._note(frame, tracked)
        return frame

    def finish(self) -> None:
        """Note the states of frames that waited for IMU samples which do not come.

        Raises:
            DivergenceError: if the estimate is lost for good.
        """
        try:
            self._take_last()
        except DivergenceError as error:
            self._start_again(error, self.estimator.solved_ns + self._recovery.offset_ns)
            self._take_last()
        self._result.logs.by_frame.note_times(self.estimator.times_ns)
        if self.estimator.aiding.odometry.is_unused:
            self._diagnostics.warn("odometry_unused", ODOMETRY_UNUSED)

    def _take_last(self) -> None:
        """Note what the frames that still wait lead to."""
        with _solvable("the last frames"):
            states = self.estimator.finish()
        self._take_over(states)
        self._note_fixes()

    def _start_again(self, lost: DivergenceError, noticed_ns: int) -> None:
        """Begin a new segment: the estimate is lost, as was noticed at a frame.

        Raises:
            DivergenceError: the same, if a new start has no prospect or is not wanted.
        """
        self._recovery.begin_segment(lost, noticed_ns)
        self._start = KnownStart()
        self._result.start_was_given &= len(self._result.segments) > 0
        if self.estimator.replayed is not None:
            self._note_calibration()

    def _take_over(self, states: list[NavState]) -> None:
        """Note what a frame has led to, in the place of all before if the estimate began anew.

        Raises:
            DivergenceError: if a state cannot be true, and those before it are noted; or if the
                clock of the IMU has changed.
        """
        estimator, result = self.estimator, self._result
        self._recovery.world_motion, self._recovery.world_scale = None, 1.0
        if estimator.replayed is not None:
            self._recovery.supersede(estimator.replayed)
            self._note_calibration()
            if not len(result.segments):
                result.start_was_given &= estimator.start_is_given
        for state in states:
            check_sane(state, result.config)
            self._recovery.append([state])
        if estimator.clock_change is not None and result.config.limits.recovery:
            raise DivergenceError(estimator.clock_change.message)

    def _note_calibration(self) -> None:
        """Note under which calibration the estimate has begun anew."""
        self._result.corrected_rig = self.estimator.corrected_rig

    def _note_fixes(self) -> None:
        """Note lever arm and clock of the position fixes as they are known now."""
        estimator, result = self.estimator, self._result
        result.fix_calibration = estimator.fix_calibration or result.fix_calibration
        result.fix_offset_s = estimator.aiding.offset_s

    def _start_from_known_state(self, time_ns: int) -> None:
        state = self._start.at(time_ns)
        if state is None or time_ns - state.stamp_ns > Estimator.LEAD_NS:  # as after a restart
            return
        self.estimator.start(state)
        self._result.start_was_given = True

    def _solve(self, tracked: TrackedPacket) -> NavState | None:
        """The state at the next frame, checked and noted.

        Raises:
            DivergenceError: if it cannot be true, or the images contradict it.
        """
        estimator, features = self.estimator, tracked.features
        stamp_ns = features.stamp_ns
        time_ns = stamp_ns + self._recovery.offset_ns
        if not estimator.initialized:
            self._start_from_known_state(time_ns)
        estimator.add_imu(tracked.packet.imu)
        aiding = usable_aiding(tracked.packet.aiding, self._result.input)
        if aiding is not None:
            estimator.aiding.add(aiding)
        self._recovery.check_recorded(time_ns)
        with _solvable(f"frame {stamp_ns}"):
            state = estimator.add_frame(features)
        self._take_over(estimator.states)
        self._note_fixes()
        if state is not None:
            self._recovery.agreement.check(time_ns, estimator.report.innovations)
            self._recovery.agreement.check_bridging(estimator, state)
            timed = replace(features, stamp_ns=time_ns)
            self._recovery.agreement.check_correction(estimator, timed)
        self._recovery.agreement.check_motion(estimator, features, state)
        return state

    def _note(self, frame: EstimatedFrame, tracked: TrackedPacket) -> None:
        """Note how the state was found."""
        estimator, result, logs = self.estimator, self._result, self._result.logs
        stamp_ns = frame.features.stamp_ns
        if estimator.initialized and estimator.replayed is None:
            if estimator.report.costs:
                logs.steps.append(stamp_ns, estimator.report.costs, estimator.report.columns)
            logs.innovations.append(stamp_ns, estimator.report.innovations)
        if frame.state is not None:
            points = frame.landmark_ids, frame.landmarks
            result.point_map.update(frame.state.stamp_ns, *points)
            if estimator.calibration is not None:
                logs.calibration.append(estimator.calibration)
        estimated = len(frame.landmark_ids)
        logs.by_frame.append(frame.features, estimated, estimator, tracked.frame_stats)
        logs.by_frame.note_times(estimator.times_ns)
        logs.count_frame(stamp_ns, tracked.clock.milliseconds, tracked.frame_stats)
