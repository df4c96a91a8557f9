# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Data association, the protocol: the same points in the next image, by tracking or matching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.frontend.keypoints import Image, Pixels, Tracks
from slam_graph.frontend.prediction import Prediction


@dataclass(frozen=True, eq=False)
class Association:
    """Where features are in the next image.

    Attributes:
        points: (N, 2) float32 pixels there.
        good: (N,) whether a feature was found.
        lost: for each cause, which features (N,) were lost by it.
    """

    points: Pixels
    good: BoolArray
    lost: dict[str, BoolArray]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points that may become new features.

    Attributes:
        points: (M, 2) float32 pixels in the new image.
        origins: (M, 2) float32 pixels in the image before; None if they were not looked for there.
        tolerance_scale: their largest epipolar distance, relative to that of tracked features.
    """

    points: Pixels
    origins: Pixels | None
    tolerance_scale: float = 1.0


class Associator(Protocol):
    """Finds the features of one camera in its next image, and new ones there.

    For each image `follow`, `recover`, `propose` and `accept` are called in this order, and after
    them `corners` and `accept_corners` where an object moves.
    """

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Association:
        """Find features in the next image.

        Args:
            before: features of the image before.
            image: the next one.
            guess: where to look first.
        """
        ...

    def recover(self, before: Tracks, after: Tracks) -> tuple[IntArray, Pixels]:
        """Features that were lost in an earlier image, or were missed in this one, and are found.

        Args:
            before: features of the image before.
            after: those of them that were found and have passed all tests.

        Returns:
            ids: (M,) ascending.
            points: (M, 2) pixels.
        """
        ...

    def propose(self, before: Tracks, after: Tracks, verify: bool) -> Candidates:
        """Candidates for new features where there are few.

        Args:
            before: features of the image before.
            after: all features of the new image so far.
            verify: whether candidates must be found in the image before too.
        """
        ...

    def accept(self, ids: IntArray, chosen: BoolArray) -> None:
        """Some candidates have become features.

        Args:
            ids: (K,) of the new features.
            chosen: (M,) which of the candidates proposed last they are.
        """
        ...

    def corners(self, image: Image, mask: Image, count: int, distance_px: float) -> Pixels:
        """Places (N, 2) that can be followed from the new image on, the best first.

        Args:
            image: the new one.
            mask: (height, width), zero where they are not wanted.
            count: most that are wanted.
            distance_px: least distance between two of them.
        """
        ...

    def accept_corners(self, ids: IntArray, points: Pixels) -> None:
        """Some of these places (M, 2) have become features with ids (M,)."""
        ...

    def forget(self, ids: IntArray) -> None:
        """Do not look for these features any more."""
        ...


def inside(points: Pixels, shape: tuple[int, ...], border_px: int) -> BoolArray:
    """Which points (N, 2) lie in an image of `shape` (height, width), `border_px` from its edge."""
    u, v = points[:, 0], points[:, 1]
    height, width = shape[:2]
    result: BoolArray = (
        (u >= border_px)
        & (v >= border_px)
        & (u <= width - 1 - border_px)
        & (v <= height - 1 - border_px)
    )
    return result
