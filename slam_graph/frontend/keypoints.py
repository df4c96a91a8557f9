# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Points of an image: the keypoints of a detector, and the tracked features of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.sensors import FeatureObservations

Image = NDArray[np.uint8]
"""(height, width), grey."""

Pixels = NDArray[np.float32]
"""(N, 2) coordinates (u, v); the centres of pixels are at integers."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image, as arrays.

    Attributes:
        pixels: (N, 2) float32 (u, v).
        scores: (N,) strength; comparable within one detector only.
        sizes_px: (N,) diameter of the corner or blob.
        angles_deg: (N,) orientation as OpenCV counts it; 0 where the detector has none, which
            leaves descriptors upright.
        octaves: (N,) pyramid level, in the detector's own numbering; 0 is the image itself.
    """

    pixels: Pixels
    scores: NDArray[np.float32]
    sizes_px: NDArray[np.float32]
    angles_deg: NDArray[np.float32]
    octaves: NDArray[np.int32]

    @staticmethod
    def of(pixels: Pixels, scores: NDArray[np.float32], size_px: float) -> Keypoints:
        """Corners of the image itself, all of one size, without an orientation."""
        n = len(pixels)
        sizes_px = np.empty(n, np.float32)
        sizes_px.fill(size_px)  # `np.full` takes three times as long, and there are many cells
        return Keypoints(
            np.asarray(pixels, np.float32).reshape(-1, 2),
            np.asarray(scores, np.float32),
            sizes_px,
            np.zeros(n, np.float32),
            np.zeros(n, np.int32),
        )

    @staticmethod
    def from_opencv(keypoints: Sequence[cv2.KeyPoint]) -> Keypoints:
        """What an OpenCV detector returns."""
        rows = np.array(
            [(*k.pt, k.response, k.size, max(k.angle, 0.0)) for k in keypoints], np.float32
        ).reshape(-1, 5)
        octaves = np.array([k.octave for k in keypoints], np.int32)
        return Keypoints(rows[:, :2].copy(), rows[:, 2], rows[:, 3], rows[:, 4], octaves)

    @staticmethod
    def concatenate(parts: Sequence[Keypoints]) -> Keypoints:
        """Several sets of keypoints joined, in their order."""
        if not parts:
            return Keypoints.of(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), 0.0)
        return Keypoints(
            np.concatenate([k.pixels for k in parts]),
            np.concatenate([k.scores for k in parts]),
            np.concatenate([k.sizes_px for k in parts]),
            np.concatenate([k.angles_deg for k in parts]),
            np.concatenate([k.octaves for k in parts]),
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, which: BoolArray | IntArray) -> Keypoints:
        """Those where a mask (N,) is true, or those with given indices."""
        return Keypoints(
            self.pixels[which],
            self.scores[which],
            self.sizes_px[which],
            self.angles_deg[which],
            self.octaves[which],
        )

    def at(self, pixels: Pixels) -> Keypoints:
        """The same keypoints at other pixels (N, 2)."""
        return Keypoints(
            np.asarray(pixels, np.float32),
            self.scores,
            self.sizes_px,
            self.angles_deg,
            self.octaves,
        )

    def to_opencv(self) -> list[cv2.KeyPoint]:
        """For an OpenCV descriptor; `class_id` is the index."""
        rows = zip(
            self.pixels.tolist(),
            self.sizes_px.tolist(),
            self.angles_deg.tolist(),
            self.scores.tolist(),
            self.octaves.tolist(),
            strict=True,
        )
        return [
            cv2.KeyPoint(u, v, size, angle, score, octave, index)
            for index, ((u, v), size, angle, score, octave) in enumerate(rows)
        ]


