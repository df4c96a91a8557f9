# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The KLT front end: corners of the first camera followed in time and matched across the rig."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError
from slam_graph.frontend.association import LucasKanade
from slam_graph.frontend.config import FrontendConfig
from slam_graph.frontend.extraction import CornerExtractor, camera_mask
from slam_graph.frontend.outliers import fundamental_inliers
from slam_graph.frontend.stereo import StereoMatcher
from slam_graph.frontend.tracks import Image, Mask, Tracks
from slam_graph.sensors.measurements import CameraFrame, FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig

FEW_FEATURES = 15
"""Fewer features than this left of a frame with more are worth a warning."""


class KltTracker:
    """Follows corners of the first camera (the reference) and finds them in the other cameras.

    Attributes:
        frame_stats: of the last frame: features by fate (`tracked`, `new`, `stereo`, and those
            lost by cause: `lost_klt`, `lost_fb`, `lost_mask`, `lost_merged`, `rejected_ransac`,
            `rejected_stereo`), and milliseconds per stage (`prepare_ms`, `temporal_ms`,
            `ransac_ms`, `detect_ms`, `stereo_ms`).
    """

    def __init__(
        self, rig: Rig, config: FrontendConfig, seed: int, diagnostics: Diagnostics
    ) -> None:
        """Prepare for the first frame.

        Args:
            rig: calibrated cameras.
            config: options.
            seed: decides the random samples of RANSAC.
            diagnostics: where faults are counted.

        Raises:
            ConfigError: if a mask cannot be read or does not fit its camera.
        """
        self._rig = rig
        self._config = config
        self._rng = np.random.default_rng(seed)
        self._diagnostics = diagnostics
        self._lucas_kanade = LucasKanade(config)
        self._extractors = _extractors(rig, config)
        reference = rig.cameras[0].body_T_camera
        self._matchers = {
            i: StereoMatcher(
                other.camera,
                other.body_T_camera.between(reference),
                self._lucas_kanade,
                self._extractors[i],
                config,
            )
            for i, other in enumerate(rig.cameras)
            if i > 0
        }
        self._clahe = cv2.createCLAHE(config.clahe_clip_limit, config.clahe_tiles)
        self._tracks = [Tracks.empty() for _ in rig.cameras]
        self._next_id = 0
        self.frame_stats: dict[str, float] = {}

    def track(self, frame: CameraFrame | FeatureFrame) -> FeatureFrame:
        """The features of the next frame; those of the frame before keep their ids.

        Where the image of a camera is missing, its features wait in its last image; where the
        reference has none, the other cameras go on by themselves.

        Raises:
            DataError: if the frame has not one image per camera of the size that the rig says.
        """
        self.frame_stats = defaultdict(float)
        with self._timed("prepare_ms"):
            images = [self._equalize(image) for image in self._checked(frame)]
        first_new_id = self._next_id
        if images[0] is not None:
            self._tracks[0] = self._follow(0, images[0])
            self._tracks[0] = self._replenish(self._tracks[0], images[0])
        for i, image in enumerate(images[1:], start=1):
            if image is None:
                continue
            if images[0] is None:
                self._tracks[i] = self._follow(i, image)
            else:
                self._tracks[i] = self._match(i, image, first_new_id)
        return FeatureFrame(
            frame.stamp_ns,
            tuple(
                FeatureObservations.empty() if image is None else tracks.observations()
                for image, tracks in zip(images, self._tracks, strict=True)
            ),
        )

    def drop(self, ids: NDArray[np.int64]) -> None:
        """Forget features in all cameras, e.g. those that the back end rejected."""
        self._tracks = [tracks.select(~np.isin(tracks.ids, ids)) for tracks in self._tracks]

    def _checked(self, frame: CameraFrame | FeatureFrame) -> tuple[Image | None, ...]:
        """The images of a frame, after a look at their number and sizes."""
        if isinstance(frame, FeatureFrame):
            raise DataError(
                f"frame {frame.stamp_ns} holds features, not images: there is nothing to track; "
                "replay them"
            )
        cameras = self._rig.cameras
        if len(frame.images) != len(cameras):
            raise DataError(
                f"frame {frame.stamp_ns} has {len(frame.images)} images, the rig has "
                f"{len(cameras)} cameras"
            )
        for rig_camera, image in zip(cameras, frame.images, strict=True):
            size = (rig_camera.camera.height, rig_camera.camera.width)
            if image is not None and image.shape != size:
                raise DataError(
                    f"frame {frame.stamp_ns}: the image of camera '{rig_camera.name}' has shape "
                    f"{image.shape}, its calibration says {size} (height, width)"
                )
        return frame.images

    def _equalize(self, image: Image | None) -> Image | None:
        """An image with its contrast equalised, as configured."""
        if image is None or self._config.equalization == "none":
            return image
        if self._config.equalization == "histogram":
            return np.asarray(cv2.equalizeHist(image), np.uint8)
        return np.asarray(self._clahe.apply(image), np.uint8)

    def _follow(self, index: int, image: Image) -> Tracks:
        """The features of a camera in its next image."""
        before = self._tracks[index]
        if before.image is None or len(before) == 0:
            return Tracks.empty(image)
        with self._timed("temporal_ms"):
            match = self._lucas_kanade.associate(before.image, image, before.pixels)
            keep = match.consistent.copy()
            keep[keep] = self._extractors[index].allows(match.points[keep])
            self._count(
                lost_klt=~match.found,
                lost_fb=match.found & ~match.consistent,
                lost_mask=match.consistent & ~keep,
            )
        with self._timed("ransac_ms"):
            camera = self._rig.cameras[index].camera
            normalized = camera.undistort(match.points[keep].astype(np.float64))
            after = Tracks(image, before.ids[keep], match.points[keep], normalized)
            inlier = self._rigid(before.normalized[keep], normalized, camera.fx)
            after = after.select(inlier)
            alone = _apart(after.pixels, self._config.merge_distance_px)
            self._count(rejected_ransac=~inlier, lost_merged=~alone)
            after = after.select(alone)
        if index == 0:
            self.frame_stats["tracked"] = len(after)
            if len(after) < FEW_FEATURES <= len(before):
                self._diagnostics.warn(
                    "few_features", f"{len(after)} of {len(before)} features could be followed"
                )
        return after

    def _rigid(
        self, before: NDArray[np.float64], after: NDArray[np.float64], focal_px: float
    ) -> Mask:
        """Which matches (N, 2) fit a rigid motion; the seed decides what RANSAC tries first."""
        order = self._rng.permutation(len(before))
        inlier = np.empty(len(before), np.bool_)
        inlier[order] = fundamental_inliers(before[order], after[order], focal_px, self._config)
        return inlier

    def _replenish(self, tracks: Tracks, image: Image) -> Tracks:
        """The features of the reference camera, and new ones where it has few."""
        with self._timed("detect_ms"):
            corners = self._extractors[0].extract(image, tracks.pixels)
            ids = np.arange(self._next_id, self._next_id + len(corners), dtype=np.int64)
            self._next_id += len(corners)
            self.frame_stats["new"] = len(corners)
            normalized = self._rig.cameras[0].camera.undistort(corners.astype(np.float64))
            return tracks.append(ids, corners, normalized)

    def _match(self, index: int, image: Image, first_new_id: int) -> Tracks:
        """The features of the reference camera that another camera sees too."""
        with self._timed("stereo_ms"):
            matcher = self._matchers[index]
            matches = matcher.match(self._tracks[0], image, first_new_id)
            self.frame_stats["stereo"] += matcher.counts.matched
            self.frame_stats["rejected_stereo"] += matcher.counts.rejected
            return matches

    def _count(self, **fates: Mask) -> None:
        for fate, features in fates.items():
            self.frame_stats[fate] += int(np.count_nonzero(features))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.frame_stats[stage] += (time.perf_counter() - start) * 1e3


def _extractors(rig: Rig, config: FrontendConfig) -> list[CornerExtractor]:
    """One extractor per camera, with its mask: what is told, and what a wide lens cannot use."""
    if len(config.masks) > len(rig.cameras):
        raise ConfigError(
            f"frontend.masks lists {len(config.masks)} masks, "
            f"the rig has {len(rig.cameras)} cameras"
        )
    masks = [*config.masks, *[None] * (len(rig.cameras) - len(config.masks))]
    extractors = []
    for rig_camera, path in zip(rig.cameras, masks, strict=True):
        width, height = rig_camera.camera.width, rig_camera.camera.height
        mask = camera_mask(rig_camera.camera, path, config.window_px)
        extractors.append(CornerExtractor(config, width, height, mask))
    return extractors


def _apart(pixels: NDArray[np.float32], distance_px: float) -> Mask:
    """Which points (N, 2) are not within a distance of an earlier one."""
    u, v = pixels.T
    close = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2 < distance_px**2
    result: Mask = ~np.any(np.tril(close, -1), axis=1)
    return result
