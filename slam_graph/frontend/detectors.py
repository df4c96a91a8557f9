# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors: which points of an image are worth tracking.

The score of a corner is local, so corner detectors look only at those cells of the grid that need
features. The others build a pyramid and need the whole image.
"""

from __future__ import annotations

import importlib
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.errors import ConfigError
from slam_graph.frontend.frontend_config import DETECTORS, FrontendConfig
from slam_graph.frontend.keypoints import Image, Keypoints, Pixels, contiguous
from slam_graph.kernels.corners import (
    WINDOW_PX,
    smallest_eigenvalues,
    strongest_in_cells,
    strongest_maxima,
)

_INSTALL = "pip install 'slam-graph[descriptors]'"

_SOBEL_PX = 3
"""Side of the filter that takes the gradients."""

_RELATIVE_SCORE = 0.05
"""A corner of a cell has at least this share of the eigenvalue of the cell's best one: low, because
`min_corner_score` already rules out noise, and weak corners keep the coverage even."""

_HARRIS_K = 0.04
"""Weight of the trace in Harris' score det - k trace² (Harris and Stephens 1988)."""

_SUBPIXEL_RADIUS_PX = 3
_SUBPIXEL_LIMIT_PX = 1.5
"""A corner that refinement moves further than this has been drawn to another one."""

ORB_LEVELS = 4
ORB_EDGE_PX = 20
BRISK_OCTAVES = 2


class Detector(Protocol):
    """Finds keypoints.

    Attributes:
        local: whether a part of an image is enough to judge a keypoint in it. Then `detect` is
            given the cells of the grid that need features, otherwise the whole image.
    """

    local: bool

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The strongest keypoints, best first.

        Args:
            image: (height, width), or a part of it.
            allowed: of the same size, zero where none are wanted.
            count: how many are wanted. More may be returned, and they may lie too close together:
                the caller applies non-maximum suppression.
            distance_px: least distance of two keypoints after that suppression, for detectors that
                can save work by it.
        """
        ...


@runtime_checkable
class CellDetector(Protocol):
    """A detector that takes all cells of an image in one call, which saves time."""

    def detect_in_cells(
        self,
        image: Image,
        free: Image,
        cells: IntArray,
        margin_px: int,
        wanted: IntArray,
        missing: int,
        surplus: int,
        distance_px: float,
        half_widths: IntArray,
    ) -> tuple[Pixels, IntArray, IntArray]:
        """The strongest keypoints of one cell after the other, until there are enough.

        Args:
            image: (height, width).
            free: of the same size, zero where none are wanted; it is changed.
            cells: (C, 4) first column, first row, and the column and row behind the last ones.
            margin_px: pixels around a cell that a score in it depends on.
            wanted: (C,) how many each cell is to have at most.
            missing: how many are wanted in all.
            surplus: factor on both, for callers that will reject some.
            distance_px: least distance of two keypoints.
            half_widths: (2 r + 1,) of the rows of a disk, in which others are not wanted.

        Returns:
            Pixels (N, 2), cell by cell; of each of the V cells that were visited, how many were
            found (V,), and how many were wanted there (V,), without the surplus.
        """
        ...


def require(module: str, purpose: str) -> Any:
    """Import a module of an optional library.

    Args:
        module: its full name.
        purpose: what needs it, for the message.

    Raises:
        ConfigError: if it is not installed; names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.split(".")[0]
        raise ConfigError(f"{purpose}: needs {library}, install it: {_INSTALL}") from error


class _GradientCorners:
    """Corners by the covariance of the gradient: Shi and Tomasi 1994, or Harris and Stephens 1988.

    Both scores are functions of its eigenvalues λ₁ ≤ λ₂: λ₁, and λ₁ λ₂ - k (λ₁ + λ₂)².
    """

    local = True

    def __init__(self, config: FrontendConfig, harris: bool) -> None:
        self._harris = harris
        # Harris' score of a corner with two eigenvalues that are just large enough
        self._smallest = config.min_corner_score
        if harris:
            self._smallest = (1.0 - 4.0 * _HARRIS_K) * config.min_corner_score**2

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The strongest corners."""
        if self._harris:
            harris = cv2.cornerHarris(image, WINDOW_PX, _SOBEL_PX, _HARRIS_K)
            scores = np.ascontiguousarray(harris, np.float32)
        else:
            scores = smallest_eigenvalues(np.ascontiguousarray(image))
        # the share is one of eigenvalues, of which Harris' score is the square
        share = _RELATIVE_SCORE ** (2 if self._harris else 1)
        found = strongest_maxima(scores, allowed, count, share, self._smallest, distance_px)
        return Keypoints.of(found[:, :2], found[:, 2], float(WINDOW_PX))


@DETECTORS.register("shi_tomasi")
class _ShiTomasiCorners(_GradientCorners):
    """Corners by their smaller eigenvalue, in all cells of an image at once."""

    def __init__(self, config: FrontendConfig) -> None:
        super().__init__(config, harris=False)
        self._room = np.empty(0, np.float32)

    def detect_in_cells(
        self,
        image: Image,
        free: Image,
        cells: IntArray,
        margin_px: int,
        wanted: IntArray,
        missing: int,
        surplus: int,
        distance_px: float,
        half_widths: IntArray,
    ) -> tuple[Pixels, IntArray, IntArray]:
        """The strongest corners of each cell, which are far apart; see `CellDetector`."""
        if image.size > len(self._room):  # enough for any cell; what is not used takes no memory
            self._room = np.empty(image.size, np.float32)
        points = np.empty((surplus * int(wanted.sum()), 2), np.float32)
        counts, quotas = np.empty(len(cells), np.int64), np.empty(len(cells), np.int64)
        places = contiguous(image), free, np.ascontiguousarray(cells), margin_px
        numbers = np.ascontiguousarray(wanted), missing, surplus
        limits = _RELATIVE_SCORE, self._smallest, distance_px
        seen = strongest_in_cells(
            *places, *numbers, *limits, half_widths, self._room, points, counts, quotas
        )
        counts = counts[:seen]
        return points[: counts.sum()], counts, quotas[:seen]


@DETECTORS.register("harris")
def _harris(config: FrontendConfig) -> Detector:
    return _GradientCorners(config, harris=True)


@DETECTORS.register("fast")
class _FastCorners:
    """FAST (Rosten and Drummond 2006): a long arc of a circle is brighter or darker."""

    local = True

    def __init__(self, config: FrontendConfig) -> None:
        # Thresholds to try one after the other: as configured, then half of it
        self._detectors = [
            cv2.FastFeatureDetector.create(max(1, config.fast_threshold // divisor))
            for divisor in (1, 2)
        ]

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The corners with the largest threshold at which they would still be found."""
        for detector in self._detectors:
            found = detector.detect(image, allowed)
            if len(found) >= count:
                break
        keypoints = Keypoints.from_opencv(found)
        return keypoints.select(_strongest_first(keypoints))


