# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a front end remembers of a camera: its last image and the features in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.sensors.measurements import FeatureObservations

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Tracks:
    """The features of one camera.

    Attributes:
        image: the last image of the camera, equalised; None before the first one.
        stamp_ns: its time.
        ids: (N,) int64, increasing, so that older features come first.
        pixels: (N, 2) float32 in `image`.
        normalized: (N, 2) undistorted coordinates on the plane z = 1.
        drift: (N, 2) velocity of `normalized` in 1/s beyond what the rotation of the camera makes;
            NaN where it is not known.
    """

    image: Image | None
    stamp_ns: int
    ids: NDArray[np.int64]
    pixels: NDArray[np.float32]
    normalized: FloatArray
    drift: FloatArray

    @staticmethod
    def of(
        image: Image | None,
        stamp_ns: int,
        ids: NDArray[np.int64],
        pixels: NDArray[np.float32],
        normalized: FloatArray,
    ) -> Tracks:
        """Features whose velocity is not known."""
        return Tracks(image, stamp_ns, ids, pixels, normalized, np.full((len(ids), 2), np.nan))

    @staticmethod
    def empty(image: Image | None = None, stamp_ns: int = 0) -> Tracks:
        """No features."""
        nothing = np.zeros((0, 2))
        return Tracks.of(
            image, stamp_ns, np.zeros(0, np.int64), nothing.astype(np.float32), nothing
        )

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: Mask | NDArray[np.int64]) -> Tracks:
        """The features where `keep` (N,) is true, or with some indices."""
        return replace(
            self,
            ids=self.ids[keep],
            pixels=self.pixels[keep],
            normalized=self.normalized[keep],
            drift=self.drift[keep],
        )

    def joined(self, other: Tracks) -> Tracks:
        """These features and others, in the order of their ids."""
        ids = np.concatenate([self.ids, other.ids])
        order = np.argsort(ids, kind="stable")
        return replace(
            self,
            ids=ids[order],
            pixels=np.concatenate([self.pixels, other.pixels])[order],
            normalized=np.concatenate([self.normalized, other.normalized])[order],
            drift=np.concatenate([self.drift, other.drift])[order],
        )

    def common(self, other: Tracks) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices here and there (M,) of the features in both."""
        _, here, there = np.intersect1d(
            self.ids, other.ids, assume_unique=True, return_indices=True
        )
        return here, there

    def observations(self) -> FeatureObservations:
        """What the back end gets to see."""
        return FeatureObservations(
            self.ids.copy(), self.pixels.astype(np.float64), self.normalized.copy()
        )
