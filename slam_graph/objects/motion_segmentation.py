# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which of the tracks that move, move together: one rigid motion after the other, by RANSAC.

Points that two cameras (or a depth sensor) saw in an earlier frame are at known places relative to
the platform. Those of one object are seen now from one and the same pose: PnP on samples of four,
the largest set that fits is an object, and the rest is searched again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.visual_motion import depths_within
from slam_graph.sensors import FeatureFrame, Rig

_MAX_GROUPS = 8
"""Most objects that begin in one frame."""


def rigid_groups(
    ids: IntArray, frames: Sequence[FeatureFrame], rig: Rig, min_points: int, error_px: float
) -> list[IntArray]:
    """Groups of tracks that move rigidly, the largest first.

    Args:
        ids: (N,) of the tracks, ascending.
        frames: the last ones, in the order of time.
        rig: its first camera is looked through.
        min_points: fewest tracks of a group.
        error_px: largest error of a track that fits.

    Returns:
        Their ids, ascending.
    """
    groups: list[IntArray] = []
    rest, now = ids, frames[-1].cameras[0]
    for frame in list(frames)[:-1]:
        while len(rest) >= min_points and len(groups) < _MAX_GROUPS:
            known, points = depths_within(frame.only(rest), rig)
            rows = np.flatnonzero(np.isin(known, now.ids))
            if len(rows) < min_points:
                break
            known, points = known[rows], points[rows]
            order = np.argsort(now.ids)
            seen = now.normalized[order][np.searchsorted(now.ids[order], known)]
            found = rig.cameras[0].body_pose(points, seen, error_px, min_points)
            if found is None or np.count_nonzero(found[1]) < min_points:
                break
            group = np.sort(known[found[1]])
            groups.append(group)
            rest = np.setdiff1d(rest, group, assume_unique=True)
    return groups
