# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Alignment of an estimate that is in several worlds: each is aligned by itself.

A run that was lost goes on in another world where nothing measured the way in between. One
alignment over all would say how far the worlds happen to be from one another, and nothing of the
estimate. After loop closure a world may be gone back to, after another one in between: each stay in
it is aligned by itself then, so that an error of the one relative to the other does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.geometry import AlignmentMode, Similarity, Trajectory

_UNPLACED_M = 100.0
"""σ of a position beyond which nothing is known of it."""


@dataclass(frozen=True, eq=False)
class PiecewiseAlignment:
    """The maps from the worlds of an estimate to that of a reference.

    Attributes:
        similarities: of each of the W worlds; None where its poses do not determine it.
        breaks_ns: (W - 1,) increasing times between two worlds.
    """

    similarities: tuple[Similarity | None, ...]
    breaks_ns: IntArray

    @staticmethod
    def fitted(
        reference: Trajectory,
        estimate: Trajectory,
        mode: AlignmentMode,
        breaks_ns: Sequence[int] | IntArray = (),
    ) -> PiecewiseAlignment:
        """The alignment of poses at the same times.

        Args:
            reference: N true poses.
            estimate: N poses at the same times.
            mode: of each world.
            breaks_ns: times between two worlds; none for one world.

        Raises:
            DataError: if the mode is unknown, or no world is determined by its poses.
        """
        breaks = np.asarray(breaks_ns, np.int64)
        world = np.searchsorted(breaks, estimate.stamps_ns, "right")
        found: list[Similarity | None] = []
        failures: list[DataError] = []
        for number in range(len(breaks) + 1):
            rows = np.flatnonzero(world == number)
            try:
                if len(breaks) and not len(rows):
                    raise DataError("a world without a true pose")
                pair = reference.positions[rows], estimate.positions[rows]
                found.append(Similarity.of_positions(*pair, mode))
            except DataError as error:
                found.append(None)
                failures.append(error)
        if all(similarity is None for similarity in found):
            raise failures[0]
        return PiecewiseAlignment(tuple(found), breaks)

    @property
    def first(self) -> Similarity:
        """The map of the first world that is aligned."""
        return next(found for found in self.similarities if found is not None)

    @property
    def scale(self) -> float:
        """Metres of the reference per unit of the estimate; NaN where worlds have several."""
        scales = {found.scale for found in self.similarities if found is not None}
        return scales.pop() if len(scales) == 1 else float("nan")

    def world_of(self, stamps_ns: IntArray) -> IntArray:
        """(N,) numbers of the worlds at some times."""
        return np.searchsorted(self.breaks_ns, stamps_ns, "right").astype(np.int64)

    def known(self, stamps_ns: IntArray) -> BoolArray:
        """(N,) whether the world at a time is aligned."""
        aligned = np.array([found is not None for found in self.similarities])
        return np.asarray(aligned[self.world_of(stamps_ns)])

    def scales(self, stamps_ns: IntArray) -> FloatArray:
        """(N,) metres of the reference per unit of the estimate; NaN in worlds not aligned."""
        of_worlds = [np.nan if found is None else found.scale for found in self.similarities]
        return np.array(of_worlds)[self.world_of(stamps_ns)]

    def apply(self, estimate: Trajectory) -> Trajectory:
        """The poses of an estimate in the world of the reference, where that is known."""
        parts = [
            similarity.apply(part)
            for similarity, part in zip(self.similarities, self._parts(estimate), strict=True)
            if similarity is not None
        ]
        return parts[0] if len(parts) == 1 else Trajectory.concatenate(parts)

    def to_estimate(self, reference: Trajectory) -> list[FloatArray]:
        """(M, 3) positions of the reference in each world that is aligned."""
        return [
            (part.positions - to.translation) @ to.rotation / to.scale
            for to, part in zip(self.similarities, self._parts(reference), strict=True)
            if to is not None
        ]

    @staticmethod
    def placed(variances: FloatArray) -> BoolArray:
        """(N,) whether positions with variances (N, 3), m², have a place in the first world.

        Those of a world that nothing joins to it have none. Where variances are not known they are
        not known to have none.
        """
        return np.asarray(~(variances.sum(axis=1) > _UNPLACED_M**2))

    def _parts(self, trajectory: Trajectory) -> list[Trajectory]:
        """The poses in each of the worlds."""
        world = self.world_of(trajectory.stamps_ns)
        return [trajectory.select(world == k) for k in range(len(self.similarities))]
