# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A first guess across cameras: a coarse search along epipolar lines by normalised correlation.

Lucas-Kanade finds its way over some pixels; the same point in two cameras that are 0.1 m apart and
0.5 m away is off by a hundred. The depth at which a small patch of the reduced images agrees best
is close enough.
"""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors.camera import Camera

Image = NDArray[np.uint8]
FloatArray = NDArray[np.float64]

HALVINGS = 2
"""The search runs on images of a quarter of the size."""

RADIUS = 3
"""Patches are (2 RADIUS + 1)² pixels of the reduced image."""

STEP_PX = 1.0
"""Largest distance, in the reduced image, between neighbouring candidates at the image centre."""


class EpipolarSearch:
    """Searches the depth of points of one camera in the image of another."""

    def __init__(self, camera: Camera, other_T_reference: gtsam.Pose3, min_depth_m: float) -> None:
        """Prepare the candidates.

        Args:
            camera: the one that is searched in.
            other_T_reference: pose of the reference camera in the frame of `camera`.
            min_depth_m: nearest candidate.
        """
        self._camera = camera
        self._R = other_T_reference.rotation().matrix()
        self._t = other_T_reference.translation()
        disparity_px = camera.fx * float(np.linalg.norm(self._t)) / min_depth_m
        count = int(disparity_px / (STEP_PX * 2**HALVINGS)) + 2
        self._inverse_depths = np.linspace(0.0, 1.0 / min_depth_m, count)
        steps = np.arange(-RADIUS, RADIUS + 1)
        self._patch = np.stack(np.meshgrid(steps, steps, indexing="ij")).reshape(2, -1)

    def project(self, normalized: FloatArray, inverse_depth_per_m: FloatArray) -> FloatArray:
        """Pixels in the other camera of points of the reference at given depths.

        Args:
            normalized: (..., 2) in the reference.
            inverse_depth_per_m: (...) 1 / z in the reference; 0 for points at infinity.

        Returns:
            (..., 2); what is not in front of the other camera comes out far off the image.
        """
        rays = np.concatenate([normalized, np.ones((*normalized.shape[:-1], 1))], axis=-1)
        points = rays @ self._R.T + self._t * inverse_depth_per_m[..., None]
        m = points[..., :2] / np.maximum(points[..., 2:], 1e-3)
        return self._camera.distort(m.reshape(-1, 2))[0].reshape(m.shape)

    def search(
        self, reference: Image, other: Image, pixels: NDArray[np.float32], normalized: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The depth at which each point looks most alike.

        Args:
            reference: image of the reference camera, reduced by `reduce`.
            other: image of the other camera, reduced likewise.
            pixels: (N, 2) full-size pixels in the reference.
            normalized: (N, 2) the same, undistorted.

        Returns:
            guess: (N, 2) full-size pixels in the other image.
            score: (N,) normalised cross-correlation there, in [-1, 1].
        """
        n, candidates = len(pixels), len(self._inverse_depths)
        targets = self.project(
            np.broadcast_to(normalized[:, None], (n, candidates, 2)),
            np.broadcast_to(self._inverse_depths, (n, candidates)),
        )
        wanted = self._patches(reference, pixels.astype(np.float64))
        offered = self._patches(other, targets.reshape(-1, 2)).reshape(n, candidates, -1)
        scores = np.einsum("np,ncp->nc", wanted, offered)
        height, width = other.shape
        scale = 2**HALVINGS
        outside = np.any((targets < 0) | (targets > (width * scale, height * scale)), axis=2)
        scores[outside] = -1.0
        best = np.argmax(scores, axis=1)
        rows = np.arange(n)
        return targets[rows, best], scores[rows, best].astype(np.float64)

    def _patches(self, image: Image, pixels: FloatArray) -> NDArray[np.float32]:
        """Patches (N, P) around full-size pixels (N, 2), of zero mean and unit norm."""
        height, width = image.shape
        # Pixel centres are at integers, so a reduced pixel u covers 4u - 1.5 … 4u + 1.5 of the full
        scale = 2**HALVINGS
        centre = np.rint((pixels + 0.5) / scale - 0.5)
        u = np.clip(centre[:, 0], RADIUS, width - 1 - RADIUS).astype(np.int64)
        v = np.clip(centre[:, 1], RADIUS, height - 1 - RADIUS).astype(np.int64)
        offsets = self._patch[0] * width + self._patch[1]
        patches = image.ravel()[(v * width + u)[:, None] + offsets].astype(np.float32)
        patches -= patches.mean(axis=1, keepdims=True)
        norm = np.sqrt(np.einsum("ij,ij->i", patches, patches))
        result: NDArray[np.float32] = patches / np.maximum(norm, 1e-6)[:, None]
        return result


def reduce(image: Image) -> Image:
    """An image of a quarter of the size, each pixel the mean of 4 x 4."""
    for _ in range(HALVINGS):
        # Halving twice is several times faster in OpenCV than the same in one step
        size = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image
