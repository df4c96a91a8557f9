# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Review of a start: the first seconds are solved again from the frames that follow it.

The batch problem of a start in motion over frames after it gives velocity and direction of gravity
a second time. If these contradict the estimate, the start was wrong, and the estimator goes on from
the new solution. After a start without a metre scale this waits until the scale is known.

A start from standstill is compared where its velocity became unknown before images said anything,
as with one camera that moves off slowly and whose first motion could not be solved (`take_off.py`):
a filter's one step from so far away ends beside the minimum, and is sure of it. There also a small
contradiction counts.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from slam_graph.arrays import FloatArray, IntArray, skew
from slam_graph.backend.cost.gating import threshold
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.dynamic_refinement import MAX_SCALE_SIGMA
from slam_graph.backend.initialization.initializer import Initializer
from slam_graph.backend.marginalization.marginalize import UP
from slam_graph.backend.window import Window
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame

_CONFIDENCE = 0.9999
"""Of the χ² tests. They take the two solutions as independent; both use the frames after the
start, so that they differ by less."""
_LEAST_VELOCITY, _LEAST_TILT_RAD = 0.1, np.deg2rad(2.0)
"""Smaller differences (m/s, rad) are left to the estimator. Errors of images are correlated over
frames, in a dark second for example, so that χ² alone doubts a velocity that is known to 1 mm/s."""
_GIVE_UP_NS = 5_000_000_000
"""A start whose scale is known is compared within this time or not at all."""
_KNOWN_AFTER_M = 0.5
"""A start from standstill that has come so far with a known velocity is one that images confirm."""
_UNKNOWN_VELOCITY = 0.1
"""Standard deviation of a velocity, in m/s, from which a start from standstill is reviewed."""


class StartReview:
    """Compares a start with a solution of what follows.

    Attributes:
        done: whether there is nothing left to compare.
    """

    def __init__(self, context: EngineContext, stamp_ns: int, scale_sigma: float | None) -> None:
        """Begin after a start.

        Args:
            context: shared with the engine.
            stamp_ns: time of the start, on the clock of the IMU.
            scale_sigma: relative standard deviation of its scale; None from standstill.
        """
        self.done = False
        self._begun_ns = self._doubtful_ns = stamp_ns
        self._first: NavState | None = None
        self._from_standstill = self._trusted = scale_sigma is None
        self._without_scale = scale_sigma is not None and scale_sigma > MAX_SCALE_SIGMA
        self._initializer = Initializer(context, "motion", "wait")
        self._states: dict[int, NavState] = {}  # the estimate since then, by its times
        self._diagnostics = context.diagnostics
        if scale_sigma is not None and self._without_scale:
            message = f"start with a scale that is known to {scale_sigma:.0%} only"
            self._diagnostics.warn("scale_unknown", message)

    @property
    def outliers(self) -> IntArray:
        """Ids (N,) of the features that did not fit the new solution, ascending."""
        return self._initializer.outliers

    def better(self, stamp_ns: int, frame: FeatureFrame, state: NavState) -> Window | None:
        """A window to go on from, if the start was wrong.

        Args:
            stamp_ns: time of the frame on the clock of the IMU.
            frame: its features.
            state: the estimate at the frame, with its covariance.
        """
        if self._from_standstill and _velocity_sigma(state) > _UNKNOWN_VELOCITY:
            self._trusted, self._doubtful_ns = False, stamp_ns
        if self._trusted:
            self._first = state if self._first is None else self._first
            way = state.world_T_body.translation() - self._first.world_T_body.translation()
            self.done = bool(np.linalg.norm(way) > _KNOWN_AFTER_M)
            return None
        self._states[stamp_ns] = state
        self.done = not self._without_scale and stamp_ns - self._doubtful_ns > _GIVE_UP_NS
        window = None if self.done else self._initializer.try_to_start(stamp_ns, frame)
        if window is None:
            return None
        self.done = True
        if not self._contradicts(state, window):
            return None
        # either may be a wrong minimum: what fits the frames better is right
        window = self._initializer.solved_from(self._states) or window
        if not self._contradicts(state, window):
            return None
        warn_of_correction(self._diagnostics, stamp_ns - self._begun_ns)
        return window

    def _contradicts(self, state: NavState, window: Window) -> bool:
        """Whether a window that begins at a state is another estimate of it."""
        return contradict(state, window.current(window.prior), not self._from_standstill)


def warn_of_correction(diagnostics: Diagnostics, since_ns: int) -> None:
    """Count a start that was wrong, and say how long after it that was found."""
    message = f"what follows the start contradicts it; solved again {since_ns * 1e-9:.1f} s later"
    diagnostics.warn("start_corrected", message)


def contradict(one: NavState, other: NavState, by_much: bool = True) -> bool:
    """Whether velocity or direction of gravity of two estimates differ clearly and by much.

    Both are compared in the body frame, as worlds may differ in yaw and position.

    Args:
        one: with its covariance.
        other: the same, of the same time.
        by_much: whether small differences count for nothing.
    """
    (x, P), (y, Q) = _in_body(one), _in_body(other)
    difference, S = x - y, P + Q
    across = null_space(x[None, 3:]).T  # the two directions of a tilt
    tilt, tilt_S = across @ difference[3:], across @ S[3:, 3:] @ across.T
    squares = [
        difference[:3] @ np.linalg.solve(S[:3, :3], difference[:3]),
        tilt @ np.linalg.solve(tilt_S, tilt),
    ]
    lengths = [np.linalg.norm(difference[:3]), np.linalg.norm(tilt)]
    far = np.greater(lengths, [_LEAST_VELOCITY, _LEAST_TILT_RAD]) | (not by_much)
    return bool(np.any(far & (squares > threshold(np.array([3, 2]), _CONFIDENCE))))


def _velocity_sigma(state: NavState) -> float:
    """Largest standard deviation of the velocity along an axis, m/s."""
    assert state.covariance is not None
    return float(np.sqrt(np.max(np.diag(state.covariance)[6:9])))


def _in_body(state: NavState) -> tuple[FloatArray, FloatArray]:
    """Velocity (m/s) and upward direction (6,) in the body frame, and their covariance (6, 6)."""
    assert state.covariance is not None
    body_R_world = state.world_T_body.rotation().matrix().T
    seen = np.array([state.velocity, UP]) @ body_R_world.T
    J = np.zeros((6, 15))
    J[:3, :3], J[3:, :3] = skew(seen)
    J[:3, 6:9] = body_R_world
    return np.ravel(seen), J @ state.covariance @ J.T
