# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The features of one camera from image to image: predict, associate, test, replenish."""

from __future__ import annotations

from functools import partial, reduce

import numpy as np
import scipy  # its parts are imported when they are first used

from slam_graph.arrays import BoolArray, FloatArray, IntArray, median
from slam_graph.frontend.association import Associator
from slam_graph.frontend.epipolar_test import EpipolarTest, distances_px, fitted_motion
from slam_graph.frontend.extraction import FeatureExtractor
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback, FrameStats
from slam_graph.frontend.image_rotation import ImageRotation
from slam_graph.frontend.keypoints import Image, Tracks
from slam_graph.frontend.lost_features import LostFeatures
from slam_graph.frontend.lucas_kanade import BLUR_PER_PX, lengths
from slam_graph.frontend.moving_tracks import MovingTracks
from slam_graph.frontend.outliers import MIN_POINTS, coherent_groups, map_inliers
from slam_graph.frontend.prediction import MAX_TANGENT, PointPredictor
from slam_graph.kernels.ascending import are_among
from slam_graph.kernels.spacing import apart
from slam_graph.sensors import RigCamera

_FEW, _FEW_SHARE = 15, 0.25
"""If fewer features go on, and a smaller share of those that should be in the image, they are
chance matches: seven wrong ones always fit an epipolar geometry, and a few more as well."""

_MERGE_DISTANCE_PX = 3.0
"""Of two features closer than this the younger one is dropped: they track the same corner."""


