# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the search for moving objects found in one frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.objects.object_state import ObjectState


def _no_ids() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class ObjectDirection:
    """The line of sight from one camera to a moving object, whose distance is not known.

    Attributes:
        stamp_ns: time of the frame, on the clock of the cameras.
        number: of the object.
        direction: (3,) unit vector in the world, the mean of its tracks.
        rate: (3,) rad/s, its change over the last frames, axes of the world: by the motion of the
            object and that of the platform.
        sigma: standard deviation of the direction, rad, by the noise of the images.
        rate_sigma: the same of the rate, rad/s.
        points: number of its tracks.
    """

    stamp_ns: int
    number: int
    direction: FloatArray
    rate: FloatArray
    sigma: float
    rate_sigma: float
    points: int

    def moved(self, motion: gtsam.Pose3) -> ObjectDirection:
        """The same in a world that is moved by `new_T_old`."""
        R = motion.rotation().matrix()
        return replace(self, direction=R @ self.direction, rate=R @ self.rate)


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """What became of the tracks of one frame.

    Attributes:
        states: of the objects that are seen.
        moving: ids (N,) of the features that must not count as static, ascending.
        static: ids (N,) of the features that are known to be static, ascending.
        wrong: ids (N,) of features that are neither.
        probabilities: ids (J,) and the probability (J,) that each moves by itself.
        members: number of the object by feature.
        clouds: (K, 3) points of each object in the world, by its number.
        hulls: number of each object and the (K, 2) polygon around its tracks, pixels of the first
            camera; with the number 0 around tracks that move and are of no object yet.
        directions: of what moves before a single camera, in place of states.
    """

    states: list[ObjectState] = field(default_factory=list)
    moving: IntArray = field(default_factory=_no_ids)
    static: IntArray = field(default_factory=_no_ids)
    wrong: IntArray = field(default_factory=_no_ids)
    probabilities: tuple[IntArray, FloatArray] = field(
        default_factory=lambda: (_no_ids(), np.zeros(0))
    )
    members: dict[int, int] = field(default_factory=dict)
    clouds: dict[int, FloatArray] = field(default_factory=dict)
    hulls: list[tuple[int, FloatArray]] = field(default_factory=list)
    directions: list[ObjectDirection] = field(default_factory=list)
