# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The first motion of one camera after a standstill or a given state, solved again as a batch.

A camera that stands still, or hovers, knows no distances. In the first motion scale and depths
become known together, beginning far from where they end, and a filter linearises each frame only
once: at a scale that is a fifth off it becomes sure of a wrong one. So all states since the
standstill are solved again together as soon as that determines the scale, and the estimator goes on
from there. The world stays the same, and so do the states before if the solution does not
contradict them.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.dynamic_refinement import DynamicRefinement
from slam_graph.backend.initialization.dynamic_start import StartFrames, StartGuess
from slam_graph.backend.initialization.initializer import RETRY_S
from slam_graph.backend.initialization.start_diagnosis import MIN_FEATURES, Refusal
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame

_SHORTEST_S, _LONGEST_S = 1.0, 5.0
"""How long after the standstill the motion is solved at the earliest, and at the latest."""
LONGEST_HOVER_S = 15.0
"""The latest after a given state. A hand that holds a camera still moves it by 20 mm, which is no
standstill, for five seconds and more."""
_KNOWN_SPEED = 0.1
"""A velocity with a smaller standard deviation, relative to it, tells the scale by itself."""
_MAX_SCALE_SIGMA = 0.02
"""Largest standard deviation of the scale with which the estimator goes on, relative to it."""
_HOPELESS_FACTOR = 1.5
"""A motion is not solved where the filter's estimates show the scale so many times less well than
that: of 24 solutions with which the estimator went on (`random`, `figure8`, V1_02, V2_01,
under `msckf` and `okvis`) none had more than 1.01 times that before it."""
_FASTEST_GAIN = 4.0
"""The standard deviation of the scale is taken to fall at most with this power of the time since
the standstill: the way grows with its square under a constant acceleration, and the directions to
the features change with the way. On good flights it was 2 to 3.4 (five pairs of attempts). Motion
that begins later lets it fall faster; its solution then comes later, by up to the wait."""
_MOST_FRAMES, _DENSE_NS = 40, 5_000_000_000
"""About the most frames of the batch problem within so long a time before its last one; where there
are more, not all are used."""
_KEPT_NS = 9_000_000_000
"""How long before its last frame the batch problem may begin: IMU samples are kept for longer."""
_SPARSE_S = 1.0
"""Time between its frames before that, when the platform did little but hover."""
_RETRY_SHARE = 0.05
"""Least time between two attempts, relative to that since the standstill."""
_MIN_FRAMES = 3
"""Features that fewer of them see are not used."""


