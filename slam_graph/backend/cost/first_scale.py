# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""When the images of one camera are used first: once it is known how far the camera has moved.

One camera sees directions. How far away its features are follows from how far it has moved, and
that is known by the IMU alone as long as no feature is a variable. If the way is shorter than its
standard deviation, as in a hover after a start from a given state, no estimate of it is near enough
to linearise the images there: they would make the filter sure of a scale that nothing has shown.
The first motion solves it for all frames together (`initialization/take_off.py`); until then the
IMU leads alone.
"""

from __future__ import annotations

import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window

_LARGEST_SIGMA = 1.0
"""Largest standard deviation of the way from the oldest pose to the current one, relative to it:
beyond it not even its direction is known. With 0.3 a slow take-off (V2_01) loses 18 mm more, as the
IMU leads alone for longer than it must; with 2 a hover (room1) goes wrong as without this."""
_LONGEST_NS = 15_000_000_000
"""How long images are left out at most: as long as the first motion is waited for."""


class FirstScale:
    """Whether one camera has begun to know distances; once it has, it is not asked again."""

    def __init__(self, known: bool) -> None:
        """Begin with the first window.

        Args:
            known: whether there is nothing to wait for, as with two cameras or without an IMU.
        """
        self._known = known
        self._begun_ns: int | None = None

    def known(self, window: Window, state: State, predicted: SquareRootInformation) -> bool:
        """Whether the images of the current frame are used.

        Args:
            window: with the current frame.
            state: estimates at the current frame.
            predicted: what is known of them without its images.
        """
        if self._known or len(window.state_features) or not window.past:
            self._known |= len(window.state_features) > 0
            return True
        self._begun_ns = self._begun_ns or window.stamp_ns
        late = window.stamp_ns - self._begun_ns > _LONGEST_NS
        self._known = late or _way_is_known(window, state, predicted)
        return self._known


def _way_is_known(window: Window, state: State, predicted: SquareRootInformation) -> bool:
    """Whether the standard deviation of the way is small beside it."""
    ends = [window.past[0], window.frame]
    rotations, (begin, end) = state.poses(ends)
    J = np.hstack([np.zeros((3, 3)), -rotations[0], np.zeros((3, 3)), rotations[1]])
    covariance = J @ predicted.covariance_of([X(i) for i in ends]) @ J.T
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    return bool(sigma < _LARGEST_SIGMA * np.linalg.norm(end - begin))
