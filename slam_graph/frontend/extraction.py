# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Feature extraction: new corners where a grid over the image has too few."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import ConfigError
from slam_graph.frontend.config import FrontendConfig
from slam_graph.sensors.camera import WIDE, Camera

Image = NDArray[np.uint8]
Points = NDArray[np.float32]

REST_FRAMES = 3
"""A cell that could not be filled is left alone for so many frames: it would hardly be now."""

REACH = 2.75
"""Features of wide lenses lie less than 70° off the axis. On the plane z = 1, where matches are
tested and points triangulated, the noise of a pixel grows with 1 / cos²: by 9 at 70°, 33 at 80°."""

MARGIN_PX = 4
"""Cells are cut out with this margin, so that scores at their edge see the pixels beyond."""


@dataclass(frozen=True)
class Cell:
    """A cell of the grid: columns [left, right) and rows [top, bottom) of the image."""

    left: int
    top: int
    right: int
    bottom: int


class CornerExtractor:
    """Spreads corners over an image: every cell of a grid gets its share of the features."""

    def __init__(self, config: FrontendConfig, width: int, height: int, mask: Image | None) -> None:
        """Prepare the grid.

        Args:
            config: number of features, grid and detector.
            width: of the images in pixels.
            height: of the images in pixels.
            mask: (height, width), zero where no features are wanted; None for no such place.
        """
        self._config = config
        columns, rows = config.grid
        xs = np.linspace(0, width, columns + 1).astype(int)
        ys = np.linspace(0, height, rows + 1).astype(int)
        self._cells = [
            Cell(int(xs[i]), int(ys[j]), int(xs[i + 1]), int(ys[j + 1]))
            for j in range(rows)
            for i in range(columns)
        ]
        self._edges = xs, ys
        allowed = np.zeros((height, width), np.uint8)
        border = config.border_px
        allowed[border : height - border, border : width - border] = 255
        self._allowed = allowed if mask is None else np.where(mask >= 128, allowed, np.uint8(0))
        self._rest = np.zeros(len(self._cells), np.int64)
        self._share = -(-config.features // len(self._cells))
        # Thresholds to try one after the other: as configured, then half of it
        self._fast = [
            cv2.FastFeatureDetector.create(max(1, config.fast_threshold // divisor))
            for divisor in (1, 2)
        ]

    def allows(self, points: Points) -> NDArray[np.bool_]:
        """Which points (N, 2), all inside the image, the mask allows."""
        u, v = np.rint(points).astype(int).T
        result: NDArray[np.bool_] = self._allowed[v, u] > 0
        return result

    def extract(self, image: Image, occupied: Points) -> Points:
        """New corners (M, 2) that fill up the cells in which few of the `occupied` (N, 2) lie."""
        self._rest = np.maximum(self._rest - 1, 0)
        missing = self._config.features - len(occupied)
        if missing <= 0:
            return np.zeros((0, 2), np.float32)
        counts = self._count(occupied)
        emptiest_first = np.argsort(counts, kind="stable")
        # No cell rests while many features are missing, e.g. after the lens was covered
        awake = (self._rest == 0) | (2 * missing > self._config.features)
        wanting = (counts < self._share) & awake
        candidates = emptiest_first[wanting[emptiest_first]]
        free = self._free(occupied)
        found: list[Points] = []
        for i in candidates:
            count = min(missing, self._share - int(counts[i]))
            corners = self._corners(image, free, self._cells[i], count)
            if len(corners) < count:
                self._rest[i] = REST_FRAMES
            self._occupy(free, corners)
            found.append(corners)
            missing -= len(corners)
            if missing <= 0:
                break
        return np.concatenate(found) if found else np.zeros((0, 2), np.float32)

    def _count(self, points: Points) -> NDArray[np.int64]:
        """How many points (N, 2) lie in each cell."""
        xs, ys = self._edges
        columns, rows = self._config.grid
        column = np.clip(np.searchsorted(xs, points[:, 0], side="right") - 1, 0, columns - 1)
        row = np.clip(np.searchsorted(ys, points[:, 1], side="right") - 1, 0, rows - 1)
        return np.bincount(row * columns + column, minlength=columns * rows)

    def _free(self, occupied: Points) -> Image:
        """The mask of pixels where a new corner may lie."""
        free = self._allowed.copy()
        self._occupy(free, occupied)
        return free

    def _occupy(self, free: Image, points: Points) -> None:
        """Clear a disk around each point (N, 2) of a mask."""
        radius = round(self._config.min_distance_px)
        for u, v in np.rint(points).astype(int).tolist():
            cv2.circle(free, (u, v), radius, 0, cv2.FILLED)

    def _corners(self, image: Image, free: Image, cell: Cell, count: int) -> Points:
        """The best `count` corners of a cell, best first."""
        height, width = image.shape
        left, top = max(0, cell.left - MARGIN_PX), max(0, cell.top - MARGIN_PX)
        right, bottom = min(width, cell.right + MARGIN_PX), min(height, cell.bottom + MARGIN_PX)
        allowed = np.zeros((bottom - top, right - left), np.uint8)
        inner = np.s_[cell.top - top : cell.bottom - top, cell.left - left : cell.right - left]
        allowed[inner] = free[cell.top : cell.bottom, cell.left : cell.right]
        if not allowed.any():
            return np.zeros((0, 2), np.float32)
        patch = np.ascontiguousarray(image[top:bottom, left:right])
        pick = self._shi_tomasi if self._config.detector == "shi_tomasi" else self._fast_corners
        return pick(patch, allowed, count) + np.array([left, top], np.float32)

    def _shi_tomasi(self, patch: Image, allowed: Image, count: int) -> Points:
        config = self._config
        corners, scores = cv2.goodFeaturesToTrackWithQuality(
            patch,
            count,
            config.relative_corner_score,
            config.min_distance_px,
            allowed,
            blockSize=config.corner_window_px,
        )
        if corners is None:
            return np.zeros((0, 2), np.float32)
        strong = np.ravel(scores) >= config.min_corner_score
        return np.asarray(corners, np.float32).reshape(-1, 2)[strong]

    def _fast_corners(self, patch: Image, allowed: Image, count: int) -> Points:
        for detector in self._fast:
            keypoints = detector.detect(patch, allowed)
            if len(keypoints) >= count:
                break
        chosen: list[tuple[float, float]] = []
        gap = self._config.min_distance_px
        for k in sorted(keypoints, key=lambda k: -k.response):
            u, v = k.pt
            if all((u - x) ** 2 + (v - y) ** 2 >= gap * gap for x, y in chosen):
                chosen.append((u, v))
            if len(chosen) == count:
                break
        return np.array(chosen, np.float32).reshape(-1, 2)


def camera_mask(camera: Camera, path: Path | None, window_px: int) -> Image | None:
    """Where features of a camera may lie: as told, and where a wide lens can be used.

    Args:
        camera: its model.
        path: image that is zero where no features are wanted, or None.
        window_px: side of the window that is tracked. It stays inside what can be used: where a
            lens shows nothing beyond, the rim is an edge that moves with the camera.

    Returns:
        (height, width), zero where no features may lie; None for no such place.

    Raises:
        ConfigError: if the image is not there, or does not fit the camera.
    """
    mask = None if path is None else read_mask(path, camera.width, camera.height)
    if camera.distortion not in WIDE:
        return mask
    visible = np.where(camera.visible_mask(REACH), np.uint8(255), np.uint8(0))
    inside = np.asarray(cv2.erode(visible, np.ones((window_px, window_px), np.uint8)), np.uint8)
    return inside if mask is None else np.minimum(mask, inside)


def read_mask(path: Path, width: int, height: int) -> Image:
    """Read the mask of a camera.

    Raises:
        ConfigError: if it is missing, unreadable, or not of the size of the camera's images.
    """
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise ConfigError(f"{path}: the mask of a camera is missing or not a readable image")
    if image.shape != (height, width):
        raise ConfigError(
            f"{path}: the mask is {image.shape[1]}x{image.shape[0]}, "
            f"the camera's images are {width}x{height}"
        )
    return np.asarray(image, np.uint8)
