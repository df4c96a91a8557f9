# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The features of one camera from image to image: predicted, associated, tested, replenished."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.frontend.association import Associator
from slam_graph.frontend.extraction import CornerExtractor
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.frontend_protocol import Feedback, FrameStats
from slam_graph.frontend.outliers import (
    MIN_POINTS,
    coherent_groups,
    direction_inliers,
    eight_point,
    epipolar_distance,
    fundamental_inliers,
    map_inliers,
)
from slam_graph.frontend.prediction import PointPredictor
from slam_graph.frontend.tracked_features import Image, Mask, Tracks
from slam_graph.sensors.rig import RigCamera


class CameraTracker:
    """Follows the features of one camera.

    Args:
        mounted: the camera.
        extractor: knows its mask.
        associator: tracks or matches.
        predictor: says where to look.
        config: options.
        stats: gets counts and times.
        rng: decides what RANSAC tries first.
    """

    def __init__(
        self,
        mounted: RigCamera,
        extractor: CornerExtractor,
        associator: Associator,
        predictor: PointPredictor,
        config: FrontendConfig,
        stats: FrameStats,
        rng: np.random.Generator,
    ) -> None:
        self._camera = mounted.camera
        self._body_T_camera = mounted.body_T_camera
        self._extractor = extractor
        self._associator = associator
        self._predictor = predictor
        self._config = config
        self._stats = stats
        self._rng = rng
        self._groups: list[IntArray] = []

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
            guess = self._predictor.predict(before, stamp_ns, feedback)
            match = self._associator.follow(before, image, guess)
            keep = match.good.copy()
            keep[keep] = self._extractor.allows(match.points[keep])
            self._stats.count(**match.fates, lost_mask=match.good & ~keep)
        with self._stats.timed("ransac_ms"):
            normalized = self._camera.undistort(match.points[keep].astype(np.float64))
            after = Tracks.of(image, stamp_ns, before.ids[keep], match.points[keep], normalized)
            groups = self._rigid(before.normalized[keep], normalized)
            self._groups = [after.ids[rows] for rows in groups]
            inlier = np.zeros(len(after), np.bool_)
            inlier[np.concatenate(groups)] = True
            in_map = np.ones(len(after), np.bool_)
            in_map[inlier] = self._on_the_map(after.select(inlier), stamp_ns, feedback)
            self._stats.count(rejected_ransac=~inlier, rejected_map=inlier & ~in_map)
            after = after.select(inlier & in_map)
        with self._stats.timed("temporal_ms"):
            after = self._recovered(before, after)
        alone = _apart(after.pixels, self._config.merge_distance_px)
        self._stats.count(lost_merged=~alone)
        return self._with_drift(before, after.select(alone))

    def replenish(self, before: Tracks, after: Tracks, next_id: int) -> Tracks:
        """The features of an image, and new ones where it has few.

        Args:
            before: features of the image before.
            after: features of this image that were followed.
            next_id: id of the first new feature.
        """
        here, there = after.common(before)
        verify = self._config.verify_new and len(here) >= MIN_POINTS
        with self._stats.timed("detect_ms"):
            births = self._associator.births(before, after, verify)
            points = births.points
            normalized = self._camera.undistort(points.astype(np.float64))
            good = np.ones(len(points), np.bool_)
            drift = np.full((len(points), 2), np.nan)
            if births.origins is not None:
                origins = self._camera.undistort(births.origins.astype(np.float64))
                motions = self._motions(before.select(there), after.select(here))
                good = self._born(origins, normalized, births.share, motions)
                seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
                drift = self._predictor.drift(origins, normalized, seconds)
            self._stats.count(rejected_new=~good, new=good)
            ids = np.arange(next_id, next_id + np.count_nonzero(good), dtype=np.int64)
            self._associator.adopt(ids, good)
        new = Tracks.of(after.image, after.stamp_ns, ids, points[good], normalized[good])
        new.drift[:] = drift[good]
        return after.joined(new)

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Do not look for some features any more."""
        self._associator.forget(ids)

    def _rigid(self, before: FloatArray, after: FloatArray) -> list[IntArray]:
        """Rows of the matches (N, 2) that fit a rigid motion, for each that is there."""
        everything = np.arange(len(before))
        if self._config.outliers == "none":
            return [everything]

        def inliers(rows: IntArray) -> Mask:
            return self._inliers(before[rows], after[rows])

        largest = inliers(everything)
        return [
            everything[largest],
            *coherent_groups(inliers, everything[~largest], len(before)),
        ]

    def _inliers(self, before: FloatArray, after: FloatArray, share: float = 1.0) -> Mask:
        """Which matches (N, 2) fit the motion of most of them, within a share of the threshold."""
        config, focal_px = self._config, self._camera.fx
        if config.outliers == "gyroscope" and self._predictor.rotation_known:
            R = self._predictor.camera_R
            return direction_inliers(before, after, R, focal_px, config, self._rng, share)
        order = self._rng.permutation(len(before))
        inlier = np.empty(len(before), np.bool_)
        inlier[order] = fundamental_inliers(before[order], after[order], focal_px, config, share)
        return inlier

    def _born(
        self, origins: FloatArray, points: FloatArray, share: float, motions: list[FloatArray]
    ) -> Mask:
        """Which candidates (M, 2) for new features move as others do, or as one of their own."""
        limit_px = share * self._config.epipolar_px
        distances = [epipolar_distance(F, origins, points) for F in motions]
        good: Mask = np.min(distances, axis=0) * self._camera.fx < limit_px

        def inliers(rows: IntArray) -> Mask:
            return self._inliers(origins[rows], points[rows], share)

        for group in coherent_groups(inliers, np.flatnonzero(~good), len(good)):
            good[group] = True
        return good

    def _motions(self, before: Tracks, after: Tracks) -> list[FloatArray]:
        """The epipolar matrix (3, 3) of each motion that features common to two images have."""
        others = [np.isin(after.ids, ids) for ids in self._groups[1:]]
        groups = [~np.any([np.zeros(len(after), np.bool_), *others], axis=0), *others]
        matches = ((before.normalized[rows], after.normalized[rows]) for rows in groups)
        motions = [eight_point(one, other) for one, other in matches if len(one) >= MIN_POINTS]
        return motions or [eight_point(before.normalized, after.normalized)]

    def _on_the_map(self, tracks: Tracks, stamp_ns: int, feedback: Feedback) -> Mask:
        """Which features (N,) fit the map of the back end; those that are not in it do."""
        fits = np.ones(len(tracks), np.bool_)
        if self._config.map_check_px is None:
            return fits
        world_T_body = self._predictor.body_pose(stamp_ns)
        known = np.flatnonzero(np.isin(tracks.ids, feedback.ids))
        if world_T_body is None or len(known) == 0:
            return fits
        points = feedback.points[np.searchsorted(feedback.ids, tracks.ids[known])]
        camera_T_world = (world_T_body * self._body_T_camera).inverse()
        fits[known] = map_inliers(
            points, tracks.normalized[known], camera_T_world, self._camera.fx, self._config
        )
        return fits

    def _recovered(self, before: Tracks, after: Tracks) -> Tracks:
        """The features, and those that were lost and are seen again."""
        ids, points = self._associator.recover(before, after)
        if len(ids) == 0:
            return after
        allowed = self._extractor.allows(points)
        ids, points = ids[allowed], points[allowed]
        self._stats.add("recovered", len(ids))
        normalized = self._camera.undistort(points.astype(np.float64))
        return after.joined(Tracks.of(after.image, after.stamp_ns, ids, points, normalized))

    def _with_drift(self, before: Tracks, after: Tracks) -> Tracks:
        """The same features with their velocities."""
        here, there = after.common(before)
        seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
        after.drift[here] = self._predictor.drift(
            before.normalized[there], after.normalized[here], seconds
        )
        return after


def _apart(pixels: NDArray[np.float32], distance_px: float) -> Mask:
    """Which points (N, 2) are not within a distance of an earlier one."""
    u, v = pixels.T
    close = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2 < distance_px**2
    result: Mask = ~np.any(np.tril(close, -1), axis=1)
    return result
