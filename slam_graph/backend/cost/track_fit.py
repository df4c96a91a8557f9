# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether tracks fit the motion that was estimated meanwhile, whatever the cost made of them.

The χ² gate tests what an algorithm lets into its cost, which differs: features of the state, whole
tracks once, or every observation of a window. After a jump a window takes new features for those
that jumped, leaves out what it cannot triangulate, and rejects little of the rest. So here all
tracks of the last second are triangulated from the poses that were reported meanwhile. Where these
are right the reprojection errors have the size of the noise; no covariance of a wrong state and no
choice of features can hide that they are not.

A platform that is put somewhere else moves on there as the IMU says, if it is at rest or its
velocity and tilt are the same. Then tracks fit before and after, and none fits across. An estimate
that corrects itself jumps in the same way, so it is no jump if tracks fit across it by the motion
that the IMU measures from each frame to the next, which has no corrections.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig

COMPARED_NS, _STEP_NS = 1_000_000_000, 250_000_000
"""Frames of the last second count, and of those only some: errors of a track change slowly."""
_LEAST_FRAMES = 3
"""A track of fewer frames fits most motions."""
_LARGEST = 2.0
"""Largest reprojection error of a track that fits, in standard deviations of the observations.
Reported poses are causal: over a second they are off by a good part of that noise themselves."""
_UNEVEN_NS = 5_000_000
"""Frames come earlier or later by up to so much."""
_POINT_DIM = 3
_THRESHOLDS = TriangulationConfig()
_GOOD_SHARE, _JUMPED_SHARE, _JUMPED = 0.3, 0.8, 20
"""At a jump the share that does not fit was at most the first before; then at least the second does
not fit across it, and fits after it; of so many tracks."""
_LOST_SHARE, _FAR, _LOST = 0.95, 6.0, 2
"""The state is lost where at least this share does not fit, most of them by so many standard
deviations, so many times in a row, right after a time at which tracks fitted: a body that moves and
comes into view covers the image gradually, and an estimate that corrects its scale bends the poses
of a second by a few. It is said when a jump could be told from it, whose way nothing has
measured."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How tracks compare with the motion.

    Attributes:
        tested: how many tracks were compared.
        unfit: how many of them do not fit.
        jumped: whether the platform was put somewhere else three comparisons ago.
        lost: whether tracks fitted three comparisons ago, and at once nearly none did any more.
        telling: whether tracks have fitted before, with noise of the size that was expected.
    """

    tested: int
    unfit: int
    jumped: bool
    lost: bool
    telling: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """The pose that was reported for a frame of the window.

    Attributes:
        stamp_ns: time of the frame.
        index: of the frame.
        reported: rotation (3, 3) and position (3,) of `world_T_body`.
        carried: the same by chained predictions of the IMU, without the estimator's corrections, in
            the frame of the first body.
        motion: of the body within the frame.
    """

    stamp_ns: int
    index: int
    reported: tuple[FloatArray, FloatArray]
    carried: tuple[FloatArray, FloatArray]
    motion: FrameMotion | None


