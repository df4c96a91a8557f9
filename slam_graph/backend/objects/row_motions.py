# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How the platform moves while rolling shutters expose a frame, seen from any object.

The estimator of the platform knows the motion in the world (`FrameMotion`). In the frame of an
object the platform moves otherwise, by the motion of the object: poses in both frames tell the
difference of the rates over the frames around, in which what they tell badly, the accelerations of
the platform, cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.solve.state import FrameMotion


def row_motions(
    ego: EgoMotion, stamps_ns: Sequence[int], poses: Sequence[gtsam.Pose3]
) -> dict[int, FrameMotion]:
    """Motions within frames, by their numbers; none with global shutters.

    Args:
        ego: the motion of the platform in the world.
        stamps_ns: of frames.
        poses: of the platform in each, in the world or in the frame of an object.
    """
    known = [k for k, stamp in enumerate(stamps_ns) if stamp in ego.motions]
    if not known:
        return {}
    stamps = [stamps_ns[k] for k in known]
    in_world = [ego.poses[ego.stamps_ns.index(stamp)] for stamp in stamps]
    change = _rates(stamps, [poses[k] for k in known]) - _rates(stamps, in_world)
    return {
        k: replace(ego.motions[stamp], rate=ego.motions[stamp].rate + further)
        for k, stamp, further in zip(known, stamps, change, strict=True)
    }


def _rates(stamps_ns: Sequence[int], poses: Sequence[gtsam.Pose3]) -> FloatArray:
    """Angular rates and velocities (N, 6) in the body frame, over the frames around each."""
    last = len(poses) - 1
    rates = np.zeros((len(poses), 6))
    for k in range(len(poses) if last else 0):
        a, b = max(k - 1, 0), min(k + 1, last)
        step = gtsam.Pose3.Logmap(poses[a].between(poses[b]))
        rates[k] = step / ((stamps_ns[b] - stamps_ns[a]) * 1e-9)
    return rates
