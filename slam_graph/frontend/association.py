# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Data association: the same points in another image, by pyramidal Lucas-Kanade."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.frontend.config import FrontendConfig

Image = NDArray[np.uint8]
Points = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Association:
    """Where points of one image are in another.

    Attributes:
        points: (N, 2) float32 pixels in the other image.
        found: (N,) whether Lucas-Kanade converged inside the image.
        consistent: (N,) whether tracking back also ends where it started; implies `found`.
    """

    points: Points
    found: Mask
    consistent: Mask
    error: object = None


class LucasKanade:
    """Pyramidal Lucas-Kanade (Bouguet 2000) with a forward-backward check (Kalal et al. 2010)."""

    def __init__(self, config: FrontendConfig) -> None:
        self._config = config
        self._criteria = (
            cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
            config.lk_iterations,
            config.lk_epsilon_px,
        )

    def associate(
        self,
        source: Image,
        target: Image,
        points: Points,
        guess: Points | None = None,
        levels: int | None = None,
    ) -> Association:
        """Find `points` of `source` in `target`.

        Args:
            source: (height, width) image.
            target: image of the same size.
            points: (N, 2) float32 pixels in `source`.
            guess: (N, 2) where to start in `target`; where they are in `source` if None.
            levels: of the pyramid; as configured if None.
        """
        if len(points) == 0:
            nothing = np.zeros(0, np.bool_)
            return Association(np.zeros((0, 2), np.float32), nothing, nothing, np.zeros(0))
        config = self._config
        levels = config.pyramid_levels if levels is None else levels
        start = points if guess is None else guess
        forward, found = self._lucas_kanade(source, target, points, start, levels)
        found &= inside(forward, target.shape, config.border_px)
        # The way back starts where it should end, so it needs no pyramid: what it tests is whether
        # the patch that was found is, seen from the other side, the patch that was looked for.
        back, returned = self._lucas_kanade(target, source, forward, points, config.backward_levels)
        error = np.linalg.norm(back - points, axis=1)
        return Association(forward, found, found & returned & (error < config.forward_backward_px), error)

    def _lucas_kanade(
        self, source: Image, target: Image, points: Points, start: Points, levels: int
    ) -> tuple[Points, Mask]:
        window = self._config.window_px
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points,
            start.copy(),  # it is overwritten
            winSize=(window, window),
            maxLevel=levels,
            criteria=self._criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=self._config.lk_min_eigenvalue,
        )
        return np.asarray(moved, np.float32), status[:, 0] == 1


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
