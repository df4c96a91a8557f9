# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The observations of features that wait to be used, and tables of them for the solver.

`FeatureTracks` owns the life of an observation. It waits from when its frame comes until exactly
one `Outcome` takes it away; nothing else adds or removes observations (table in docs/engine.md).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray, ascending_union
from slam_graph.kernels.ascending import are_among
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
    _starts: IntArray | None = field(default=None, init=False)
    _counts: IntArray | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.feature)

    @property
    def counts(self) -> IntArray:
        """(J,) number of observations of each feature."""
        if self._counts is None:  # it is asked for many times in a step
            counts = np.bincount(self.feature, minlength=len(self.ids))
            object.__setattr__(self, "_counts", counts)
        assert self._counts is not None
        return self._counts

    @property
    def starts(self) -> IntArray:
        """(J + 1,) first observation of each feature, and N."""
        if self._starts is None:
            starts = self.feature.searchsorted(np.arange(len(self.ids) + 1))
            object.__setattr__(self, "_starts", starts)
        assert self._starts is not None
        return self._starts

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
        if keep.all():
            return self
        rows = keep[self.feature].nonzero()[0]  # faster to take than a mask
        renumbered = keep.cumsum() - 1
        return Observations(
            self.ids[keep],
            self.frames,
            renumbered[self.feature[rows]],
            self.frame[rows],
            self.camera[rows],
            self.pixels.take(rows, axis=0),
            self.normalized.take(rows, axis=0),
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
        if len(ids):
            self._features.append((outcome, ids))

    def add_observations(self, outcome: Outcome, obs: Observations) -> None:
        """Single observations."""
        if len(obs):
            self._observations.append((outcome, obs))

    def ids(self) -> IntArray:
        """The features of which no observation is left, ascending."""
        return ascending_union(*(ids for _, ids in self._features))

    def apply(self, tracks: FeatureTracks, frames: Sequence[int]) -> None:
        """Take the observations away: single ones first, then features in the order of adding.

        Args:
            tracks: loses them.
            frames: those whose poses stay; what is left of all others goes too.
        """
        single = [(outcome, tracks.rows_of(obs)) for outcome, obs in self._observations]
        tracks.take_away(single, self._features, frames)


class FeatureTracks:
    """The observations, of the frames whose poses are in the state, that have not been used yet.

    Every observation enters the prior at most once: whatever takes it there takes it out of here.
    Rows are sorted by feature, then frame, then camera. There are ten times as many of them as
    features, so what concerns features is found on these first.

    Attributes:
        seen: ids (N,) of all features that the last frame saw, used or not, ascending.
        added: number of observations that were added so far.
        outcomes: number of observations that each outcome has taken away so far.
    """

    def __init__(self) -> None:
        self._numbers = np.zeros((3, 0), np.int64)  # feature, frame and camera of each observation
        self._places = np.zeros((2, 0, 2))  # raw pixels and normalised coordinates
        self._group()
        self.seen = np.zeros(0, np.int64)
        self.added = 0
        self.outcomes: Counter[Outcome] = Counter()

    def _group(self) -> None:
        """Find the features, and where the observations of each begin."""
        self._ids, self._frames, self._cameras = self._numbers
        begins = np.empty(len(self._ids) + 1, np.bool_)
        begins[0] = begins[-1] = True  # the last one is the end
        np.not_equal(self._ids[1:], self._ids[:-1], out=begins[1:-1])
        bounds = begins.nonzero()[0]
        self._starts, self._counts = bounds[:-1], bounds[1:] - bounds[:-1]
        self._features = self._ids[self._starts]

    def __len__(self) -> int:
        """How many observations wait."""
        return len(self._ids)

    def add(self, index: int, frame: FeatureFrame) -> None:
        """Add the observations of a new frame, later than all before."""
        self.add_past(index, frame)
        self.seen = frame.ids

    def add_past(self, index: int, frame: FeatureFrame) -> None:
        """Add the observations of features in a frame that is later than all others of them."""
        old, new = len(self), [len(camera) for camera in frame.cameras]
        numbers = np.empty((3, old + sum(new)), np.int64)
        places = np.empty((2, numbers.shape[1], 2))
        numbers[:, :old], places[:, :old] = self._numbers, self._places
        numbers[1, old:], begin = index, old
        for number, (camera, size) in enumerate(zip(frame.cameras, new, strict=True)):
            rows = slice(begin, begin := begin + size)
            numbers[0, rows], numbers[2, rows] = camera.ids, number
            places[0, rows], places[1, rows] = camera.pixels, camera.normalized
        self.added += sum(new)
        order = numbers[0].argsort(kind="stable")
        self._numbers, self._places = numbers.take(order, axis=1), places.take(order, axis=1)
        self._group()

    def keep_frames(self, frames: Sequence[int]) -> None:
        """Drop the observations of all frames but these, as their poses have left."""
        self.take_away([], [], frames)

    def remove(self, outcome: Outcome, ids: IntArray) -> None:
        """Take away all observations of some features (ascending ids)."""
        self.take_away([], [(outcome, ids)])

    def take_away(
        self,
        single: Sequence[tuple[Outcome, BoolArray]],
        features: Sequence[tuple[Outcome, IntArray]],
        frames: Sequence[int] | None = None,
    ) -> None:
        """Take away observations; the first outcome that has an observation counts.

        Args:
            single: observations (N,) of this.
            features: all observations of features (ascending ids).
            frames: those whose poses stay, if not all do; the observations of the others are taken
                away last.
        """
        left = np.ones(len(self), np.bool_)
        for outcome, rows in single:
            self._count(outcome, np.count_nonzero(rows & left))
            left &= ~rows
        stays, counts = np.ones(len(self._features), np.bool_), self._counts
        if single and len(self):
            counts = np.add.reduceat(left, self._starts, dtype=np.int64)
        for outcome, ids in features:
            gone = is_in(self._features, ids) & stays
            self._count(outcome, counts[gone].sum())
            stays ^= gone
        left &= stays.repeat(self._counts)
        if frames is not None:
            here = left & _is_among(self._frames, frames)
            self._count(Outcome.POSE_LEFT, np.count_nonzero(left) - np.count_nonzero(here))
            left = here
        self._select(left.nonzero()[0])

    def _count(self, outcome: Outcome, count: int | np.int64) -> None:
        if count:
            self.outcomes[outcome] += int(count)

    def _select(self, rows: IntArray) -> None:
        if len(rows) == len(self):
            return
        self._numbers = self._numbers.take(rows, axis=1)
        self._places = self._places.take(rows, axis=1)
        self._group()

    def rows_of(self, obs: Observations) -> BoolArray:
        """Which observations (N,) are among some."""
        frames = np.array(obs.frames, np.int64)[obs.frame]
        mine = self._key(self._ids, self._frames, self._cameras)
        theirs = self._key(obs.ids[obs.feature], frames, obs.camera)
        return is_in(mine, np.sort(theirs))

    def _key(self, ids: IntArray, frames: IntArray, cameras: IntArray) -> IntArray:
        """A number (N,) for each observation that no other one has."""
        first = self._frames.min(initial=0)
        span, count = self._frames.max(initial=0) - first + 1, self._cameras.max(initial=0) + 1
        return np.asarray((ids * span + frames - first) * count + cameras, dtype=np.int64)

    def _rows_of_features(self, ids: IntArray) -> BoolArray:
        """Which observations (N,) are of some features (ascending ids)."""
        return is_in(self._features, ids).repeat(self._counts)

    def frames(self, without: IntArray) -> set[int]:
        """The frames of all waiting observations but those of some features (ascending ids)."""
        if not len(self):
            return set()
        rows, first = ~self._rows_of_features(without), self._frames.min()
        return set((np.bincount(self._frames[rows] - first).nonzero()[0] + first).tolist())

    def ids_waiting(self) -> IntArray:
        """All features with waiting observations, ascending."""
        return self._features

    def ids_in(self, index: int) -> IntArray:
        """The features that any camera saw in one frame, ascending."""
        return ascending_union(self._ids[self._frames == index])

    def parallax(
        self, before: int, after: int, turns: Sequence[FloatArray], least: float = 0.0
    ) -> FloatArray:
        """Angles (N,) in rad between the rays to features that one camera sees in two frames.

        It is the first camera that sees any feature in both, so another one than the first of the
        rig only where that has no images.

        Args:
            before: a frame.
            after: another.
            turns: for each camera its rotation (3, 3) from the first frame to the second.
            least: there are none if it sees fewer than so many.
        """
        for camera, turn in enumerate(turns):
            mine = self._cameras == camera
            i, j = (np.flatnonzero((self._frames == index) & mine) for index in (before, after))
            i = i[is_in(self._ids[i], self._ids[j])]
            if len(i) == 0:
                continue
            if len(i) < least:
                break
            j = j[self._ids[j].searchsorted(self._ids[i])]
            rays = np.ones((2, len(i), 3))
            rays[:, :, :2] = self._places[1, i], self._places[1, j]
            x, y = rays / np.linalg.norm(rays, axis=2, keepdims=True)
            sines = np.linalg.norm(np.cross(x @ turn.T, y), axis=1)
            return np.asarray(np.arcsin(np.minimum(sines, 1.0)), dtype=np.float64)
        return np.zeros(0)

    def ids_in_any(self, frames: Sequence[int]) -> IntArray:
        """The features that any camera saw in some frames, ascending."""
        if len(frames) == 0:
            return np.zeros(0, np.int64)
        return ascending_union(self._ids[_is_among(self._frames, frames)])

    def lengths(self) -> tuple[IntArray, IntArray]:
        """All features with waiting observations (J,), and the number of frames that see each."""
        if len(self) == 0:
            return self._features, np.zeros(0, np.int64)
        again = np.empty(len(self), np.bool_)  # by the next camera
        np.equal(self._frames[1:], self._frames[:-1], out=again[1:])
        again[self._starts] = False
        repeated: IntArray = np.add.reduceat(again, self._starts, dtype=np.int64)
        return self._features, self._counts - repeated

    def observations(self, ids: IntArray, frames: Sequence[int] | None = None) -> Observations:
        """The waiting observations of some features (ascending ids) in some or all frames."""
        wanted = self._rows_of_features(ids)
        if frames is not None:
            wanted &= _is_among(self._frames, frames)
        rows = wanted.nonzero()[0]
        _, numbers, cameras = self._numbers.take(rows, axis=1)
        pixels, normalized = self._places.take(rows, axis=1)
        order, frame = _numbered(numbers)
        feature = ids.searchsorted(self._features).repeat(self._counts).take(rows)
        return Observations(ids, tuple(order.tolist()), feature, frame, cameras, pixels, normalized)


def _numbered(values: IntArray) -> tuple[IntArray, IntArray]:
    """The distinct values, ascending, and the number (N,) of each among them.

    By a table over their range, which takes less than sorting them as long as that is narrow.
    """
    if len(values) == 0:
        return values, values
    first = values.min()
    places = values - first
    table = np.zeros(places.max() + 1, np.bool_)
    table[places] = True
    return table.nonzero()[0] + first, (table.cumsum() - 1)[places]


def _is_among(frames: IntArray, some: Sequence[int]) -> BoolArray:
    """Which frames (N,) are among some, in any order."""
    return is_in(frames, np.array(sorted(some), np.int64))


def is_in(values: IntArray, ascending: IntArray) -> NDArray[np.bool_]:
    """Which values (N,) are among some ascending ones."""
    if len(ascending) == 0 or len(values) == 0:
        return np.zeros(len(values), np.bool_)
    try:
        return are_among(values, ascending)
    except TypeError:  # arrays that cannot be written to, or of other integers
        return are_among(np.array(values, np.int64), np.array(ascending, np.int64))
