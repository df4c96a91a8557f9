# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What moves before one camera: in which direction it is seen, and how fast that changes.

One camera does not show how far away an object is that moves by itself: one twice as far, twice as
large and twice as fast looks the same. What it shows are tracks that no static point explains
(`motion_test.py`), which of them are near one another and move alike in the image, and the lines of
sight to them. So an object has a direction and an angular rate here, and nothing in metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from scipy.special import chdtri

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.row_unrolling import unrolled
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.motion_test import MotionTest, Verdict, judge_tracks
from slam_graph.backend.objects.object_frame import ObjectDirection, ObjectFrame
from slam_graph.backend.objects.object_regions import NEIGHBOURS_PX, region
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.sensors import FeatureFrame, Rig

_LEAST_FRAMES = 3
"""Frames of a track before it is tested."""
_RATE_S = 0.3
"""Time over which the rate of a line of sight is taken, at most."""
_ALIKE, _SIGMAS = 0.3, 3.0
"""Rates of two tracks of one object differ by no more than this part of the larger one, and so many
standard deviations."""


class DirectionTracker:
    """Finds what moves before one camera, frame by frame.

    Args:
        rig: the camera.
        backend: settings of the estimator.
        config: of objects.
        first: number of the first one.
    """

    def __init__(self, rig: Rig, backend: BackendConfig, config: ObjectsConfig, first: int) -> None:
        camera = rig.cameras[0].camera
        self._focal_px = float(np.sqrt(camera.fx * camera.fy))
        self._body_R_camera = rig.cameras[0].body_T_camera.rotation().matrix()
        self._backend, self._config, self._next = backend, config, first
        self._window = TrackWindow(rig, backend)
        self._number_of: dict[int, int] = {}  # by track, in the frame before

    def add(self, frame: FeatureFrame, ego: EgoMotion, sigma_px: float) -> ObjectFrame:
        """Take the features of one frame; arguments as for `ObjectTracker.add`."""
        self._window.add(frame, ego.stamps_ns[0], ego)
        obs = self._window.observations(self._window.seen, _LEAST_FRAMES, list(ego.stamps_ns))
        rig = self._window.projection(ego.stamps_ns, ego.poses)
        test = judge_tracks(obs, rig, ego, sigma_px, self._backend, self._config)
        moving = test.ids[np.isin(test.verdicts, (Verdict.MOVING, Verdict.WRONG))]
        moving = moving[self._not_static(moving, test, obs, ego, sigma_px)]
        moving = np.union1d(moving, self._still_unknown(test))
        directions: list[ObjectDirection] = []
        sights, members = self._lines_of_sight(moving, ego), dict[int, int]()
        sigma = sigma_px / self._focal_px
        rate_sigma = np.sqrt(2.0) * sigma / sights.seconds
        for rows in self._groups(sights, rate_sigma):
            ids, direction = sights.ids[rows], sights.now[rows].mean(axis=0)
            number = self._number(ids, set(members.values()))
            members |= dict.fromkeys(ids.tolist(), number)
            count = len(rows)
            directions.append(
                ObjectDirection(
                    frame.stamp_ns,
                    number,
                    direction / np.linalg.norm(direction),
                    sights.rates[rows].mean(axis=0),
                    sigma / np.sqrt(count),
                    rate_sigma / np.sqrt(count),
                    count,
                )
            )
        self._number_of = members
        return self._described(test, moving, members, directions)

    def _not_static(
        self,
        ids: IntArray,
        test: MotionTest,
        obs: Observations,
        ego: EgoMotion,
        sigma_px: float,
    ) -> BoolArray:
        """Which tracks (N,) of the test fit worse as static points: the likelihood ratio itself.

        With one camera depth and velocity trade off along a curve, on which a static point may be
        found far from where it is, with a velocity that its covariance there does not explain.
        """
        poses = dict(zip(ego.stamps_ns, ego.poses, strict=True))
        known, squares, _ = self._window.misfit(ids, poses, sigma_px)
        static = np.full(len(ids), np.inf)
        static[np.isin(ids, known)] = squares
        rows = np.searchsorted(test.ids, ids)
        moving = test.misfits[rows] * np.maximum(2 * obs.counts[rows] - 6, 1)
        result: BoolArray = static - moving > chdtri(3, self._config.false_alarm)
        return result

    def _still_unknown(self, test: MotionTest) -> IntArray:
        """Tracks (N,) of objects of which the test cannot tell now whether they still move."""
        known = np.fromiter(self._number_of, np.int64, len(self._number_of))
        return np.intersect1d(known, test.ids[test.verdicts == Verdict.UNKNOWN])

    def _lines_of_sight(self, ids: IntArray, ego: EgoMotion) -> _Sights:
        """Of the tracks (ascending ids) that the last frame and an earlier one see."""
        poses, now = dict(zip(ego.stamps_ns, ego.poses, strict=True)), self._window.frames[-1]
        known = [frame for frame in self._window.frames if frame.stamp_ns in poses]
        recent = [frame for frame in known if now.stamp_ns - frame.stamp_ns <= _RATE_S * 1e9]
        before = recent[0]
        ids = ids[np.isin(ids, before.cameras[0].ids) & np.isin(ids, now.cameras[0].ids)]
        start, end = (self._towards(frame, ids, poses[frame.stamp_ns]) for frame in (before, now))
        _, pixels = self._window.pixels(ids)
        return _Sights(ids, pixels, start, end, max((now.stamp_ns - before.stamp_ns) * 1e-9, 1e-3))

    def _towards(self, frame: FeatureFrame, ids: IntArray, pose: gtsam.Pose3) -> FloatArray:
        """Unit vectors (N, 3) in the world from the camera to features (ascending ids)."""
        seen = frame.cameras[0]
        motion = self._window.motions.get(frame.stamp_ns)
        order = np.argsort(seen.ids)
        rows = order[np.searchsorted(seen.ids[order], ids)]
        far = np.full(len(ids), np.inf)  # their distances are not known
        rays = unrolled(seen, rows, self._window.rig, motion, far)
        rays = np.column_stack([rays, np.ones(len(ids))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return np.asarray(rays @ (pose.rotation().matrix() @ self._body_R_camera).T)

    def _groups(self, sights: _Sights, rate_sigma: float) -> Iterator[IntArray]:
        """Rows (N,) of the tracks that are near one another and move alike, the most first."""
        if len(sights.ids) < self._config.min_points:
            return
        speeds = np.linalg.norm(sights.rates, axis=1)
        limit = _ALIKE * np.maximum(speeds[:, None], speeds) + _SIGMAS * np.sqrt(2.0) * rate_sigma
        alike = cdist(sights.rates, sights.rates) < limit
        near = cdist(sights.pixels, sights.pixels) < NEIGHBOURS_PX
        count, cluster = connected_components(near & alike, directed=False)
        sizes = np.bincount(cluster, minlength=count)
        for k in np.argsort(-sizes, kind="stable").tolist():
            if sizes[k] >= self._config.min_points:
                yield np.flatnonzero(cluster == k)

    def _number(self, ids: IntArray, taken: set[int]) -> int:
        """The number that most of the tracks had in the frame before, or a new one."""
        before = Counter(self._number_of[i] for i in ids.tolist() if i in self._number_of)
        for number, _ in before.most_common():
            if number not in taken:
                return number
        self._next += 1
        return self._next - 1

    def _described(
        self,
        test: MotionTest,
        moving: IntArray,
        members: dict[int, int],
        directions: list[ObjectDirection],
    ) -> ObjectFrame:
        seen, ids = self._window.frames[-1].cameras[0], np.array(sorted(members), np.int64)
        number = np.array([members[i] for i in ids.tolist()], np.int64)
        return ObjectFrame(
            moving=moving,
            static=test.of(Verdict.STATIC),
            wrong=np.setdiff1d(test.of(Verdict.WRONG), ids),
            probabilities=(test.ids, test.probabilities),
            members=members,
            hulls=[(d.number, region(seen, ids[number == d.number])) for d in directions],
            directions=directions,
        )


@dataclass(frozen=True, eq=False)
class _Sights:
    """Lines of sight to N tracks.

    Attributes:
        ids: (N,) ascending.
        pixels: (N, 2) where the camera sees them now.
        before, now: (N, 3) unit vectors in the world, at both times.
        seconds: time between.
    """

    ids: IntArray
    pixels: FloatArray
    before: FloatArray
    now: FloatArray
    seconds: float

    @property
    def rates(self) -> FloatArray:
        """(N, 3) rad/s."""
        return (self.now - self.before) / self.seconds
