# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Matches between cameras: the features of a reference camera in another camera's image.

`reference_cameras` finds which cameras of a rig see the same; each of them is matched to an earlier
one. Every frame is matched anew, from the reference to the other camera, so that the disparity of a
feature does not drift as it would if both cameras tracked it for themselves. Lucas-Kanade starts
from the disparity that a feature had before. Features without one are searched along their epipolar
line first: Lucas-Kanade converges over a few pixels, but the same point in two cameras that are
0.1 m apart, 0.5 m away, is off by a hundred. Where the focal lengths differ, the other camera's
image is resampled to the scale of the reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.frontend.common_scale import CommonScale
from slam_graph.frontend.epipolar_test import distances_px
from slam_graph.frontend.extraction import FeatureExtractor
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.keypoints import Image, Pixels, Tracks
from slam_graph.frontend.lucas_kanade import LucasKanade
from slam_graph.frontend.outliers import epipolar_distance, essential_matrix
from slam_graph.kernels.ascending import are_among
from slam_graph.kernels.epipolar import ray_depths
from slam_graph.kernels.patch_search import along_rays, most_similar
from slam_graph.sensors import Camera, Rig, RigCamera

_OVERLAP_GRID = 8
"""Rays through OVERLAP_GRID x OVERLAP_GRID pixels are followed into the other camera."""

_OVERLAP_DEPTHS_M = (1.0, 3.0, 10.0, 100.0)
"""Distances at which it is computed what two cameras both see."""

_MIN_OVERLAP = 0.25
"""A camera that sees less than this share of another one's view has features of its own."""

MAX_TANGENT = 3.0
"""Points with larger normalised coordinates, 72° off the axis, are outside of any narrow lens."""

_HALVINGS = 2
"""The epipolar search runs on images of a quarter of the size."""

_PATCH_RADIUS = 3
"""Its patches have (2 PATCH_RADIUS + 1)² pixels of the reduced image."""

_SEARCH_STEP_PX = 1.0
"""Largest distance, in the reduced image, between neighbouring candidates at the image centre."""

_NEAREST = 1e-3
"""Candidates that are less far ahead of the other camera, as a share of their depth in the
reference, count as if they were so far ahead."""

MIN_SCORE = 0.6
"""Smallest normalised cross-correlation of a candidate that Lucas-Kanade starts from."""

_FAR_OFF_PX = -1e6
"""Stands for the pixel of a point that a wide lens does not see."""

LEVELS = 1
"""Pyramid levels of Lucas-Kanade: the guess is good, and more levels lead away from it."""

RETRY_FRAMES = 2
"""A feature without a match is searched again every RETRY_FRAMES frames."""


def reference_cameras(rig: Rig) -> tuple[int, ...]:
    """For each camera the index of the one that it is matched to: an earlier one, or itself."""
    references: list[int] = []
    for index, mounted in enumerate(rig.cameras):
        leaders = [i for i in sorted(set(references)) if references[i] == i]
        shares = [_overlap(rig.cameras[i], mounted) for i in leaders]
        if shares and max(shares) >= _MIN_OVERLAP:
            references.append(leaders[int(np.argmax(shares))])
        else:
            references.append(index)
    return tuple(references)


def _overlap(reference: RigCamera, other: RigCamera) -> float:
    """The share of a camera's view that another one sees too, at the depth where it is largest."""
    camera = reference.camera
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, _OVERLAP_GRID),
        np.linspace(0, camera.height - 1, _OVERLAP_GRID),
    )
    rays, usable = camera.visible(np.column_stack([u.ravel(), v.ravel()]))
    if not usable.any():
        return 0.0
    rays = rays[usable]
    ends = np.column_stack([rays, np.ones(len(rays))])
    other_T_reference = other.body_T_camera.between(reference.body_T_camera)
    shares = []
    for depth_m in _OVERLAP_DEPTHS_M:
        points = np.asarray(other_T_reference.transformFrom((depth_m * ends).T)).T
        shares.append(float(np.mean(_sees(other, points))))
    return max(shares)


def _sees(mounted: RigCamera, points: FloatArray) -> BoolArray:
    """Which points (N, 3) of its frame a camera sees."""
    camera = mounted.camera
    ahead = points[:, 2] > 0
    m = points[:, :2] / np.where(ahead, points[:, 2], np.inf)[:, None]
    ahead &= camera.within_reach(m, MAX_TANGENT)
    pixels = camera.pixels(np.where(ahead[:, None], m, 0.0))
    sees: BoolArray = (
        ahead & np.all(pixels >= 0, axis=1) & np.all(pixels < (camera.width, camera.height), axis=1)
    )
    return sees