class _MultiScale:
    """A detector of OpenCV that searches an image at several scales.

    Args:
        detector: does the work.
        shrink: factor by which the image is reduced first.
    """

    local = False

    def __init__(self, detector: cv2.Feature2D, shrink: int = 1) -> None:
        self._detector = detector
        self._shrink = shrink

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The strongest keypoints of all scales."""
        shrink = self._shrink
        if shrink > 1:
            size = (image.shape[1] // shrink, image.shape[0] // shrink)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            allowed = np.asarray(cv2.resize(allowed, size, interpolation=cv2.INTER_NEAREST))
        found = Keypoints.from_opencv(self._detector.detect(image, allowed))
        if shrink > 1:
            # pixel centres are at integers: pixel u of the reduced image is the middle of a block
            pixels = ((found.pixels + 0.5) * shrink - 0.5).astype(np.float32)
            size_px = (found.sizes_px * shrink).astype(np.float32)
            found = Keypoints(pixels, found.scores, size_px, found.angles_deg, found.octaves)
        return found.select(_strongest_first(found))


@DETECTORS.register("dog")
def _difference_of_gaussians(config: FrontendConfig) -> Detector:
    """SIFT's detector (Lowe 2004).

    OpenCV doubles the image first, as Lowe does. On video the finest octave costs three quarters of
    the time and gives the least stable keypoints, so the image is halved before.
    """
    return _MultiScale(cv2.SIFT.create(4 * config.max_features, contrastThreshold=0.02), shrink=2)


@DETECTORS.register("orb")
def _orb(config: FrontendConfig) -> Detector:
    """ORB's detector (Rublee et al. 2011): FAST on a pyramid, ranked by Harris, with direction."""
    return _MultiScale(
        cv2.ORB.create(
            20 * config.max_features,
            nlevels=ORB_LEVELS,
            edgeThreshold=ORB_EDGE_PX,
            fastThreshold=max(1, config.fast_threshold // 4),
        )
    )


@DETECTORS.register("brisk")
def _brisk(config: FrontendConfig) -> Detector:
    """BRISK's detector (Leutenegger et al. 2011): AGAST corners, maximal over scale too."""
    return _MultiScale(cv2.BRISK.create(thresh=config.fast_threshold, octaves=BRISK_OCTAVES))


@DETECTORS.register("surf")
class _SurfBlobs:
    """SURF's detector: maxima of the determinant of the Hessian over space and scale (Bay 2008).

    Raises:
        ConfigError: where mahotas is not installed.
    """

    local = False

    def __init__(self, config: FrontendConfig) -> None:
        self._surf = require("mahotas.features.surf", "detector and descriptor SURF")

    def detect(self, image: Image, allowed: Image, count: int, distance_px: float) -> Keypoints:
        """The strongest blobs."""
        rows = self._surf.interest_points(image, nr_octaves=3, nr_scales=4, max_points=2 * count)
        found = Keypoints.of(rows[:, 1::-1].astype(np.float32), rows[:, 3].astype(np.float32), 0.0)
        # a blob of scale s is one of a Gaussian of that width
        sizes = (2.0 * rows[:, 2]).astype(np.float32)
        found = Keypoints(found.pixels, found.scores, sizes, found.angles_deg, found.octaves)
        u, v = np.rint(found.pixels).astype(int).T
        height, width = allowed.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        inside[inside] = allowed[v[inside], u[inside]] > 0
        found = found.select(inside)
        return found.select(_strongest_first(found))


def refine(image: Image, pixels: Pixels) -> Pixels:
    """Corners (N, 2) to a fraction of a pixel.

    The corner is the point that is orthogonal, as seen from every pixel around it, to the gradient
    at that pixel (Förstner and Gülch 1987).
    """
    if len(pixels) == 0:
        return pixels
    window = (_SUBPIXEL_RADIUS_PX, _SUBPIXEL_RADIUS_PX)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.01)
    refined = np.asarray(cv2.cornerSubPix(image, pixels.copy(), window, (-1, -1), criteria))
    refined = refined.reshape(-1, 2)
    moved = np.linalg.norm(refined - pixels, axis=1)
    return np.where((moved < _SUBPIXEL_LIMIT_PX)[:, None], refined, pixels).astype(np.float32)


def _strongest_first(keypoints: Keypoints) -> IntArray:
    return np.argsort(-keypoints.scores, kind="stable")
