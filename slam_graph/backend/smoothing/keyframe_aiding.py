# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and odometry between the keyframes of a segment of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.aiding.fix_factors import antenna_path, fix_factor, pose_key
from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.aiding.world_alignment import MIN_FIXES
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.geometry import Trajectory
from slam_graph.sensors import AidingData


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAiding:
    """Factors on keyframes.

    Attributes:
        fixes: of the position; they determine the world of the segment.
        odometry: between consecutive keyframes.
        source: what they were made of; None for nothing.
    """

    fixes: tuple[gtsam.NonlinearFactor, ...] = ()
    odometry: tuple[gtsam.NonlinearFactor, ...] = ()
    source: tuple[AidingData, Trajectory, BackendConfig] | None = None

    def at(self, stamps_ns: IntArray) -> KeyframeAiding:
        """The same on some of the keyframes, by their times (K,)."""
        return self if self.source is None else aiding_of_keyframes(stamps_ns, *self.source)


def aiding_of_keyframes(
    stamps_ns: IntArray, data: AidingData, causal: Trajectory, config: BackendConfig
) -> KeyframeAiding:
    """The factors of fixes and odometry.

    A fix counts at the nearest keyframe, moved there by the causal estimate. With too few fixes
    for a world there are none.

    Args:
        stamps_ns: (K,) of the keyframes.
        data: of the recording; fixes only if the causal estimate is in their world.
        causal: the causal estimate.
        config: lever arm, time offset, noise.
    """
    if not len(data):
        return KeyframeAiding()
    source = data, causal, config
    odometry: list[gtsam.NonlinearFactor] = []
    for k, ends in enumerate(pairwise(stamps_ns.tolist())):
        moved = data.odometry_between(*ends) if config.odometry.enabled else None
        if moved is not None:
            odometry.append(odometry_factor((k, k + 1), moved, config.odometry))
    arm = np.array(config.gnss.lever_arm_m)
    near = data.shifted(round(config.gnss.time_offset_s * 1e9))
    near = near.within(int(stamps_ns[0]), int(stamps_ns[-1]))
    if not config.gnss.enabled or len(near.fix_stamps_ns) < MIN_FIXES:
        return KeyframeAiding((), tuple(odometry), source)
    middles = stamps_ns[:-1] + np.diff(stamps_ns) // 2
    keyframes = np.searchsorted(middles, near.fix_stamps_ns)
    then, known = antenna_path(causal, near.fix_stamps_ns, arm)
    at, also = antenna_path(causal, stamps_ns, arm)
    used = np.flatnonzero(known & also[keyframes])
    fixes = [
        fix_factor(
            pose_key(int(keyframes[n])),
            near.fix_positions[n] + at[keyframes[n]] - then[n],
            near.fix_covariances[n],
            arm,
            robust=True,
        )
        for n in used
    ]
    enough = len(fixes) >= MIN_FIXES
    return KeyframeAiding(tuple(fixes) if enough else (), tuple(odometry), source)
