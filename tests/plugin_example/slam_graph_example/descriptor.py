# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A descriptor: the grey levels around a keypoint."""

import cv2
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.frontend import Image, Keypoints
from slam_graph.frontend.descriptors import Vectors

SIDE_PX = 11


class Patch:
    """A small patch of zero mean and unit norm, compared by Euclidean distance."""

    max_distance = 0.7

    def describe(self, image: Image, keypoints: Keypoints) -> tuple[IntArray, Vectors]:
        """Describe what is far enough from the edge."""
        height, width = image.shape
        u, v = keypoints.pixels.T
        margin = SIDE_PX / 2
        kept = np.flatnonzero(
            (u > margin) & (v > margin) & (u < width - margin) & (v < height - margin)
        )
        vectors = np.zeros((len(kept), SIDE_PX**2), np.float32)
        for row, pixel in zip(vectors, keypoints.pixels[kept].tolist(), strict=True):
            patch = cv2.getRectSubPix(image, (SIDE_PX, SIDE_PX), pixel).astype(np.float32)
            patch -= patch.mean()
            row[:] = patch.ravel() / max(float(np.linalg.norm(patch)), 1e-6)
        return kept, vectors