class CameraTracker:
    """Tracks the features of one camera.

    Args:
        mounted: the camera.
        extractor: knows its mask.
        associator: tracks or matches.
        predictor: says where to look.
        config: settings.
        stats: receives counts and times.
        rng: draws the samples of RANSAC.
        rotation: takes the place of a gyroscope.
        moving: which features move by themselves; without it such are rejected.
        lost: finds corners again that were lost a few images ago.
        keeps_few: whether the few features are kept that seem to go on where nearly all are lost.

    Attributes:
        outliers: the features that RANSAC, or the map of the back end, rejected in the last image.
    """

    def __init__(
        self,
        mounted: RigCamera,
        extractor: FeatureExtractor,
        associator: Associator,
        predictor: PointPredictor,
        config: FrontendConfig,
        stats: FrameStats,
        rng: np.random.Generator,
        rotation: ImageRotation | None = None,
        moving: MovingTracks | None = None,
        lost: LostFeatures | None = None,
        keeps_few: bool = True,
    ) -> None:
        self._keeps_few = keeps_few
        self._moving = moving or MovingTracks(wanted=False)
        self._camera = mounted.camera
        self._body_T_camera = mounted.body_T_camera
        self._extractor = extractor
        self._associator = associator
        self._predictor = predictor
        self._config = config
        self._stats = stats
        self._epipolar = EpipolarTest(mounted.camera, config, rng)
        self._motion_ids: list[IntArray] = []  # of the features of each rigid motion
        self._rotation = rotation
        self._lost = lost
        self.outliers = Tracks.empty()

    def follow(self, before: Tracks, image: Image, stamp_ns: int, feedback: Feedback) -> Tracks:
        """The features of the image before in the next one.

        Args:
            before: the camera's last image and its features.
            image: the next one.
            stamp_ns: its time.
            feedback: what the back end knows.
        """
        with self._stats.timed("temporal_ms"):
            self._predictor.advance(before.stamp_ns, stamp_ns)
            if self._rotation is not None and before.image is not None:
                turn = self._rotation.between(before.image, image)
                self._predictor.turn(turn, self._rotation.close)
                if self._lost is not None:
                    self._lost.turn(turn)
            guess = self._predictor.predict(before, stamp_ns, feedback)
            found = self._associator.follow(before, image, guess)
            kept = found.good.nonzero()[0]
            points = found.points.take(kept, axis=0)
            allowed = self._extractor.allows(points)
            self._stats.count(**found.lost, lost_mask=~allowed)
            if np.count_nonzero(allowed) < len(allowed):
                kept, points = kept[allowed], points.compress(allowed, axis=0)
        with self._stats.timed("ransac_ms"):
            normalized = self._camera.undistort(points.astype(np.float64))
            after = Tracks.of(image, stamp_ns, before.ids.take(kept), points, normalized)
            self._moving.next_frame()
            moves = self._moving.among(after.ids)
            tested = (~moves).nonzero()[0]
            starts = self._unrolled(before).take(kept[tested], axis=0)
            places = starts, self._unrolled(after).take(tested, axis=0)
            scale = self._tolerance_scale(before, kept, after)
            motions = [tested[rows] for rows in self._rigid_motions(*places, scale)]
            self._motion_ids = [after.ids[rows] for rows in motions]
            inlier = moves.copy()
            inlier[np.concatenate(motions)] = True
            if self._moving.keeps:
                self._moving.suspect(after.ids[~inlier])
                self._stats.count(moving=self._moving.among(after.ids))
                inlier[:] = True
            self._stats.count(rejected_ransac=~inlier)
            self._stats.add("rejected_map", 0)
            if self._config.map_check_px is not None:
                rows = inlier.nonzero()[0]
                wrong = rows[~self._fits_map(after.select(rows), stamp_ns, feedback)]
                self._stats.add("rejected_map", len(wrong))
                inlier[wrong] = False
            self.outliers, after = after.select(~inlier), after.select(inlier)
            after = self._without_few(after, int(np.count_nonzero(guess.trusted)))
        with self._stats.timed("temporal_ms"):
            after = self._recovered(before, after)
        alone = apart(np.ascontiguousarray(after.pixels), _MERGE_DISTANCE_PX)
        merged = len(alone) - int(np.count_nonzero(alone))
        self._stats.add("lost_merged", merged)
        if merged:
            after = after.select(alone)
        return self._with_residual_flow(before, after)

    def replenish(self, before: Tracks, after: Tracks, next_id: int) -> Tracks:
        """Add new features where an image has few.

        Args:
            before: features of the image before.
            after: features of this image that were found again.
            next_id: id of the first new feature.
        """
        here, there = after.common(before)
        moves = self._moving.among(after.ids)
        self._extractor.count_apart(after.pixels.take(moves.nonzero()[0], axis=0))
        rest = (~moves.take(here)).nonzero()[0]  # others would spoil the motion of these
        here, there = here.take(rest), there.take(rest)
        verify = self._config.verify_new and len(here) >= MIN_POINTS
        with self._stats.timed("detect_ms"):
            candidates = self._associator.propose(before, after, verify)
            points, count = candidates.points, len(candidates.points)
            places = [points] if candidates.origins is None else [points, candidates.origins]
            undistorted = self._camera.undistort(np.concatenate(places).astype(np.float64))
            normalized, origins = undistorted[:count], undistorted[count:]
            if candidates.origins is None:
                good, flow = np.ones(count, np.bool_), np.full((count, 2), np.nan)
            else:
                starts = self._unrolled(before).take(there, axis=0)
                followed = self._unrolled(after).take(here, axis=0)
                motions = self._motions(after.ids[here], starts, followed)
                unrolled = self._predictor.unrolled
                origins = unrolled(candidates.origins, origins, before.stamp_ns)
                ends = unrolled(points, normalized, after.stamp_ns)
                good = self._fits_motion(origins, ends, candidates.tolerance_scale, motions)
                seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
                flow = self._predictor.residual_flow(origins, ends, seconds)
            self._stats.count(rejected_new=~good, new=good)
            fits = good
            if self._moving.keeps:
                good = np.ones(count, np.bool_)
            rows = good.nonzero()[0]
            ids = np.arange(next_id, next_id + len(rows), dtype=np.int64)
            if self._moving.keeps:
                self._moving.suspect(ids[~fits])
            self._associator.accept(ids, good)
        points, normalized = points.take(rows, axis=0), normalized.take(rows, axis=0)
        new = Tracks(after.image, after.stamp_ns, ids, points, normalized, flow.take(rows, axis=0))
        found = self._with_corners_of_objects(after.joined(new), next_id + len(ids))
        if self._lost is not None:
            self._lost.remember(found)
        return found

    def _with_corners_of_objects(self, tracks: Tracks, next_id: int) -> Tracks:
        """The features, and new ones on objects that have too few."""
        if not self._moving.hulls or tracks.image is None:
            return tracks
        distance_px = 0.5 * self._config.min_distance_px
        find = partial(self._associator.corners, tracks.image)
        points = self._moving.corners(tracks.pixels, tracks.image.shape, distance_px, find)
        points = points[self._extractor.allows(points)]
        ids = np.arange(next_id, next_id + len(points), dtype=np.int64)
        self._moving.add(ids)
        self._associator.accept_corners(ids, points)
        normalized = self._camera.undistort(points.astype(np.float64))
        new = Tracks.of(tracks.image, tracks.stamp_ns, ids, points, normalized)
        old = tracks.select(
            np.isin(tracks.ids, self._moving.ids) & np.isfinite(tracks.residual_flow[:, 0])
        )
        if len(old) and len(new):  # it moves as what is nearest on the object
            nearest = np.argmin(scipy.spatial.distance.cdist(new.pixels, old.pixels), axis=1)
            new.residual_flow[:] = old.residual_flow[nearest]
        return tracks.joined(new)

    def mount(self, mounted: RigCamera) -> None:
        """Take the place and the clock of the camera as they are calibrated now."""
        self._body_T_camera = mounted.body_T_camera
        self._predictor.mount(mounted)

    def forget(self, ids: IntArray) -> None:
        """Do not look for these features any more."""
        self._associator.forget(ids)
        if self._lost is not None:
            self._lost.forget(ids)

    def _without_few(self, after: Tracks, expected: int) -> Tracks:
        """The features that go on, or none of them where nearly all are lost at once.

        The IMU leads from one image to the next better than they do.

        Args:
            after: what seems to go on.
            expected: how many are predicted to be in the image.
        """
        if self._keeps_few or len(after) >= min(_FEW, _FEW_SHARE * expected):
            return after
        self._stats.add("lost_suddenly", len(after))
        return after.select(np.zeros(len(after), np.bool_))

    def _unrolled(self, tracks: Tracks) -> FloatArray:
        """Normalised coordinates (N, 2) of features as all rows would see them at one time."""
        return self._predictor.unrolled(tracks.pixels, tracks.normalized, tracks.stamp_ns)

    def _tolerance_scale(self, before: Tracks, rows: IntArray, after: Tracks) -> float:
        """By how much blur loosens the test of features (rows (N,) before), in the median.

        With a gyroscope by nothing, a factor of 1, since other features are replaced at no loss.
        """
        if self._lost is None or len(rows) == 0:
            return 1.0
        moved = after.pixels - before.pixels.take(rows, axis=0)
        moved_px = float(median(lengths(moved)))
        return 1.0 + BLUR_PER_PX * moved_px / self._config.epipolar_px

    def _rigid_motions(self, before: FloatArray, after: FloatArray, scale: float) -> list[IntArray]:
        """The rows of the matches (N, 2) that fit each rigid motion, the largest group first."""
        if self._config.outliers == "none":
            return [np.arange(len(before))]

        def inliers(rows: IntArray) -> BoolArray:
            return self._inliers(before.take(rows, axis=0), after.take(rows, axis=0), scale)

        largest = self._inliers(before, after, scale)
        return [
            largest.nonzero()[0],
            *coherent_groups(inliers, (~largest).nonzero()[0], len(before)),
        ]

    def _inliers(self, before: FloatArray, after: FloatArray, scale: float = 1.0) -> BoolArray:
        """Which matches (N, 2) fit the motion of most of them, with the tolerance scaled."""
        R = self._predictor.camera_R if self._predictor.rotation_known else None
        return self._epipolar.inliers(before, after, R, scale)

    def _fits_motion(
        self, origins: FloatArray, points: FloatArray, scale: float, motions: list[FloatArray]
    ) -> BoolArray:
        """Which candidates (M, 2) for new features fit a motion of the features, or a new one."""
        limit_px = scale * self._config.epipolar_px
        distances = [distances_px(self._camera, F, origins, points) for F in motions]
        good: BoolArray = reduce(np.minimum, distances) < limit_px

        def inliers(rows: IntArray) -> BoolArray:
            return self._inliers(origins[rows], points[rows], scale)

        for group in coherent_groups(inliers, (~good).nonzero()[0], len(good)):
            good[group] = True
        return good

    def _motions(self, ids: IntArray, start: FloatArray, end: FloatArray) -> list[FloatArray]:
        """The fundamental matrix (3, 3) of each rigid motion of features (N,) in both images."""
        if len(self._motion_ids) < 2:
            return [fitted_motion(self._camera, start, end)]
        others = [are_among(ids, moved) for moved in self._motion_ids[1:]]
        rest = np.ones(len(ids), np.bool_)
        for other in others:
            rest &= ~other
        groups = (rest, *others)
        matches = ((start.compress(rows, axis=0), end.compress(rows, axis=0)) for rows in groups)
        camera = self._camera
        enough = [(one, other) for one, other in matches if len(one) >= MIN_POINTS]
        return [fitted_motion(camera, *pair) for pair in enough or [(start, end)]]

    def _fits_map(self, tracks: Tracks, stamp_ns: int, feedback: Feedback) -> BoolArray:
        """Which features (N,) fit the map of the back end, or are not in it."""
        fits = np.ones(len(tracks), np.bool_)
        world_T_body = self._predictor.body_pose(stamp_ns)
        # PnP weighs all of the plane z = 1 alike; its noise grows towards the edge of a wide lens
        near = np.all(np.abs(tracks.normalized) < MAX_TANGENT, axis=1)
        known = np.flatnonzero(np.isin(tracks.ids, feedback.ids) & near)
        if world_T_body is None or len(known) == 0:
            return fits
        points = feedback.points[np.searchsorted(feedback.ids, tracks.ids[known])]
        camera_T_world = (world_T_body * self._body_T_camera).inverse()
        fits[known] = map_inliers(
            points, self._unrolled(tracks)[known], camera_T_world, self._camera.fx, self._config
        )
        return fits

    def _recovered(self, before: Tracks, after: Tracks) -> Tracks:
        """The features, and those that were lost and are found again."""
        if self._lost is None:
            ids, points = self._associator.recover(before, after)
        else:
            fits = partial(self._epipolar.inliers, after_R_before=None)
            ids, points = self._lost.found(after, fits)
        if len(ids) == 0:
            return after
        allowed = self._extractor.allows(points)
        ids, points = ids[allowed], points[allowed]
        self._stats.add("recovered", len(ids))
        normalized = self._camera.undistort(points.astype(np.float64))
        return after.joined(Tracks.of(after.image, after.stamp_ns, ids, points, normalized))

    def _with_residual_flow(self, before: Tracks, after: Tracks) -> Tracks:
        """The same features with their residual flow since the image before."""
        here, there = after.common(before)
        seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
        start, end = self._unrolled(before).take(there, axis=0), self._unrolled(after)
        if len(here) == len(after):  # unless some were lost in the image before
            after.residual_flow[:] = self._predictor.residual_flow(start, end, seconds)
        else:
            end = end.take(here, axis=0)
            after.residual_flow[here] = self._predictor.residual_flow(start, end, seconds)
        return after
