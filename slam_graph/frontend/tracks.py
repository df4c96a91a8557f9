# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a front end remembers of a camera: its last image and the features in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors.measurements import FeatureObservations

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Tracks:
    """The features of one camera.

    Attributes:
        image: the last image of the camera, equalised; None before the first one.
        ids: (N,) int64, increasing, so that older features come first.
        pixels: (N, 2) float32 in `image`.
        normalized: (N, 2) undistorted coordinates on the plane z = 1.
    """

    image: Image | None
    ids: NDArray[np.int64]
    pixels: NDArray[np.float32]
    normalized: NDArray[np.float64]

    @staticmethod
    def empty(image: Image | None = None) -> Tracks:
        """No features."""
        return Tracks(image, np.zeros(0, np.int64), np.zeros((0, 2), np.float32), np.zeros((0, 2)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: Mask) -> Tracks:
        """The features where `keep` (N,) is true."""
        return Tracks(self.image, self.ids[keep], self.pixels[keep], self.normalized[keep])

    def append(
        self, ids: NDArray[np.int64], pixels: NDArray[np.float32], normalized: NDArray[np.float64]
    ) -> Tracks:
        """The features and younger ones."""
        return Tracks(
            self.image,
            np.concatenate([self.ids, ids]),
            np.concatenate([self.pixels, pixels]),
            np.concatenate([self.normalized, normalized]),
        )

    def observations(self) -> FeatureObservations:
        """What the back end gets to see."""
        return FeatureObservations(
            self.ids.copy(), self.pixels.astype(np.float64), self.normalized.copy()
        )