@dataclass(frozen=True, eq=False)
class Tracks:
    """The features of one camera, and the image that they were last seen in.

    Attributes:
        image: the last image of the camera, equalised; None before the first one.
        stamp_ns: its time.
        ids: (N,) int64, increasing, so that older features come first.
        pixels: (N, 2) float32 in `image`.
        normalized: (N, 2) undistorted coordinates on the plane z = 1.
        residual_flow: (N, 2) velocity of `normalized` in 1/s without the part that the rotation of
            the camera explains; NaN where it is not known.
    """

    image: Image | None
    stamp_ns: int
    ids: IntArray
    pixels: Pixels
    normalized: FloatArray
    residual_flow: FloatArray

    @staticmethod
    def of(
        image: Image | None,
        stamp_ns: int,
        ids: IntArray,
        pixels: Pixels,
        normalized: FloatArray,
    ) -> Tracks:
        """Features whose residual flow is not known."""
        unknown = np.empty((len(ids), 2))
        unknown.fill(np.nan)  # a third of the time of `np.full`
        return Tracks(image, stamp_ns, ids, pixels, normalized, unknown)

    @staticmethod
    def empty(image: Image | None = None, stamp_ns: int = 0) -> Tracks:
        """No features."""
        nothing = np.zeros((0, 2))
        return Tracks.of(
            image, stamp_ns, np.zeros(0, np.int64), nothing.astype(np.float32), nothing
        )

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: BoolArray | IntArray) -> Tracks:
        """Those where a mask `keep` (N,) is true, or those with given indices."""
        # `take` needs a third of the time of an index that is a mask
        rows = keep.nonzero()[0] if keep.dtype == np.bool_ else keep
        return Tracks(
            self.image,
            self.stamp_ns,
            self.ids.take(rows),
            self.pixels.take(rows, axis=0),
            self.normalized.take(rows, axis=0),
            self.residual_flow.take(rows, axis=0),
        )

    def joined(self, other: Tracks) -> Tracks:
        """These features and others, in the order of their ids; both must be in that order."""
        if len(other) == 0:
            return self
        ids = np.concatenate([self.ids, other.ids])
        both = Tracks(
            self.image,
            self.stamp_ns,
            ids,
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.normalized, other.normalized]),
            np.concatenate([self.residual_flow, other.residual_flow]),
        )
        if len(self) == 0 or self.ids[-1] < other.ids[0]:  # as new ones are
            return both
        return both.select(ids.argsort(kind="stable"))

    def common(self, other: Tracks) -> tuple[IntArray, IntArray]:
        """Indices here and there (M,) of the features in both."""
        if len(other) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        there = other.ids.searchsorted(self.ids)
        here = (other.ids.take(there, mode="clip") == self.ids).nonzero()[0]
        return here, there[here]

    def observations(self) -> FeatureObservations:
        """As the back end receives them."""
        return FeatureObservations(
            self.ids.copy(), self.pixels.astype(np.float64), self.normalized.copy()
        )


NO_TRACKS = Tracks.empty()
"""No features, of no image."""


def spread(pixels: Pixels, count: int, distance_px: float) -> IntArray:
    """Non-maximum suppression: the first `count` points that keep their distance from one another.

    Args:
        pixels: (N, 2), best first.
        count: most that are wanted.
        distance_px: smallest distance between two of them.

    Returns:
        (M,) indices, ascending.
    """
    chosen: list[int] = []
    taken = np.zeros(len(pixels), np.bool_)
    while len(chosen) < count:
        left = np.flatnonzero(~taken)
        if len(left) == 0:
            break
        best = int(left[0])
        chosen.append(best)
        taken |= np.sum((pixels - pixels[best]) ** 2, axis=1) < distance_px**2
        taken[best] = True
    return np.array(chosen, np.int64)


def contiguous(image: Image) -> Image:
    """The image as kernels take it, contiguous and writable: itself if it is, otherwise a copy."""
    flags = image.flags
    if flags.c_contiguous and flags.writeable:  # as it mostly is; `require` takes longer to see it
        return image
    return np.require(image, requirements=("C", "W"))
