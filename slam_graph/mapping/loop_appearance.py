# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a keyframe looks like: descriptors of its tracked features, and of further corners."""

from __future__ import annotations

import cv2
import numpy as np

from slam_graph.frontend.descriptors import Orb
from slam_graph.frontend.keypoints import Keypoints
from slam_graph.frontend.tracks import Image
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.measurements import FeatureObservations

CORNER_QUALITY, CORNER_DISTANCE_PX = 0.01, 8
PATCH_PX = 31.0
NOT_TRACKED = -1
"""Id of the further corners."""


class KeyframeDescriber:
    """Describes what one camera sees.

    Descriptors are ORB's, upright and of one size: a platform that comes back to a place holds its
    camera upright again, and what is turned with the image says less.

    Args:
        camera: that takes the images.
        corners: how many corners are added to the tracked features.
    """

    def __init__(self, camera: Camera, corners: int) -> None:
        self._camera = camera
        self._corners = corners
        self._descriptor = Orb()

    def describe(self, image: Image, seen: FeatureObservations) -> FeatureObservations:
        """The features of an image with descriptors, followed by further corners.

        Features too close to the edge to be described are left out.
        """
        found = self._further_corners(image, seen.pixels)
        pixels = np.concatenate([seen.pixels, found])
        points = Keypoints.of(pixels.astype(np.float32), np.ones(len(pixels), np.float32), PATCH_PX)
        kept, descriptors = self._descriptor.describe(image, points)
        ids = np.concatenate([seen.ids, np.full(len(found), NOT_TRACKED)])
        normalized = np.concatenate([seen.normalized, self._camera.undistort(found)])
        return FeatureObservations(
            ids[kept], pixels[kept], normalized[kept], descriptors.astype(np.uint8)
        )

    def _further_corners(self, image: Image, taken: np.ndarray) -> np.ndarray:
        """Corners (N, 2) that are not where features are already."""
        if self._corners == 0:
            return np.zeros((0, 2))
        free = np.full(image.shape, 255, np.uint8)
        for u, v in np.rint(taken).astype(int).tolist():
            cv2.circle(free, (u, v), CORNER_DISTANCE_PX, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image, self._corners, CORNER_QUALITY, CORNER_DISTANCE_PX, mask=free
        )
        found = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        return found[np.isfinite(self._camera.undistort(found)).all(axis=1)]
