# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A detector: blobs at one scale."""

import cv2
import numpy as np

from slam_graph.frontend import FrontendConfig, Image, Keypoints

SIGMA_PX = 2.0
MIN_SCORE = 2.0


class LaplacianBlobs:
    """Extrema of the Laplacian of a Gaussian (Lindeberg 1998)."""

    local = True  # it may be given single cells of the image

    def __init__(self, config: FrontendConfig) -> None:
        """Nothing of the settings is needed."""

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The strongest blobs, best first."""
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SIGMA_PX)
        strength = np.abs(cv2.Laplacian(smooth, cv2.CV_32F))
        largest = cv2.dilate(strength, np.ones((5, 5), np.uint8))
        v, u = np.nonzero((strength == largest) & (strength > MIN_SCORE) & (allowed > 0))
        best = np.argsort(-strength[v, u], kind="stable")
        pixels = np.column_stack([u, v])[best].astype(np.float32)
        return Keypoints.of(pixels, strength[v, u][best], 2.0 * SIGMA_PX)
