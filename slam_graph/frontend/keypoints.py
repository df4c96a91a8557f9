# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints: where a detector found something, and how large and how strong it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Places in an image, as arrays.

    Attributes:
        pixels: (N, 2) float32 (u, v).
        scores: (N,) strength; comparable within one detector only.
        sizes_px: (N,) diameter of what was found.
        angles_deg: (N,) orientation as OpenCV counts it; 0 where the detector has none, which
            leaves descriptors upright.
        octaves: (N,) the detector's own numbers of pyramid levels; 0 is the image itself.
    """

    pixels: Points
    scores: NDArray[np.float32]
    sizes_px: NDArray[np.float32]
    angles_deg: NDArray[np.float32]
    octaves: NDArray[np.int32]

    @staticmethod
    def of(pixels: Points, scores: NDArray[np.float32], size_px: float) -> Keypoints:
        """Corners of the image itself, all of one size, without an orientation."""
        n = len(pixels)
        return Keypoints(
            np.asarray(pixels, np.float32).reshape(-1, 2),
            np.asarray(scores, np.float32),
            np.full(n, size_px, np.float32),
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
        """All of some keypoints, in their order."""
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

    def select(self, which: Mask | Indices) -> Keypoints:
        """Those where a mask (N,) is true, or with some indices."""
        return Keypoints(
            self.pixels[which],
            self.scores[which],
            self.sizes_px[which],
            self.angles_deg[which],
            self.octaves[which],
        )

    def at(self, pixels: Points) -> Keypoints:
        """The same ones in other places (N, 2)."""
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


def spread(pixels: Points, count: int, distance_px: float) -> Indices:
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