class _EpipolarSearch:
    """Searches points of one camera along their epipolar lines in the image of another.

    The candidates are projections at depths that are evenly spaced in 1 / z (with a wide lens, at
    distances evenly spaced in 1 / distance); the best one is that with the largest normalised
    cross-correlation of a small patch of the reduced images.

    Args:
        camera: the one that is searched in.
        other_T_reference: pose of the reference camera in the frame of `camera`.
        min_depth_m: depth of the nearest candidate.

    Attributes:
        R, t: of `other_T_reference`.
        essential: (3, 3) matrix of the same.
    """

    def __init__(self, camera: Camera, other_T_reference: gtsam.Pose3, min_depth_m: float) -> None:
        self._camera = camera
        # arrays as kernels take them: in rows, and not read-only
        rotation = other_T_reference.rotation().matrix()
        self.R: FloatArray = np.ascontiguousarray(rotation)
        self._turn: FloatArray = np.ascontiguousarray(rotation.T)  # for rows on its left
        self.t: FloatArray = np.array(other_T_reference.translation())
        self.essential = essential_matrix(other_T_reference)
        disparity_px = camera.fx * float(np.linalg.norm(self.t)) / min_depth_m
        count = int(disparity_px / (_SEARCH_STEP_PX * 2**_HALVINGS)) + 2
        self._inverse_depths = np.linspace(0.0, 1.0 / min_depth_m, count)

    def project(self, normalized: FloatArray, inverse_depth_per_m: FloatArray) -> FloatArray:
        """Pixels in the other camera of points of the reference camera at given depths.

        Args:
            normalized: (N, 2) in the reference camera.
            inverse_depth_per_m: (C,) 1 / z in the reference camera, 1 / distance if this camera's
                lens is wide; 0 for points at infinity.

        Returns:
            (N, C, 2); far off the image for points that are not in front of the other camera.
        """
        rays = np.empty((len(normalized), 3))
        rays[:, :2], rays[:, 2] = normalized, 1.0
        if self._camera.model.sees_sideways:
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        shifts = np.outer(inverse_depth_per_m, self.t)
        m = along_rays(rays @ self._turn, shifts, _NEAREST)
        pixels = self._camera.pixels(m)
        if self._camera.model.sees_sideways:  # beyond its reach a point may come out in the image
            pixels[~self._camera.within_reach(m, MAX_TANGENT)] = _FAR_OFF_PX
        return np.ascontiguousarray(pixels.reshape(len(rays), len(shifts), 2))

    def search(
        self, reference: Image, other: Image, pixels: Pixels, normalized: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The candidate that is most similar to each point.

        Args:
            reference: image of the reference camera, reduced by `_reduce`.
            other: image of the other camera, reduced likewise.
            pixels: (N, 2) full-size pixels in the reference.
            normalized: (N, 2) the same, undistorted.

        Returns:
            guess: (N, 2) full-size pixels in the other image.
            score: (N,) normalised cross-correlation there, in [-1, 1].
        """
        n = len(pixels)
        targets = self.project(normalized, self._inverse_depths)
        scores = np.empty(n)
        points = pixels.astype(np.float64)
        best = most_similar(reference, other, points, targets, 2**_HALVINGS, _PATCH_RADIUS, scores)
        return targets[np.arange(n), best], scores


def _reduce(image: Image) -> Image:
    """An image of a quarter of the size, each pixel the mean of 4 x 4."""
    for _ in range(_HALVINGS):
        # Halving twice is several times faster in OpenCV than the same in one step
        size = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image


@dataclass(frozen=True)
class _MatchCounts:
    """How many features of the reference camera were matched, and rejected by geometry."""

    matched: int = 0
    rejected: int = 0


class StereoMatcher:
    """Finds the features of the reference camera in one other camera, frame after frame.

    Args:
        camera: the other camera.
        reference: the reference camera.
        other_T_reference: pose of the reference camera in the other one's frame.
        lucas_kanade: refines the matches.
        extractor: of the other camera, for its mask.
        config: thresholds.

    Attributes:
        counts: of the last frame.
    """

    def __init__(
        self,
        camera: Camera,
        reference: Camera,
        other_T_reference: gtsam.Pose3,
        lucas_kanade: LucasKanade,
        extractor: FeatureExtractor,
        config: FrontendConfig,
    ) -> None:
        self._camera = camera
        self._reference = reference
        self._wide = camera.model.sees_sideways or reference.model.sees_sideways
        self._scale = CommonScale(camera, reference)
        self._lucas_kanade = lucas_kanade
        self._extractor = extractor
        self._config = config
        self.mount(other_T_reference)
        self._ids = np.zeros(0, np.int64)
        self._offsets = np.zeros((0, 2), np.float32)
        self._frames = 0
        self.counts = _MatchCounts()

    def mount(self, other_T_reference: gtsam.Pose3) -> None:
        """Take the pose of the reference in the other camera's frame as it is calibrated now."""
        nearest_m = self._config.stereo_min_depth_m
        self._search = _EpipolarSearch(self._scale.camera, other_T_reference, nearest_m)

    def match(self, reference: Tracks, image: Image, stamp_ns: int, first_new_id: int) -> Tracks:
        """The features of the reference camera that another camera sees at the same time.

        Args:
            reference: features of the reference camera.
            image: of the other camera.
            stamp_ns: its time.
            first_new_id: features from this id on are new, and are searched at once.
        """
        self._frames += 1
        self.counts = _MatchCounts()
        reference_image = reference.image
        if reference_image is None or len(reference) == 0:
            return Tracks.empty(image, stamp_ns)
        scaled = self._scale.image(image)
        worthwhile, guess = self._guess(reference, reference_image, scaled, first_new_id)
        rows = worthwhile.nonzero()[0]  # of `reference`; `take` needs less time than masks
        starts, guess = reference.pixels.take(rows, axis=0), guess.take(rows, axis=0)
        flow = self._lucas_kanade.flow(reference_image, scaled, starts, guess, LEVELS)
        kept = (flow.found & (flow.error_px < self._config.forward_backward_px)).nonzero()[0]
        kept = kept[self._extractor.allows(self._scale.raw(flow.points.take(kept, axis=0)))]
        rows, ends = rows.take(kept), flow.points.take(kept, axis=0)
        pixels = self._scale.raw(ends)
        normalized = self._camera.undistort(pixels.astype(np.float64))
        good = self._inliers(reference.normalized.take(rows, axis=0), normalized).nonzero()[0]
        self.counts = _MatchCounts(len(good), len(rows) - len(good))
        rows, pixels = rows.take(good), pixels.take(good, axis=0)
        self._ids = reference.ids.take(rows)
        self._offsets = ends.take(good, axis=0) - reference.pixels.take(rows, axis=0)
        return Tracks.of(image, stamp_ns, self._ids, pixels, normalized.take(good, axis=0))

    def _guess(
        self, reference: Tracks, reference_image: Image, image: Image, first_new_id: int
    ) -> tuple[BoolArray, Pixels]:
        """Which features (N,) to look for, and where to start (N, 2) in the scaled image."""
        guess = reference.pixels.copy()
        known = are_among(reference.ids, self._ids)
        rows = known.nonzero()[0]
        at = self._ids.searchsorted(reference.ids.take(rows))
        guess[rows] += self._offsets.take(at, axis=0)
        due = (reference.ids + self._frames) % RETRY_FRAMES == 0
        rows = (~known & (due | (reference.ids >= first_new_id))).nonzero()[0]
        if len(rows):
            points, score = self._search.search(
                _reduce(reference_image),
                _reduce(image),
                reference.pixels.take(rows, axis=0),
                reference.normalized.take(rows, axis=0),
            )
            guess[rows] = points
            known[rows] = score > MIN_SCORE
        return known, guess

    def _inliers(self, m_reference: FloatArray, m_other: FloatArray) -> BoolArray:
        """Which matches (N, 2) fit the calibration of the rig, (N,)."""
        focal_px = self._camera.fx
        depth_m = ray_depths(self._search.R, self._search.t, m_reference, m_other)[:, 0]
        if self._wide:
            camera, other = self._reference, self._camera
            distance_px = distances_px(camera, self._search.essential, m_reference, m_other, other)
            depth_m = depth_m * np.sqrt(1.0 + np.sum(m_reference**2, axis=1))  # along the ray
        else:
            distance = epipolar_distance(self._search.essential, m_reference, m_other)
            distance_px = distance * focal_px
        # In terms of disparity, because far points may come out a little beyond infinity
        baseline_m = float(np.linalg.norm(self._search.t))
        disparity_px = focal_px * baseline_m / depth_m
        nearest_px = focal_px * baseline_m / self._config.stereo_min_depth_m
        tolerance_px = self._config.stereo_epipolar_px
        good: BoolArray = distance_px < tolerance_px
        return good & (disparity_px < nearest_px) & (disparity_px > -tolerance_px)