class TrackFit:
    """Compares tracks with the poses that were reported for their frames.

    Args:
        usual_px: standard deviation of the observations by the settings. Where they showed a larger
            one while tracks fitted, such as under a wrong calibration, the estimate itself may
            jump and be off, and that tracks do not fit says nothing.
    """

    def __init__(self, usual_px: float) -> None:
        self._usual_px = usual_px
        self._tracks = FeatureTracks()
        self._poses: deque[_Pose] = deque()
        self._count = 0
        self._good: int | None = None  # the last frame that was good
        self._bad = 0  # in how many frames right after it nearly no track fitted
        self._telling = False
        self._latest: gtsam.Pose3 | None = None
        self._carried = gtsam.Pose3()

    def add(
        self,
        state: NavState,
        frame: FeatureFrame,
        rig: Rig,
        sigma_px: float,
        moving: IntArray,
        motion: FrameMotion | None = None,
        predicted: gtsam.Pose3 | None = None,
        aided: bool = False,
    ) -> Fit | None:
        """Take the next frame.

        Args:
            state: reported for it.
            frame: its features.
            rig: the cameras, as they are known now.
            sigma_px: standard deviation of the observations.
            moving: ids (N,) of features that move by themselves, ascending.
            motion: of the body within the frame, for rolling shutters.
            predicted: `world_T_body` of this frame, predicted by the IMU from the pose reported for
                the frame before; None where that is not known.
            aided: whether fixes correct the poses, by more than tracks allow: those that fit the
                poses without the corrections fit as well.

        Returns:
            How the tracks compare; None if it is too early for the next comparison.
        """
        now_ns = state.stamp_ns
        self._carry(state.world_T_body, predicted)
        if self._poses and now_ns < self._poses[-1].stamp_ns + _STEP_NS - _UNEVEN_NS:
            return None
        T, now = state.world_T_body, self._count
        self._poses.append(_Pose(now_ns, now, _parts(T), _parts(self._carried), motion))
        self._tracks.add(now, frame)
        self._count += 1
        while self._poses[0].stamp_ns < now_ns - COMPARED_NS - _UNEVEN_NS:
            self._poses.popleft()
        self._tracks.keep_frames([pose.index for pose in self._poses])
        ids, lengths = self._tracks.lengths()
        ids = ids[(lengths >= _LEAST_FRAMES) & is_in(ids, self._tracks.seen)]
        ids = ids[~is_in(ids, moving)]
        motions = {p.index: p.motion for p in self._poses if p.motion is not None}
        projection = RigProjection(rig, motions)
        errors = self._errors(ids, projection)
        if aided:
            errors = np.minimum(errors, self._errors(ids, projection, carried=True))
        unfit = int(np.count_nonzero(errors >= _LARGEST * sigma_px))
        enough = len(ids) >= _JUMPED
        bad = enough and unfit >= _LOST_SHARE * len(ids)
        bad = bad and bool(np.median(errors) >= _FAR * sigma_px)
        if bad and self._good == now - 1 - self._bad:
            self._bad += 1
        jumped = lost = False
        if self._good == now - _LEAST_FRAMES:
            jumped = self._jumped(ids, self._good, projection, _LARGEST * sigma_px)
            lost = self._bad >= _LOST
        told = self._telling
        if enough and unfit <= _GOOD_SHARE * len(ids):
            self._good, self._bad = now, 0
            self._telling = sigma_px <= self._usual_px
        return Fit(len(ids), unfit, jumped and told, lost and told, self._telling)

    def _carry(self, reported: gtsam.Pose3, predicted: gtsam.Pose3 | None) -> None:
        """Go on from frame to frame as the IMU says, or as was reported where that is not known."""
        if self._latest is not None:
            step = self._latest.between(reported if predicted is None else predicted)
            self._carried = self._carried * step
        self._latest = reported

    def _jumped(
        self, ids: IntArray, before: int, projection: RigProjection, limit_px: float
    ) -> bool:
        """Whether tracks (ids ascending) fit after a frame, and not across the time after it."""
        ids = ids[is_in(ids, self._tracks.ids_in(before))]
        after = range(before + 1, self._count)
        ids = ids[is_in(ids, self._tracks.ids_in(after[0]))]
        if len(ids) < _JUMPED:
            return False
        across = self._errors(ids, projection) >= limit_px
        fits = self._errors(ids, projection, after) < limit_px
        if min(np.mean(across), np.mean(fits)) < _JUMPED_SHARE:
            return False
        carried = self._errors(ids, projection, carried=True) >= limit_px
        return bool(np.mean(carried) >= _JUMPED_SHARE)

    def _errors(
        self,
        ids: IntArray,
        projection: RigProjection,
        frames: Sequence[int] | None = None,
        carried: bool = False,
    ) -> FloatArray:
        """Reprojection errors (J,) of tracks (ids ascending), each as large as its noise, px.

        Args:
            ids: of them.
            projection: of the rig.
            frames: those that count; all if none are given.
            carried: whether poses are those without the corrections.
        """
        obs = self._tracks.observations(ids, frames)
        if len(obs) == 0:
            return np.zeros(0)
        used = [pose for pose in self._poses if pose.index in obs.frames]
        poses = [pose.carried if carried else pose.reported for pose in used]
        R = np.array([rotation for rotation, _ in poses])
        p = np.array([position for _, position in poses])
        found = triangulate(obs, projection, R, p, _THRESHOLDS)
        dof = np.maximum(2 * obs.counts - _POINT_DIM, 1)
        errors: FloatArray = found.reprojection_px * np.sqrt(obs.counts / dof)
        return np.where(np.isfinite(errors), errors, np.inf)


def _parts(pose: gtsam.Pose3) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and position (3,)."""
    return pose.rotation().matrix(), pose.translation()
