# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The observations of features that wait to be used, and tables of them for the solver.

`FeatureTracks` owns the life of an observation. It waits from when its frame comes until exactly
one `Outcome` takes it away; nothing else adds or removes observations (table in docs/engine.md).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.sensors import FeatureFrame


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
    def starts(self) -> IntArray:
        """(J + 1,) first observation of each feature, and N."""
        return np.searchsorted(self.feature, np.arange(len(self.ids) + 1))

    @property
    def slots(self) -> IntArray:
        """(N,) running number of each observation within its feature."""
        counts = self.counts
        starts = np.cumsum(counts) - counts
        return np.arange(len(self)) - starts[self.feature]

    def rows(self, keep: NDArray[np.bool_] | IntArray) -> Observations:
        """Some of the observations, by mask or number, of the same features."""
        return Observations(
            self.ids,
            self.frames,
            self.feature[keep],
            self.frame[keep],
            self.camera[keep],
            self.pixels[keep],
            self.normalized[keep],
        )

    def without_idle_frames(self) -> Observations:
        """The same observations over only those frames that have any."""
        used = np.unique(self.frame)
        return replace(
            self,
            frames=tuple(self.frames[int(k)] for k in used),
            frame=np.searchsorted(used, self.frame),
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


class Outcome(StrEnum):
    """What became of an observation."""

    ABSORBED = "absorbed"
    """Its information is in the prior now (or it is a factor of GTSAM's smoother), and the
    observation itself never enters again."""
    GATED = "gated"
    """It failed the χ² test before the steps: all observations of a feature outside the state
    together, those of a feature of the state one by one."""
    OUTLIER = "outlier"
    """Its residual failed the χ² test after the steps."""
    NOT_TRIANGULATED = "not_triangulated"
    """Its feature was to be used now, and its position cannot be trusted."""
    DYNAMIC = "dynamic"
    """Its feature was an outlier in too many consecutive frames."""
    ENDED = "ended"
    """Its track has ended, and the policy uses only features of the state."""
    STANDSTILL = "standstill"
    """Its feature is a variable of the state, and the platform stands still."""
    POSE_LEFT = "pose_left"
    """The pose of its frame has left the state before the feature was used."""


class Removals:
    """Observations that a step does not leave waiting, by what became of them."""

    def __init__(self) -> None:
        self._features: list[tuple[Outcome, IntArray]] = []
        self._observations: list[tuple[Outcome, Observations]] = []

    def add_features(self, outcome: Outcome, ids: IntArray) -> None:
        """All observations of some features (ascending ids)."""
        self._features.append((outcome, ids))

    def add_observations(self, outcome: Outcome, obs: Observations) -> None:
        """Single observations."""
        self._observations.append((outcome, obs))

    def ids(self) -> IntArray:
        """The features of which no observation is left, ascending."""
        return np.unique(
            np.concatenate([np.zeros(0, np.int64), *(ids for _, ids in self._features)])
        )

    def apply(self, tracks: FeatureTracks) -> None:
        """Take the observations away: single ones first, then features in the order of adding."""
        parts = [(outcome, tracks.rows_of(obs)) for outcome, obs in self._observations if len(obs)]
        parts += [(outcome, tracks.rows_of_features(ids)) for outcome, ids in self._features]
        tracks.remove_rows(parts)


class FeatureTracks:
    """The observations, of the frames whose poses are in the state, that have not been used yet.

    Every observation enters the prior at most once: whatever takes it there takes it out of here.
    Rows are sorted by feature, then frame, then camera.

    Attributes:
        seen: ids (N,) of all features that the last frame saw, used or not, ascending.
        added: number of observations that were added so far.
        outcomes: number of observations that each outcome has taken away so far.
    """

    def __init__(self) -> None:
        self._ids = np.zeros(0, np.int64)
        self._frames = np.zeros(0, np.int64)
        self._cameras = np.zeros(0, np.int64)
        self._pixels = np.zeros((0, 2))
        self._normalized = np.zeros((0, 2))
        self.seen = np.zeros(0, np.int64)
        self.added = 0
        self.outcomes: Counter[Outcome] = Counter()

    def __len__(self) -> int:
        """How many observations wait."""
        return len(self._ids)

    def add(self, index: int, frame: FeatureFrame) -> None:
        """Add the observations of a new frame, later than all before."""
        cameras = frame.cameras
        self.seen = np.unique(np.concatenate([c.ids for c in cameras]))
        ids = np.concatenate([self._ids, *(c.ids for c in cameras)])
        count = len(ids) - len(self._ids)
        self.added += count
        numbers = [np.full(len(c), number) for number, c in enumerate(cameras)]
        order = np.argsort(ids, kind="stable")
        self._ids = ids[order]
        self._frames = np.concatenate([self._frames, np.full(count, index)])[order]
        self._cameras = np.concatenate([self._cameras, *numbers])[order]
        self._pixels = np.concatenate([self._pixels, *(c.pixels for c in cameras)])[order]
        self._normalized = np.concatenate([self._normalized, *(c.normalized for c in cameras)])[
            order
        ]

    def keep_frames(self, frames: Sequence[int]) -> None:
        """Drop the observations of all frames but these, as their poses have left."""
        self._keep(np.isin(self._frames, frames), Outcome.POSE_LEFT)

    def remove(self, outcome: Outcome, ids: IntArray) -> None:
        """Take away all observations of some features (ascending ids)."""
        self._keep(~self.rows_of_features(ids), outcome)

    def remove_rows(self, parts: Sequence[tuple[Outcome, BoolArray]]) -> None:
        """Take away observations (N,); the first outcome that has an observation counts."""
        left = np.ones(len(self), np.bool_)
        for outcome, rows in parts:
            gone = rows & left
            count = int(np.count_nonzero(gone))
            if count:
                self.outcomes[outcome] += count
                left &= ~gone
        self._select(left)

    def rows_of_features(self, ids: IntArray) -> BoolArray:
        """Which observations (N,) are of some features (ascending ids)."""
        return is_in(self._ids, ids)

    def rows_of(self, obs: Observations) -> BoolArray:
        """Which observations (N,) are among some."""
        frames = np.array(obs.frames)[obs.frame]
        key = self._key(obs.ids[obs.feature], frames, obs.camera)
        return np.isin(self._key(self._ids, self._frames, self._cameras), key)

    def _key(self, ids: IntArray, frames: IntArray, cameras: IntArray) -> IntArray:
        """A number (N,) for each observation that no other one has."""
        first = self._frames.min(initial=0)
        span = self._frames.max(initial=0) - first + 1
        count = self._cameras.max(initial=0) + 1
        return np.asarray((ids * span + frames - first) * count + cameras, dtype=np.int64)

    def _keep(self, rows: NDArray[np.bool_], outcome: Outcome) -> None:
        self.remove_rows([(outcome, ~rows)])

    def _select(self, rows: NDArray[np.bool_]) -> None:
        if rows.all():
            return
        self._ids, self._frames, self._cameras = (
            self._ids[rows],
            self._frames[rows],
            self._cameras[rows],
        )
        self._pixels, self._normalized = self._pixels[rows], self._normalized[rows]

    def frames(self, without: IntArray) -> set[int]:
        """The frames of all waiting observations but those of some features (ascending ids)."""
        return set(np.unique(self._frames[~is_in(self._ids, without)]).tolist())

    def ids_waiting(self) -> IntArray:
        """All features with waiting observations, ascending."""
        return sorted_unique(self._ids)

    def ids_in(self, index: int) -> IntArray:
        """The features that any camera saw in one frame, ascending."""
        return sorted_unique(self._ids[self._frames == index])

    def parallax(self, before: int, after: int, turn: FloatArray) -> FloatArray:
        """Angles (N,) in rad between the rays of the first camera to features in two frames.

        Args:
            before: a frame.
            after: another.
            turn: (3, 3) rotation from the camera at the first frame to that at the second.
        """
        i, j = (
            np.flatnonzero((self._frames == index) & (self._cameras == 0))
            for index in (before, after)
        )
        _, a, b = np.intersect1d(
            self._ids[i], self._ids[j], assume_unique=True, return_indices=True
        )
        rays = (np.insert(self._normalized[rows], 2, 1.0, axis=1) for rows in (i[a], j[b]))
        x, y = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
        sines = np.linalg.norm(np.cross(x @ turn.T, y), axis=1)
        return np.asarray(np.arcsin(np.minimum(sines, 1.0)), dtype=np.float64)

    def ids_in_any(self, frames: Sequence[int]) -> IntArray:
        """The features that any camera saw in some frames, ascending."""
        return sorted_unique(self._ids[np.isin(self._frames, frames)])

    def lengths(self) -> tuple[IntArray, IntArray]:
        """All features with waiting observations (J,), and the number of frames that see each."""
        new_frame = np.ones(len(self._ids), np.bool_)
        new_frame[1:] = (np.diff(self._ids) != 0) | (np.diff(self._frames) != 0)
        return np.unique(self._ids[new_frame], return_counts=True)

    def observations(self, ids: IntArray, frames: Sequence[int] | None = None) -> Observations:
        """The waiting observations of some features (ascending ids) in some or all frames."""
        rows = is_in(self._ids, ids)
        if frames is not None:
            rows &= np.isin(self._frames, frames)
        numbers = self._frames[rows]
        order = np.unique(numbers)
        return Observations(
            ids,
            tuple(order.tolist()),
            np.searchsorted(ids, self._ids[rows]),
            np.searchsorted(order, numbers),
            self._cameras[rows],
            self._pixels[rows],
            self._normalized[rows],
        )


def is_in(values: IntArray, ascending: IntArray) -> NDArray[np.bool_]:
    """Which values (N,) are among some ascending ones."""
    if len(ascending) == 0:
        return np.zeros(len(values), np.bool_)
    place = np.minimum(np.searchsorted(ascending, values), len(ascending) - 1)
    return np.asarray(ascending[place] == values)


def sorted_unique(values: IntArray) -> IntArray:
    """The distinct values of an ascending array."""
    first = np.ones(len(values), np.bool_)
    first[1:] = values[1:] != values[:-1]
    return values[first]
