# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The feature observations of the frames in the cost, and tables of them for the solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Observations of some features in some frames, one row each, sorted by feature.

    Attributes:
        ids: (J,) features, ascending.
        frames: the F frames, in the order of time.
        feature: (N,) row of each observation's feature in `ids`.
        frame: (N,) index of each observation's frame in `frames`.
        camera: (N,) camera of each observation.
        pixels: (N, 2) raw pixels.
        normalized: (N, 2) undistorted coordinates.
    """

    ids: IntArray
    frames: tuple[int, ...]
    feature: IntArray
    frame: IntArray
    camera: IntArray
    pixels: FloatArray
    normalized: FloatArray

    def __len__(self) -> int:
        return len(self.feature)

    @property
    def counts(self) -> IntArray:
        """(J,) number of observations of each feature."""
        return np.bincount(self.feature, minlength=len(self.ids))

    @property
    def slots(self) -> IntArray:
        """(N,) running number of each observation within its feature."""
        counts = self.counts
        starts = np.cumsum(counts) - counts
        return np.arange(len(self)) - starts[self.feature]

    def rows(self, keep: NDArray[np.bool_]) -> Observations:
        """The observations where `keep` (N,) holds, of the same features."""
        return Observations(
            self.ids,
            self.frames,
            self.feature[keep],
            self.frame[keep],
            self.camera[keep],
            self.pixels[keep],
            self.normalized[keep],
        )

    def subset(self, keep: NDArray[np.bool_]) -> Observations:
        """The observations of the features where `keep` (J,) holds."""
        rows = keep[self.feature]
        renumbered = np.cumsum(keep) - 1
        return Observations(
            self.ids[keep],
            self.frames,
            renumbered[self.feature[rows]],
            self.frame[rows],
            self.camera[rows],
            self.pixels[rows],
            self.normalized[rows],
        )


class TrackWindow:
    """Feature frames of the poses in the cost, and which of their observations are still unused.

    Every observation enters the cost once: `consume` forgets those that have become part of the
    prior.
    """

    def __init__(self) -> None:
        self.frames: dict[int, tuple[FeatureObservations, ...]] = {}

    def add(self, index: int, frame: FeatureFrame) -> None:
        """Add the observations of a new frame."""
        self.frames[index] = tuple(_sorted(camera) for camera in frame.cameras)

    def remove_frame(self, index: int) -> None:
        """Forget a frame."""
        self.frames.pop(index, None)

    def consume(self, ids: IntArray) -> None:
        """Forget all observations of some features (sorted ids)."""
        if len(ids) == 0:
            return
        for index, cameras in self.frames.items():
            self.frames[index] = tuple(
                _select(camera, ~np.isin(camera.ids, ids, assume_unique=True)) for camera in cameras
            )

    def ids_in(self, index: int) -> IntArray:
        """The features seen in one frame by any camera, ascending."""
        ids = [camera.ids for camera in self.frames.get(index, ())]
        return np.unique(np.concatenate(ids)) if ids else np.zeros(0, np.int64)

    def lengths(self) -> tuple[IntArray, IntArray]:
        """All features with unused observations (J,), and the number of frames that see each."""
        seen = [self.ids_in(index) for index in self.frames]
        if not seen:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        return np.unique(np.concatenate(seen), return_counts=True)

    def observations(self, ids: IntArray, frames: Sequence[int] | None = None) -> Observations:
        """The unused observations of some features (sorted ids) in some frames (default: all)."""
        order = tuple(sorted(self.frames if frames is None else frames))
        parts: list[tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray]] = []
        for position, index in enumerate(order):
            for number, camera in enumerate(self.frames[index]):
                _, rows, there = np.intersect1d(
                    ids, camera.ids, assume_unique=True, return_indices=True
                )
                n = len(rows)
                parts.append(
                    (
                        rows,
                        np.full(n, position),
                        np.full(n, number),
                        camera.pixels[there],
                        camera.normalized[there],
                    )
                )
        feature = np.concatenate([p[0] for p in parts]) if parts else np.zeros(0, np.int64)
        by_feature = np.argsort(feature, kind="stable")

        def column(k: int) -> NDArray[np.float64]:
            return np.concatenate([p[k] for p in parts])[by_feature]

        if not parts:
            empty = np.zeros(0, np.int64)
            return Observations(
                ids, order, empty, empty, empty, np.zeros((0, 2)), np.zeros((0, 2))
            )
        return Observations(
            ids,
            order,
            feature[by_feature],
            column(1).astype(np.int64),
            column(2).astype(np.int64),
            column(3),
            column(4),
        )


def _sorted(camera: FeatureObservations) -> FeatureObservations:
    return _select(camera, np.argsort(camera.ids, kind="stable"))


def _select(
    camera: FeatureObservations, rows: NDArray[np.bool_] | NDArray[np.intp]
) -> FeatureObservations:
    return FeatureObservations(camera.ids[rows], camera.pixels[rows], camera.normalized[rows])
