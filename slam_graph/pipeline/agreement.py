# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Do the images still agree with the estimate?"""

from __future__ import annotations

from slam_graph.backend import Estimator, Innovations
from slam_graph.config import RunConfig
from slam_graph.geometry import NavState
from slam_graph.pipeline.divergence import (
    Bridging,
    Corrections,
    Disagreement,
    DivergenceError,
    JumpError,
)
from slam_graph.sensors import FeatureFrame

_MOST_UNFIT, _SOONER = 0.9, 5.0 / 6.0
"""Limit of the share of the tracks that do not fit the motion, and its interval, as a part of the
other one. Most of the tracks may be on a wall that moves; nearly all do not fit a lost state."""
_MOST_WAITING = 100
"""Frames that wait for their states, at most."""


class Agreement:
    """Whether the images still agree with the state.

    Where they contradict it for seconds, the state is wrong and its covariance too small. It cannot
    recover then: the features that would correct it are those that are rejected. Four tests tell:

    - the χ² gate rejects a few percent of the features if state and covariance are right;
    - tracks of the last second fit the poses that were reported for their frames (`TrackFit`);
    - where no track goes on, velocities are not corrected by more than the IMU allows;
    - where samples of the IMU were missing, images have told the velocity.

    Args:
        config: has the limits.
    """

    def __init__(self, config: RunConfig) -> None:
        limits = config.limits
        interval_s, share = limits.disagreement_s, limits.max_rejected_share
        self._gate = Disagreement(interval_s, share, "was rejected")
        self._motion = Disagreement(
            _SOONER * interval_s, max(share, _MOST_UNFIT), "does not fit the motion"
        )
        self._velocity = Corrections()
        self._bridging = Bridging()
        self._fit = Estimator.track_fit(config.backend)
        self._waiting: dict[int, FeatureFrame] = {}

    def check(self, stamp_ns: int, innovations: Innovations) -> None:
        """Add what the gate did with the features of the next frame.

        Raises:
            DivergenceError: if too much was rejected for too long.
        """
        self._gate.check(stamp_ns, innovations.tested, innovations.rejected)

    def check_bridging(self, estimator: Estimator, state: NavState) -> None:
        """Add the state of a frame, where an IMU measures the motion.

        Raises:
            DivergenceError: if the velocity is not known after a time without samples.
        """
        if estimator.rig.has_imu:
            self._bridging.check(state, estimator.misses_imu)

    def check_correction(self, estimator: Estimator, frame: FeatureFrame) -> None:
        """Add how the last step corrected the velocity, where an IMU measures it.

        Not while the start is reviewed, whose velocity may be wrong.

        Args:
            estimator: the back end, which has taken the frame.
            frame: its features, at its time on the clock of the states.

        Raises:
            DivergenceError: if velocities were corrected by too much for too long.
        """
        self._velocity.note(frame)
        correction = estimator.report.correction
        known = estimator.rig.has_imu and not estimator.start_is_doubtful
        if known and correction is not None:
            self._velocity.check(frame.stamp_ns, correction.square, correction.expected)

    def check_motion(
        self, estimator: Estimator, frame: FeatureFrame, state: NavState | None
    ) -> None:
        """Compare the tracks of a frame with the motion, where an IMU measures it.

        Without one the state between two images is a guess, and a fast turn may differ from it.

        Args:
            estimator: the back end, which has taken the frame.
            frame: its features.
            state: what the estimator gave for it, or for an earlier frame that has waited.

        Raises:
            DivergenceError: if too many do not fit for too long.
            JumpError: if the platform was put somewhere else.
        """
        if not estimator.rig.has_imu:
            return
        self._waiting[frame.stamp_ns] = frame
        while len(self._waiting) > _MOST_WAITING:
            self._waiting.pop(next(iter(self._waiting)))
        solved = self._waiting.pop(estimator.solved_ns, None)
        if state is None or solved is None:
            return
        known = estimator.rig_now, estimator.assumed_noise_px, estimator.dynamic
        predicted = estimator.predicted if solved is frame else None
        aided = estimator.aiding.aligned
        found = self._fit.add(state, solved, *known, estimator.motion, predicted, aided)
        if found is None:
            return
        revised = estimator.aiding.was_revised(state.stamp_ns)
        if estimator.start_is_doubtful or revised or not found.telling:
            self._motion.untested(state.stamp_ns)
            return
        self._motion.check(state.stamp_ns, found.tested, found.unfit)
        if found.jumped:
            raise JumpError(
                f"lost at frame {state.stamp_ns}: the tracks fit the motion before and after a "
                "jump, and not across it"
            )
        if found.lost:
            raise DivergenceError(
                f"diverged at frame {state.stamp_ns}: images contradict the state, at once no "
                "track fits the motion any more"
            )

    def agreed_until(self) -> int | None:
        """Time of the last frame before the images contradicted the state; None if they always did.

        The earliest of what the tests say.
        """
        tests = self._gate, self._motion, self._velocity, self._bridging
        agreed = [test.agreed_until() for test in tests if len(test)]
        known = [stamp_ns for stamp_ns in agreed if stamp_ns is not None]
        return min(known) if agreed and len(known) == len(agreed) else None
