# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Descriptors: the appearance of a keypoint as a vector that can be compared.

Binary descriptors are compared by the number of bits that differ, the others by Euclidean distance.
"""

from __future__ import annotations

from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.frontend.detectors import BRISK_OCTAVES, ORB_EDGE_PX, ORB_LEVELS, require
from slam_graph.frontend.frontend_config import DESCRIPTORS
from slam_graph.frontend.keypoints import Image, Keypoints

Vectors = NDArray[Any]
"""(N, D) descriptors, uint8 or float32."""

SIFT_SIGMA, SIFT_LAYERS = 1.6, 3
"""Blur of the first layer of an octave, and layers per octave (Lowe 2004)."""


class Descriptor(Protocol):
    """Describes keypoints.

    Attributes:
        max_distance: two descriptors further apart than this do not show the same point.
    """

    max_distance: float

    def describe(self, image: Image, keypoints: Keypoints) -> tuple[IntArray, Vectors]:
        """Describe what can be described.

        Returns:
            kept: (M,) indices of the keypoints (N) that are not too close to the edge, ascending.
            descriptors: (M, D) float32, compared by Euclidean distance; or uint8 with eight bits
                each, compared by the number of bits that differ.
        """
        ...


class _OpenCvDescriptor:
    """A descriptor of OpenCV."""

    def __init__(self, extractor: cv2.Feature2D, max_distance: float) -> None:
        self._extractor = extractor
        number = np.uint8 if extractor.descriptorType() == cv2.CV_8U else np.float32
        self._none: Vectors = np.zeros((0, extractor.descriptorSize()), number)
        self.max_distance = max_distance

    def describe(self, image: Image, keypoints: Keypoints) -> tuple[IntArray, Vectors]:
        """Describe what can be described."""
        described, vectors = self._extractor.compute(image, self._prepared(keypoints).to_opencv())
        if vectors is None:
            return np.zeros(0, np.int64), self._none
        kept = np.array([k.class_id for k in described], np.int64)
        order = np.argsort(kept, kind="stable")
        return kept[order], np.asarray(vectors)[order]

    def _prepared(self, keypoints: Keypoints) -> Keypoints:
        return keypoints


@DESCRIPTORS.register("sift")
class _Sift(_OpenCvDescriptor):
    """SIFT (Lowe 2004): histograms of gradients in 4 x 4 fields."""

    def __init__(self) -> None:
        super().__init__(cv2.SIFT.create(), 250.0)

    def _prepared(self, keypoints: Keypoints) -> Keypoints:
        """The layer of SIFT's pyramid that fits the size, packed as OpenCV packs it."""
        sigma = np.maximum(0.5 * keypoints.sizes_px, SIFT_SIGMA)
        scale = np.log2(sigma / SIFT_SIGMA)
        octave = np.floor(scale).astype(np.int32)
        layer = np.rint(SIFT_LAYERS * (scale - octave)).astype(np.int32)
        return Keypoints(
            keypoints.pixels,
            keypoints.scores,
            (2.0 * sigma).astype(np.float32),
            keypoints.angles_deg,
            octave | (layer << 8),
        )


@DESCRIPTORS.register("surf")
class _Surf:
    """SURF (Bay et al. 2008): sums of Haar wavelets in 4 x 4 fields, by mahotas.

    Raises:
        ConfigError: where mahotas is not installed.
    """

    max_distance = 0.45

    def __init__(self) -> None:
        self._surf = require("mahotas.features.surf", "descriptor SURF")

    def describe(self, image: Image, keypoints: Keypoints) -> tuple[IntArray, Vectors]:
        """Describe what is far enough from the edge."""
        if len(keypoints) == 0:
            return np.zeros(0, np.int64), np.zeros((0, 64), np.float32)
        scale = np.maximum(0.5 * keypoints.sizes_px, 1.0)
        v, u = keypoints.pixels[:, 1], keypoints.pixels[:, 0]
        # mahotas returns the column of the score unchanged: an index there says what was left out
        index = np.arange(len(keypoints))
        rows = np.column_stack([v, u, scale, index, np.ones(len(keypoints))])
        described = self._surf.descriptors(image, rows)
        kept, vectors = described[:, 3].astype(np.int64), described[:, 6:].astype(np.float32)
        good = np.isfinite(vectors).all(axis=1)
        return kept[good], vectors[good]


@DESCRIPTORS.register("orb")
class Orb(_OpenCvDescriptor):
    """ORB (Rublee et al. 2011): 256 comparisons of pixels, rotated by the keypoint's direction."""

    def __init__(self) -> None:
        orb = cv2.ORB.create(nlevels=ORB_LEVELS, edgeThreshold=ORB_EDGE_PX)
        super().__init__(orb, 64.0)

    def _prepared(self, keypoints: Keypoints) -> Keypoints:
        # the octave names a level of ORB's own pyramid, which other detectors do not have
        levels = np.clip(keypoints.octaves, 0, ORB_LEVELS - 1).astype(np.int32)
        return Keypoints(
            keypoints.pixels,
            keypoints.scores,
            keypoints.sizes_px,
            keypoints.angles_deg,
            np.where(keypoints.octaves < ORB_LEVELS, levels, 0).astype(np.int32),
        )


@DESCRIPTORS.register("brisk")
def _brisk() -> Descriptor:
    """BRISK (Leutenegger et al. 2011): 512 comparisons on rings, with its own direction."""
    return _OpenCvDescriptor(cv2.BRISK.create(octaves=BRISK_OCTAVES), 110.0)


@DESCRIPTORS.register("brief")
class _Brief:
    """BRIEF (Calonder et al. 2010): 256 comparisons of pixels, upright, by scikit-image.

    Raises:
        ConfigError: where scikit-image is not installed.
    """

    max_distance = 64.0

    def __init__(self) -> None:
        feature = require("skimage.feature", "descriptor BRIEF")
        self._brief = feature.BRIEF(descriptor_size=256, patch_size=35, sigma=1.5, rng=0)

    def describe(self, image: Image, keypoints: Keypoints) -> tuple[IntArray, Vectors]:
        """Describe what is far enough from the edge."""
        if len(keypoints) == 0:
            return np.zeros(0, np.int64), np.zeros((0, 32), np.uint8)
        self._brief.extract(image, np.rint(keypoints.pixels[:, ::-1]).astype(np.int64))
        kept = np.flatnonzero(self._brief.mask)
        return kept, np.packbits(self._brief.descriptors, axis=1)
