# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Data association: the same points in another image. The protocol of both families of methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam_graph.frontend.keypoints import Mask, Points
from slam_graph.frontend.prediction import Prediction
from slam_graph.frontend.tracked_features import Image, Tracks


@dataclass(frozen=True, eq=False)
class Match:
    """What became of features in the next image.

    Attributes:
        points: (N, 2) float32 pixels there.
        good: (N,) whether a feature was found.
        fates: (N,) which of the others were lost, by cause.
    """

    points: Points
    good: Mask
    fates: dict[str, Mask]


@dataclass(frozen=True, eq=False)
class Births:
    """Features that could be new.

    Attributes:
        points: (M, 2) float32 pixels in the new image.
        origins: (M, 2) float32 pixels in the image before, or None if they were not looked for.
        share: their epipolar distance must be below this share of what is allowed to others.
    """

    points: Points
    origins: Points | None
    share: float = 1.0


class Associator(Protocol):
    """Finds the features of one camera in its next image, and new ones there.

    For each image `follow`, `recover`, `births` and `adopt` are called in this order.
    """

    def follow(self, before: Tracks, image: Image, guess: Prediction) -> Match:
        """Find features in the next image.

        Args:
            before: of the image before.
            image: the next one.
            guess: where to look first.
        """
        ...

    def recover(self, before: Tracks, after: Tracks) -> tuple[NDArray[np.int64], Points]:
        """Features that were lost and are seen again, or were missed at first.

        Args:
            before: features of the image before.
            after: those of them that were found and have passed all tests.

        Returns:
            ids: (M,) ascending.
            points: (M, 2) pixels.
        """
        ...

    def births(self, before: Tracks, after: Tracks, verify: bool) -> Births:
        """Candidates for new features where there are few, found in the image before too.

        Args:
            before: features of the image before.
            after: all features of the new image so far.
            verify: whether to look for them in the image before.
        """
        ...

    def adopt(self, ids: NDArray[np.int64], chosen: Mask) -> None:
        """The last births (M,) that were `chosen` have become features with these ids (K,)."""
        ...

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Do not look for some features any more."""
        ...


def inside(points: Points, shape: tuple[int, ...], border_px: int) -> Mask:
    """Which points (N, 2) lie in an image of `shape` (height, width), `border_px` from its edge."""
    u, v = points[:, 0], points[:, 1]
    height, width = shape[:2]
    result: Mask = (
        (u >= border_px)
        & (v >= border_px)
        & (u <= width - 1 - border_px)
        & (v <= height - 1 - border_px)
    )
    return result
