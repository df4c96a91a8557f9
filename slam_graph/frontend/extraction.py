# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Feature extraction: keypoints spread over the image by a grid, and the masks of cameras."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from slam_graph.arrays import BoolArray, IntArray
from slam_graph.errors import ConfigError
from slam_graph.frontend.detectors import CellDetector, refine
from slam_graph.frontend.frontend_config import DETECTORS, FrontendConfig
from slam_graph.frontend.keypoints import Image, Keypoints, Pixels, spread
from slam_graph.image_files import ImageFile
from slam_graph.kernels.spacing import claim, clear_disks, in_mask
from slam_graph.sensors import Camera

BORDER_PX = 5
"""Features are neither found nor kept within this distance of the edge of the image, where the
windows of detectors and descriptors are cut."""

_REST_FRAMES = 3
"""Frames for which a cell is skipped that could not be filled: it hardly could be in the next."""

_MARGIN_PX = 4
"""Cells are cut out with this margin, so that scores at their edge see the pixels beyond."""


_Part = tuple[slice, slice]
"""Rows and columns of an image."""


@dataclass(frozen=True, eq=False)
class _Cell:
    """A cell of the grid: columns [left, right) and rows [top, bottom) of the image.

    Attributes:
        own: rows and columns of the cell in the image.
        around: the same with a margin of 4 px, as far as the image reaches.
        inner: rows and columns of the cell in `around`.
        origin: (2,) first pixel (u, v) of `around`.
    """

    left: int
    top: int
    right: int
    bottom: int
    own: _Part
    around: _Part
    inner: _Part
    origin: Pixels

    @staticmethod
    def of(columns: tuple[int, int], rows: tuple[int, int], shape: tuple[int, int]) -> _Cell:
        """The cell of some columns and rows of an image of a shape (height, width)."""
        (left, right), (top, bottom), (height, width) = columns, rows, shape
        u, v = max(0, left - _MARGIN_PX), max(0, top - _MARGIN_PX)
        last_u, last_v = min(width, right + _MARGIN_PX), min(height, bottom + _MARGIN_PX)
        own = slice(top, bottom), slice(left, right)
        around = slice(v, last_v), slice(u, last_u)
        inner = slice(top - v, bottom - v), slice(left - u, right - u)
        origin = np.array([u, v], np.float32)
        return _Cell(left, top, right, bottom, own, around, inner, origin)


@dataclass(frozen=True, eq=False)
class _Extracted:
    """New points, grouped by cell.

    Attributes:
        points: (N, 2) float32 pixels, the best of a group first.
        group: (N,) index of the group of each point, ascending.
        quotas: (G,) how many points of each group are wanted.
    """

    points: Pixels
    group: IntArray
    quotas: IntArray

    def within_quotas(self, good: BoolArray) -> BoolArray:
        """Of the good points (N,) of each group the first ones, as many as are wanted."""
        count = good.cumsum()
        before = (count - good)[self.group.searchsorted(self.group)]  # of the first of the group
        wanted: BoolArray = good & (count - before <= self.quotas[self.group])
        return wanted


