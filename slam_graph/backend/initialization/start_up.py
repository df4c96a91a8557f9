# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The start of an estimator: its first window, the review of it, and its place after a loss."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import IntArray, ascending_union
from slam_graph.backend.cost.track_fit import COMPARED_NS
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.initializer import Initializer
from slam_graph.backend.initialization.monocular_start import MonocularStart
from slam_graph.backend.initialization.segment_joint import SegmentJoint, place
from slam_graph.backend.initialization.start_review import (
    StartReview,
    contradict,
    warn_of_correction,
)
from slam_graph.backend.initialization.take_off import LONGEST_HOVER_S, TakeOff, tells_scale
from slam_graph.backend.initialization.visual_start import VisualStart
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame


class StartUp:
    """Tries to start at every frame, with an IMU or without, and looks at the start again.

    Attributes:
        outliers: ids (N,) of the features that did not fit the last start, ascending.
        joint: how the start continues a segment before; None in the first.
        doubtful: whether the start may still be corrected, or has just been.
        contradicted: whether the last new window contradicts the states before.
    """

    def __init__(
        self, context: EngineContext, mode: str, before: NavState | None, measured: bool = True
    ) -> None:
        """Begin without frames.

        Args:
            context: shared with the engine.
            mode: which starts are tried, as in `initialization.mode`.
            before: last good state of the segment before; None in the first.
            measured: whether the IMU has measured what happened since.
        """
        self.outliers: IntArray = np.zeros(0, np.int64)
        self.joint: SegmentJoint | None = None
        self.doubtful = self.contradicted = False
        self._context, self._before, self._measured = context, before, measured
        self._inertial = Initializer(context, mode) if context.rig.has_imu else None
        alone = len(context.rig.cameras) == 1
        self._visual = MonocularStart(context) if alone else VisualStart(context)
        self._review: StartReview | None = None
        self._take_off: TakeOff | None = None
        self._corrected_ns: int | None = None

    def try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """The first window, if this frame makes a start possible.

        Args:
            stamp_ns: time of the frame on the clock of the IMU.
            frame: its features.
        """
        search = self._inertial or self._visual
        window = search.try_to_start(stamp_ns, frame)
        if window is None:
            return None
        self.outliers = search.outliers
        if self._inertial is not None:
            scale_sigma = self._inertial.scale_sigma
            self._review = StartReview(self._context, stamp_ns, scale_sigma)
            self.doubtful = True
            if scale_sigma is None and self._finds_scale:
                self._take_off = TakeOff(self._context)
        window = self._placed(window)
        if search.leaves_frame:
            self._context.add_observations(window, frame)
        return window

    def better(
        self, frame: FeatureFrame, dynamic: IntArray, state: NavState, still: bool
    ) -> Window | None:
        """A new window, if what followed a start tells more of it, or contradicts it.

        Args:
            frame: features of the current frame.
            dynamic: ids (N,) of those that are known to move, ascending.
            state: the estimate then, on the clock of the IMU.
            still: whether the platform stands still.
        """
        self.contradicted, window = False, None
        if self._take_off is not None:
            window = self._first_motion(self._take_off, frame, dynamic, state, still)
        elif self._review is not None:
            window = self._reviewed(self._review, frame, state)
        if window is not None and not self.contradicted:
            # what compares frames with the states before must not do so across the new window
            self._corrected_ns = state.stamp_ns
        waiting = self._take_off is not None or self._review is not None
        corrected_ns = self._corrected_ns
        recent = corrected_ns is not None and state.stamp_ns - corrected_ns <= COMPARED_NS
        self.doubtful = waiting or recent
        return window

    def _first_motion(
        self,
        take_off: TakeOff,
        frame: FeatureFrame,
        dynamic: IntArray,
        state: NavState,
        still: bool,
    ) -> Window | None:
        """A new window in the same world, once the first motion after a standstill is solved."""
        window = take_off.solved(frame, dynamic, state, still)
        if window is not None:
            self._review = None
            self.outliers = ascending_union(dynamic, take_off.outliers)
            self.contradicted = contradict(state, window.current(window.prior), by_much=False)
            if self.contradicted:
                warn_of_correction(self._context.diagnostics, take_off.elapsed_ns)
        if take_off.done:
            self._take_off = None
        return window

    def _reviewed(self, review: StartReview, frame: FeatureFrame, state: NavState) -> Window | None:
        """A new window in another world, if what followed the start contradicts it."""
        window = review.better(state.stamp_ns, frame, state)
        if review.done:
            self._review = None
        if window is None:
            return None
        self.outliers, self.contradicted = review.outliers, True
        return self._placed(window)

    def begin_with(self, given: NavState, window: Window) -> None:
        """Begin with a state that is given.

        Args:
            given: with its covariance.
            window: that begins with it; images wait there if one camera must find its scale first.
        """
        self.trust()
        if self._inertial is None or not self._finds_scale or tells_scale(given):
            return
        self._take_off, self.doubtful = TakeOff(self._context, given=True), True
        window.images_wait_until_ns = given.stamp_ns + round(LONGEST_HOVER_S * 1e9)

    @property
    def _finds_scale(self) -> bool:
        """Whether one camera finds its scale in the first motion, linearising each frame once."""
        alone, engine = len(self._context.rig.cameras) == 1, self._context.algorithm.engine
        return alone and engine == "square_root"

    def trust(self) -> None:
        """Nothing of the start is in doubt any more."""
        self.doubtful, self._review, self._take_off = False, None, None

    def settle(self) -> None:
        """The place of the segment is measured."""
        self.trust()
        self.joint = None if self.joint is None else self.joint.superseded()

    def waiting_for(self, calibration: str | None) -> str:
        """What a start still needs, and the likeliest cause of the lack.

        Args:
            calibration: what contradicts the calibration, if something does.
        """
        if self._inertial is None:
            return self._visual.waiting_for()
        return self._inertial.waiting_for(calibration)

    def _placed(self, window: Window) -> Window:
        """A window that has just begun, in the world of the segment before if there is one."""
        if self._before is not None:
            window, self.joint = place(window, self._before, self._context, self._measured)
        return window
