# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Estimation: the back end at work on one frame after the other, under supervision."""

from __future__ import annotations

import numpy as np

from slam_graph.backend import Estimator
from slam_graph.datasets import Sequence
from slam_graph.geometry import NavState
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.pipeline.start import KnownStart
from slam_graph.pipeline.supervision import Agreement, DivergenceError, check_sane
from slam_graph.pipeline.tracking import TrackedPacket
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame


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
        self._agreement = Agreement(config.limits)
        self._result = result

    def estimate(self, tracked: TrackedPacket) -> EstimatedFrame:
        """Estimate the state at the next frame.

        Raises:
            DivergenceError: if the state cannot be true.
        """
        estimator, features = self.estimator, tracked.features
        if not estimator.initialized:
            self._start_from_known_state(tracked.packet.frame.stamp_ns)
        estimator.add_imu(tracked.packet.imu)
        state = self._solve(features)
        tracked.clock.lap("backend", {k: 1e3 * s for k, s in estimator.timings.items()})
        ids, points = estimator.landmarks()
        frame = EstimatedFrame(
            tracked.packet,
            features,
            state,
            ids,
            points,
            estimator.rejected,
            estimator.imu_noise,
            estimator.initialized,
        )
        self._note(frame, tracked)
        return frame

    def _start_from_known_state(self, stamp_ns: int) -> None:
        state = self._start.at(stamp_ns)
        if state is not None:
            self.estimator.start(state)
            self._result.start_was_given = True

    def _solve(self, features: FeatureFrame) -> NavState | None:
        """The state at a frame. A singular system means divergence: sane states do not cause one.

        Raises:
            DivergenceError: if the linear algebra fails.
        """
        try:
            return self.estimator.add_frame(features)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            reason = " ".join(str(error).split())[:200]
            raise DivergenceError(
                f"diverged at frame {features.stamp_ns}: the equations cannot be solved ({reason})"
            ) from error

    def _note(self, frame: EstimatedFrame, tracked: TrackedPacket) -> None:
        """Check the state, and note it with how it was found.

        Raises:
            DivergenceError: if it cannot be true.
        """
        estimator, result, logs = self.estimator, self._result, self._result.logs
        stamp_ns = frame.features.stamp_ns
        if estimator.costs:
            logs.steps.append(stamp_ns, estimator.costs, estimator.columns)
        logs.innovations.append(stamp_ns, estimator.innovations)
        if frame.state is not None:
            check_sane(frame.state, result.config.limits)
            self._agreement.check(stamp_ns, estimator.innovations)
            result.history.append(frame.state)
            result.point_map.update(frame.landmark_ids, frame.landmarks)
            if estimator.calibration is not None:
                logs.calibration.append(estimator.calibration)
        logs.count_frame(stamp_ns, tracked.clock.milliseconds, tracked.frame_stats)
