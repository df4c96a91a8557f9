# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""When the images of one camera are used first after a given state: once its way is known.

One camera sees directions. How far away its features are follows from how far it has moved, and as
long as no feature is a variable, images do not tell that. If the way is shorter than its standard
deviation, as in a hover, no estimate of it is near enough to linearise the images there: they would
make the filter sure of a scale that nothing has shown. The first motion solves it for all frames
together (`initialization/take_off.py`); until then the IMU leads alone.
"""

from __future__ import annotations

import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import State
from slam_graph.backend.window import Window

_LARGEST_SIGMA = 1.0
"""Largest standard deviation of the way from the oldest pose to the current one, relative to it:
beyond it not even its direction is known. With 2 a hover (room1) goes wrong as without this; with
0.3 a slow take-off from rest (V2_01) would lose 18 mm, as the IMU would lead alone for longer than
it must."""


def images_wait(window: Window, state: State, predicted: SquareRootInformation) -> bool:
    """Whether the images of the current frame are left out.

    Args:
        window: with the current frame, and how long images wait at most.
        state: estimates at the current frame.
        predicted: what is known of them without its images.
    """
    until_ns = window.images_wait_until_ns
    if until_ns is None or window.stamp_ns >= until_ns:
        return False
    return not _way_is_known(window, state, predicted)


def _way_is_known(window: Window, state: State, predicted: SquareRootInformation) -> bool:
    """Whether the way of the body is longer than its standard deviation."""
    ends = [window.past[0], window.frame]
    rotations, (begin, end) = state.poses(ends)
    J = np.hstack([np.zeros((3, 3)), -rotations[0], np.zeros((3, 3)), rotations[1]])
    covariance = J @ predicted.covariance_of([X(i) for i in ends]) @ J.T
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    return bool(sigma < _LARGEST_SIGMA * np.linalg.norm(end - begin))