class TakeOff:
    """Collects the states and frames since the last standstill, and solves them again.

    Where no standstill is detected after the start, since the start. They go back for nine seconds
    at most; where the start is longer ago, the first of these states is the prior, without images
    of its own, which it knows.

    Attributes:
        done: whether the motion has been solved, or has taken too long.
    """

    def __init__(self, context: EngineContext, given: bool = False) -> None:
        """Begin at rest, or with a state that is given.

        Args:
            context: shared with the engine.
            given: whether the start was given: it may hover for long, and be far off by then.
        """
        self.done = False
        self._longest_ns = round(1e9 * (LONGEST_HOVER_S if given else _LONGEST_S))
        # the noise is that of the engine, which has learned some of it if images were used
        self._refinement = DynamicRefinement(
            context,
            _MAX_SCALE_SIGMA,
            white_noise_factor=1.0,
            hopeless=_HOPELESS_FACTOR,
            patient=given,
        )
        self._states: list[NavState] = []
        self._frames: list[FeatureFrame] = []
        self._begun_ns = self._next_ns = 0

    @property
    def outliers(self) -> IntArray:
        """Ids (N,) of the features that did not fit the solution, ascending."""
        return self._refinement.outliers

    @property
    def elapsed_ns(self) -> int:
        """Time since the standstill."""
        return self._states[-1].stamp_ns - self._begun_ns

    def solved(
        self, frame: FeatureFrame, dynamic: IntArray, state: NavState, still: bool
    ) -> Window | None:
        """The window to go on from, once the motion since the standstill tells the scale.

        Args:
            frame: features of the current frame.
            dynamic: ids (N,) of features that are known to move, ascending.
            state: the estimate then, with its covariance.
            still: whether the platform stands still.
        """
        if still or not self._states:
            self._states, self._frames = [], []
            self._begun_ns = state.stamp_ns
            self._next_ns = state.stamp_ns + round(_SHORTEST_S * 1e9)
        self._states.append(state)
        self._frames.append(frame)
        while state.stamp_ns - self._states[0].stamp_ns > _KEPT_NS:
            del self._states[0], self._frames[0]
        self.done = self.elapsed_ns > self._longest_ns
        few = len(frame.without(dynamic).cameras[0]) < MIN_FEATURES
        if self.done or few or state.stamp_ns < self._next_ns:
            return None
        window = self._solution(dynamic)
        missing = self._refinement.scale_sigma / _MAX_SCALE_SIGMA
        self._next_ns = state.stamp_ns + round(retry_s(self.elapsed_ns * 1e-9, missing) * 1e9)
        self.done = window is not None
        return window

    def _solution(self, dynamic: IntArray) -> Window | None:
        """The window that begins with the last frame; None if the scale is not known yet."""
        static = [frame.without(dynamic) for frame in self._frames]
        if self._states[0].stamp_ns > self._begun_ns:  # the first state knows its own images
            static[0] = static[0].without(static[0].ids)
        frames = self._thinned(static)
        chosen = set(frames.stamps_ns)
        states = [state for state in self._states if state.stamp_ns in chosen]
        ids, lengths = frames.tracks.lengths()
        guess = StartGuess(states, ids[lengths >= _MIN_FRAMES])
        found = self._refinement.refine(frames, guess, first=states[0])
        return None if isinstance(found, Refusal) else found

    def _thinned(self, static: list[FeatureFrame]) -> StartFrames:
        """The first and the last of the frames, and some between.

        Args:
            static: all frames, without what is known to move.
        """
        stamps_ns = [state.stamp_ns for state in self._states]
        dense_ns = min(self.elapsed_ns, _DENSE_NS)
        dense = bisect_left(stamps_ns, stamps_ns[-1] - dense_ns)
        spacing_s = dense_ns * 1e-9 / _MOST_FRAMES
        last = StartFrames.thinned(stamps_ns[dense:], static[dense:], spacing_s)
        before = StartFrames.thinned(stamps_ns[:dense], static[:dense], _SPARSE_S)
        thinned_ns = before.stamps_ns + last.stamps_ns
        thinned = before.frames + last.frames
        if thinned_ns[0] == stamps_ns[0]:
            return StartFrames(thinned_ns, thinned)
        return StartFrames([stamps_ns[0], *thinned_ns], [static[0], *thinned])


def tells_scale(state: NavState) -> bool:
    """Whether a state moves with a velocity that is known well enough to tell the scale.

    Args:
        state: with its covariance.
    """
    assert state.covariance is not None
    sigma = np.sqrt(np.max(np.diag(state.covariance)[6:9]))
    return bool(sigma < _KNOWN_SPEED * np.linalg.norm(state.velocity))


def retry_s(elapsed_s: float, missing: float) -> float:
    """Time from an attempt to the next, in seconds.

    Args:
        elapsed_s: time since the standstill.
        missing: how many times too large the standard deviation of the scale was; infinite if the
            attempt did not come so far.
    """
    least_s = max(RETRY_S, _RETRY_SHARE * elapsed_s)
    if not math.isfinite(missing):
        return least_s
    grown = math.pow(missing, 1.0 / _FASTEST_GAIN)
    return max(RETRY_S * (elapsed_s * (grown - 1.0) // RETRY_S), least_s)
