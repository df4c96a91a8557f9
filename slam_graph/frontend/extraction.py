# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Feature extraction: new keypoints where a grid over the image has too few."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.errors import ConfigError
from slam_graph.frontend.detectors import DETECTORS, refine
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.keypoints import Indices, Keypoints, Mask, Points, spread
from slam_graph.frontend.tracked_features import Image
from slam_graph.sensors.camera import Camera

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


@dataclass(frozen=True, eq=False)
class Extracted:
    """New points, in groups of one cell each.

    Attributes:
        points: (N, 2) float32 pixels, the best of a group first.
        group: (N,) ascending number of each one's group.
        quotas: (G,) how many of each group are wanted.
    """

    points: Points
    group: Indices
    quotas: Indices

    def within_quotas(self, good: Mask) -> Mask:
        """The first of the good points (N,) of each group, as many as are wanted."""
        count = np.cumsum(good)
        before = np.concatenate([[0], count])[np.searchsorted(self.group, self.group)]
        wanted: Mask = good & (count - before <= self.quotas[self.group])
        return wanted


class CornerExtractor:
    """Spreads keypoints over an image: every cell of a grid gets its share of the features."""

    def __init__(self, config: FrontendConfig, width: int, height: int, mask: Image | None) -> None:
        """Prepare the grid.

        Args:
            config: number of features, grid and detector.
            width: of the images in pixels.
            height: of the images in pixels.
            mask: (height, width), zero where no features are wanted; None for no such place.

        Raises:
            ConfigError: if the detector needs a library that is not installed.
        """
        self._config = config
        self._detector = DETECTORS[config.detector_name](config)
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

    def allows(self, points: Points) -> Mask:
        """Which points (N, 2), all inside the image, the mask allows."""
        u, v = np.rint(points).astype(int).T
        result: Mask = self._allowed[v, u] > 0
        return result

    def extract(self, image: Image, occupied: Points, surplus: int = 1) -> Extracted:
        """New points that fill up the cells in which few of the `occupied` (N, 2) lie.

        Args:
            image: to look at.
            occupied: features that are there.
            surplus: so many times the points that are wanted, if not all will do.
        """
        free = self._free(occupied)
        found: list[Points] = []
        quotas: list[int] = []
        missing = self._config.features - len(occupied)
        whole: Keypoints | None = None
        for i, share in self._wanted(occupied):
            quota = min(missing, share)
            cell = self._cells[i]
            if self._detector.local:
                best = self._in_cell(image, free, cell, surplus * quota)
            else:
                whole = self._whole(image, free) if whole is None else whole
                best = whole.select(_inside(whole.pixels, cell))
            best = best.select(self._still_free(free, best.pixels))
            chosen = spread(best.pixels, surplus * quota, self._config.min_distance_px)
            pixels = best.pixels[chosen]
            if len(pixels) < quota:
                self._rest[i] = REST_FRAMES
            self._occupy(free, pixels)
            found.append(pixels)
            quotas.append(quota)
            missing -= min(quota, len(pixels))
            if missing <= 0:
                break
        pixels = np.concatenate([np.zeros((0, 2), np.float32), *found])
        if self._config.subpixel:
            pixels = refine(image, pixels)
        group = np.repeat(np.arange(len(found)), [len(part) for part in found])
        return Extracted(pixels, group, np.array(quotas, np.int64))

    def candidates(self, image: Image, count: int) -> Keypoints:
        """Keypoints all over the image, whatever is there already: what matching chooses from.

        Args:
            image: to look at.
            count: about so many, spread over the grid.
        """
        share = -(-count // len(self._cells))
        whole = None if self._detector.local else self._whole(image, self._allowed)
        found: list[Keypoints] = []
        for cell in self._cells:
            if whole is None:
                best = self._in_cell(image, self._allowed, cell, share)
            else:
                best = whole.select(_inside(whole.pixels, cell))
            found.append(best.select(spread(best.pixels, share, self._config.min_distance_px)))
        keypoints = Keypoints.concatenate(found)
        return keypoints.at(refine(image, keypoints.pixels)) if self._config.subpixel else keypoints

    def fill(self, keypoints: Keypoints, occupied: Points) -> NDArray[np.int64]:
        """Which keypoints (M,) fill up the cells in which few of the `occupied` (N, 2) lie."""
        free = self._free(occupied)
        chosen: list[int] = []
        missing = self._config.features - len(occupied)
        for i, share in self._wanted(occupied):
            inside = np.flatnonzero(_inside(keypoints.pixels, self._cells[i]))
            inside = inside[self._still_free(free, keypoints.pixels[inside])]
            inside = inside[np.argsort(-keypoints.scores[inside], kind="stable")]
            pixels = keypoints.pixels[inside]
            best = inside[spread(pixels, min(missing, share), self._config.min_distance_px)]
            self._occupy(free, keypoints.pixels[best])
            chosen += best.tolist()
            missing -= len(best)
            if missing <= 0:
                break
        return np.array(chosen, np.int64)

    def _wanted(self, occupied: Points) -> list[tuple[int, int]]:
        """The cells that want features, emptiest first, and how many each wants."""
        self._rest = np.maximum(self._rest - 1, 0)
        missing = self._config.features - len(occupied)
        if missing <= 0:
            return []
        counts = self._count(occupied)
        emptiest_first = np.argsort(counts, kind="stable")
        # No cell rests while many features are missing, e.g. after the lens was covered
        awake = (self._rest == 0) | (2 * missing > self._config.features)
        wanting = (counts < self._share) & awake
        return [(int(i), self._share - int(counts[i])) for i in emptiest_first if wanting[i]]

    def _count(self, points: Points) -> NDArray[np.int64]:
        """How many points (N, 2) lie in each cell."""
        xs, ys = self._edges
        columns, rows = self._config.grid
        column = np.clip(np.searchsorted(xs, points[:, 0], side="right") - 1, 0, columns - 1)
        row = np.clip(np.searchsorted(ys, points[:, 1], side="right") - 1, 0, rows - 1)
        return np.bincount(row * columns + column, minlength=columns * rows)

    def _free(self, occupied: Points) -> Image:
        """The mask of pixels where a new point may lie."""
        free = self._allowed.copy()
        self._occupy(free, occupied)
        return free

    def _occupy(self, free: Image, points: Points) -> None:
        """Clear a disk around each point (N, 2) of a mask."""
        radius = round(self._config.min_distance_px)
        for u, v in np.rint(points).astype(int).tolist():
            cv2.circle(free, (u, v), radius, 0, cv2.FILLED)

    def _still_free(self, free: Image, points: Points) -> Mask:
        """Which points (N, 2), all inside the image, have not been taken by a neighbouring cell."""
        u, v = np.rint(points).astype(int).T
        height, width = free.shape
        result: Mask = free[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] > 0
        return result

    def _whole(self, image: Image, allowed: Image) -> Keypoints:
        """Everything that a detector finds that looks at the image as a whole, best first."""
        return self._detector.detect(image, allowed, 2 * self._config.features)

    def _in_cell(self, image: Image, free: Image, cell: Cell, count: int) -> Keypoints:
        """The best keypoints of a cell, best first."""
        height, width = image.shape
        left, top = max(0, cell.left - MARGIN_PX), max(0, cell.top - MARGIN_PX)
        right, bottom = min(width, cell.right + MARGIN_PX), min(height, cell.bottom + MARGIN_PX)
        allowed = np.zeros((bottom - top, right - left), np.uint8)
        inner = np.s_[cell.top - top : cell.bottom - top, cell.left - left : cell.right - left]
        allowed[inner] = free[cell.top : cell.bottom, cell.left : cell.right]
        if not allowed.any():
            return Keypoints.concatenate([])
        patch = np.ascontiguousarray(image[top:bottom, left:right])
        found = self._detector.detect(patch, allowed, count)
        return found.at(found.pixels + np.array([left, top], np.float32))


def _inside(pixels: Points, cell: Cell) -> Mask:
    """Which points (N, 2) lie in a cell."""
    u, v = pixels[:, 0], pixels[:, 1]
    result: Mask = (u >= cell.left) & (u < cell.right) & (v >= cell.top) & (v < cell.bottom)
    return result


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
    if not camera.model.sees_sideways:
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
