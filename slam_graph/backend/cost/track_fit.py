# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether tracks fit the motion that was estimated meanwhile, whatever the cost made of them.

The χ² gate tests what an algorithm lets into its cost, which differs: features of the state, whole
tracks once, or every observation of a window. After a jump a window takes new features for those
that jumped, leaves out what it cannot triangulate, and rejects little of the rest. So here all
tracks of the last second are triangulated from the poses that were reported meanwhile. Where these
are right the reprojection errors have the size of the noise; no covariance of a wrong state and no
choice of features can hide that they are not.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig

_SPAN_NS, _STEP_NS = 1_000_000_000, 250_000_000
"""Frames of the last second count, and of those only some: errors of a track change slowly."""
_LEAST_FRAMES = 3
"""A track of fewer frames fits most motions."""
_LARGEST = 2.0
"""Largest reprojection error of a track that fits, in standard deviations of the observations.
Reported poses are causal: over a second they are off by a good part of that noise themselves."""
_UNEVEN_NS = 5_000_000
"""Frames come earlier or later by up to so much."""
_POINT_DIM = 3


class TrackFit:
    """Compares tracks with the poses that were reported for their frames."""

    def __init__(self) -> None:
        self._tracks = FeatureTracks()
        self._poses: deque[tuple[int, int, FloatArray, FloatArray]] = deque()
        self._count = 0

    def add(
        self, state: NavState, frame: FeatureFrame, rig: Rig, sigma_px: float, moving: IntArray
    ) -> tuple[int, int] | None:
        """Take the next frame.

        Args:
            state: reported for it.
            frame: its features.
            rig: the cameras, as they are known now.
            sigma_px: standard deviation of the observations.
            moving: ids (N,) of features that move by themselves, ascending.

        Returns:
            How many tracks were compared, and how many of them do not fit; None if it is too early
            for the next comparison.
        """
        if self._poses and state.stamp_ns < self._poses[-1][0] + _STEP_NS - _UNEVEN_NS:
            return None
        T = state.world_T_body
        self._poses.append((state.stamp_ns, self._count, T.rotation().matrix(), T.translation()))
        self._tracks.add(self._count, frame)
        self._count += 1
        while self._poses[0][0] < state.stamp_ns - _SPAN_NS - _UNEVEN_NS:
            self._poses.popleft()
        _, indices, rotations, positions = zip(*self._poses, strict=True)
        self._tracks.keep_frames(indices)
        ids, lengths = self._tracks.lengths()
        ids = ids[(lengths >= _LEAST_FRAMES) & is_in(ids, self._tracks.seen)]
        ids = ids[~is_in(ids, moving)]
        if len(ids) == 0:
            return 0, 0
        obs = self._tracks.observations(ids)
        used = [indices.index(index) for index in obs.frames]
        R, p = np.array(rotations)[used], np.array(positions)[used]
        found = triangulate(obs, RigProjection(rig), R, p, TriangulationConfig())
        dof = 2 * obs.counts - _POINT_DIM
        scaled = found.reprojection_px * np.sqrt(obs.counts / dof) / sigma_px
        return len(ids), int(np.count_nonzero(~(scaled < _LARGEST)))