class FeatureExtractor:
    """Spreads keypoints over an image: every cell of a grid gets its share of the features.

    Args:
        config: number of features, grid and detector.
        width: of the images in pixels.
        height: of the images in pixels.
        mask: (height, width), zero where no features are wanted; None for no such place.
        distance_px: least distance of two features; that of the settings if None.

    Raises:
        ConfigError: if the detector needs a library that is not installed.
    """

    def __init__(
        self,
        config: FrontendConfig,
        width: int,
        height: int,
        mask: Image | None,
        distance_px: float | None = None,
    ) -> None:
        self._config = config
        self._distance_px = config.min_distance_px if distance_px is None else distance_px
        self._detector = DETECTORS[config.detector_name](config)
        self._by_cells = self._detector if isinstance(self._detector, CellDetector) else None
        columns, rows = config.grid
        xs = np.linspace(0, width, columns + 1).astype(int)
        ys = np.linspace(0, height, rows + 1).astype(int)
        self._cells = [
            _Cell.of(across, down, (height, width))
            for down in pairwise(ys.tolist())
            for across in pairwise(xs.tolist())
        ]
        self._bounds = np.array([(c.left, c.top, c.right, c.bottom) for c in self._cells], np.int64)
        # borders between cells, of the type of pixels: they need not be converted for each search
        self._edges = xs[1:-1].astype(np.float32), ys[1:-1].astype(np.float32)
        allowed = np.zeros((height, width), np.uint8)
        allowed[BORDER_PX : height - BORDER_PX, BORDER_PX : width - BORDER_PX] = 255
        self._allowed = allowed if mask is None else np.where(mask >= 128, allowed, np.uint8(0))
        self._room = np.empty((height, width), np.uint8)
        self._half_widths = _disk(round(self._distance_px))
        self._rest = np.zeros(len(self._cells), np.int64)
        self._apart: Pixels = np.zeros((0, 2), np.float32)

    def allows(self, points: Pixels) -> BoolArray:
        """Which points (N, 2) the mask allows; none outside of the image."""
        return in_mask(self._allowed, np.ascontiguousarray(points, np.float32))

    def count_apart(self, points: Pixels) -> None:
        """Do not count some of the features (N, 2): they move, and say nothing of the platform.

        Without this a moving object that fills the view would leave it few static features. As many
        as else in the whole image are found in the cells where the static ones are in the majority.
        """
        self._apart = points

    def extract(self, image: Image, occupied: Pixels, surplus: int = 1) -> _Extracted:
        """Detect new points in the cells that have few features.

        Args:
            image: where to detect them.
            occupied: (N, 2) features that are there.
            surplus: factor on the number of points, for callers that will reject some.
        """
        cells, shares = self._wanted(occupied)
        if self._by_cells is not None:
            pixels, counts, quotas = self._by_cells.detect_in_cells(
                image,
                self._free(occupied),
                self._bounds.take(cells, axis=0),
                _MARGIN_PX,
                shares,
                self._missing(occupied),
                surplus,
                self._distance_px,
                self._half_widths,
            )
        else:
            pixels, counts, quotas = self._one_by_one(image, occupied, cells, shares, surplus)
        visited = cells[: len(counts)]
        self._rest[visited[counts < quotas]] = _REST_FRAMES
        if self._config.subpixel:
            pixels = refine(image, pixels)
        return _Extracted(pixels, np.arange(len(counts)).repeat(counts), quotas)

    def _one_by_one(
        self, image: Image, occupied: Pixels, cells: IntArray, shares: IntArray, surplus: int
    ) -> tuple[Pixels, IntArray, IntArray]:
        """`CellDetector.detect_in_cells` for other detectors."""
        free, missing = self._free(occupied), self._missing(occupied)
        found, quotas = [np.zeros((0, 2), np.float32)], []
        whole: Keypoints | None = None
        for i, share in zip(cells.tolist(), shares.tolist(), strict=True):
            quota = min(missing, share)
            cell = self._cells[i]
            if self._detector.local:
                best = self._in_cell(image, free, cell, surplus * quota).pixels + cell.origin
            else:
                whole = self._whole(image, free) if whole is None else whole
                best = whole.pixels[_inside(whole.pixels, cell)]
            found.append(best[self._claim(free, best, surplus * quota)])
            quotas.append(quota)
            missing -= min(quota, len(found[-1]))
            if missing <= 0:
                break
        counts = np.array([len(pixels) for pixels in found[1:]], np.int64)
        return np.concatenate(found), counts, np.array(quotas, np.int64)

    def candidates(self, image: Image, count: int) -> Keypoints:
        """Detect keypoints all over the image, whatever features are there already.

        Args:
            image: where to detect them.
            count: approximate number, spread over the grid.
        """
        share = -(-count // len(self._cells))
        whole = None if self._detector.local else self._whole(image, self._allowed)
        found: list[Keypoints] = []
        for cell in self._cells:
            if whole is None:
                best = self._in_cell(image, self._allowed, cell, share)
                best = best.at(best.pixels + cell.origin)
            else:
                best = whole.select(_inside(whole.pixels, cell))
            found.append(best.select(spread(best.pixels, share, self._distance_px)))
        keypoints = Keypoints.concatenate(found)
        return keypoints.at(refine(image, keypoints.pixels)) if self._config.subpixel else keypoints

    def fill(self, keypoints: Keypoints, occupied: Pixels) -> IntArray:
        """Indices of keypoints to add in cells that have few of the `occupied` features (N, 2)."""
        free = self._free(occupied)
        chosen: list[int] = []
        missing = self._missing(occupied)
        cells, shares = self._wanted(occupied)
        for i, share in zip(cells.tolist(), shares.tolist(), strict=True):
            inside = np.flatnonzero(_inside(keypoints.pixels, self._cells[i]))
            inside = inside[np.argsort(-keypoints.scores[inside], kind="stable")]
            best = inside[self._claim(free, keypoints.pixels[inside], min(missing, share))]
            chosen += best.tolist()
            missing -= len(best)
            if missing <= 0:
                break
        return np.array(chosen, np.int64)

    def _wanted(self, occupied: Pixels) -> tuple[IntArray, IntArray]:
        """The cells (C,) that need features, emptiest first, and how many (C,) each needs."""
        self._rest = np.maximum(self._rest - 1, 0)
        missing = self._missing(occupied)
        if missing <= 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        # No cell rests while many features are missing, e.g. after the lens was covered
        wanting = (self._rest == 0) | (2 * missing > self._config.max_features)
        counts, sharing = self._count(occupied), len(self._cells)
        if len(self._apart):
            apart = self._count(self._apart)
            counts -= apart
            of_the_world = apart <= counts
            sharing = max(int(np.count_nonzero(of_the_world)), 1)
            wanting &= of_the_world
        share = -(-self._config.max_features // sharing)
        cells = (wanting & (counts < share)).nonzero()[0]
        emptiest_first = cells.take(counts.take(cells).argsort(kind="stable"))
        return emptiest_first, share - counts.take(emptiest_first)

    def _missing(self, occupied: Pixels) -> int:
        """How many features are wanted beside those that are there (N, 2)."""
        return self._config.max_features - len(occupied) + len(self._apart)

    def _count(self, points: Pixels) -> IntArray:
        """How many points (N, 2) lie in each cell."""
        xs, ys = self._edges
        columns, rows = self._config.grid
        column = xs.searchsorted(points[:, 0], side="right")
        row = ys.searchsorted(points[:, 1], side="right")
        return np.bincount(row * columns + column, minlength=columns * rows)

    def _free(self, occupied: Pixels) -> Image:
        """The mask of pixels where a new point may lie, until the next call."""
        free = self._room  # a new array of this size would cost as much as what is done with it
        np.copyto(free, self._allowed)
        clear_disks(free, np.ascontiguousarray(occupied), self._half_widths)
        return free

    def _claim(self, free: Image, pixels: Pixels, count: int) -> IntArray:
        """The first points (N, 2) that are free and apart, as indices; their place is taken."""
        pixels = np.ascontiguousarray(pixels)
        return claim(free, pixels, count, self._distance_px, self._half_widths)

    def _whole(self, image: Image, allowed: Image) -> Keypoints:
        """All keypoints of a detector that needs the whole image, best first."""
        return self._detector.detect(
            image, allowed, 2 * self._config.max_features, self._distance_px
        )

    def _in_cell(self, image: Image, free: Image, cell: _Cell, count: int) -> Keypoints:
        """The best keypoints of a cell, best first, in pixels from `cell.origin`."""
        own = free[cell.own]
        if cv2.countNonZero(own) == 0:
            return Keypoints.concatenate([])
        patch = np.ascontiguousarray(image[cell.around])
        allowed = np.zeros(patch.shape, np.uint8)
        allowed[cell.inner] = own
        return self._detector.detect(patch, allowed, count, self._distance_px)


def _disk(radius: int) -> IntArray:
    """Pixels (2 radius + 1,) on either side of the centre in each row of a disk."""
    disk = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    cv2.circle(disk, (radius, radius), radius, 1, cv2.FILLED)
    widths: IntArray = np.sum(disk, axis=1, dtype=np.int64)
    return widths // 2


def _inside(pixels: Pixels, cell: _Cell) -> BoolArray:
    """Which points (N, 2) lie in a cell."""
    u, v = pixels[:, 0], pixels[:, 1]
    result: BoolArray = (u >= cell.left) & (u < cell.right) & (v >= cell.top) & (v < cell.bottom)
    return result


def camera_mask(camera: Camera, path: Path | None, window_px: int) -> Image | None:
    """Where features of a camera may lie: by its mask, and by the usable field of a wide lens.

    Args:
        camera: its model.
        path: image that is zero where no features are wanted, or None.
        window_px: side of the window that is tracked. It stays inside the usable field: where a
            lens shows nothing beyond, the rim is an edge that moves with the camera.

    Returns:
        (height, width), zero where no features may lie; None for no such place.

    Raises:
        ConfigError: if the image is not there, or does not fit the camera.
    """
    mask = None if path is None else _read_mask(path, camera.width, camera.height)
    if not camera.model.sees_sideways:
        return mask
    visible = np.where(camera.visible_mask(), np.uint8(255), np.uint8(0))
    inside = np.asarray(cv2.erode(visible, np.ones((window_px, window_px), np.uint8)), np.uint8)
    return inside if mask is None else np.minimum(mask, inside)


def _read_mask(path: Path, width: int, height: int) -> Image:
    """Read the mask of a camera.

    Raises:
        ConfigError: if it is missing, unreadable, or not of the size of the camera's images.
    """
    try:
        image = ImageFile.decode(path.read_bytes(), cv2.IMREAD_GRAYSCALE)
    except OSError as error:
        raise ConfigError(
            f"{path}: the mask of a camera cannot be read: {error.strerror}"
        ) from error
    if isinstance(image, str):
        raise ConfigError(
            f"{path}: the mask of a camera cannot be read ({image}); take another copy"
        )
    if image.shape != (height, width):
        raise ConfigError(
            f"{path}: the mask is {image.shape[1]}x{image.shape[0]}, "
            f"the camera's images are {width}x{height}"
        )
    return np.asarray(image, np.uint8)
