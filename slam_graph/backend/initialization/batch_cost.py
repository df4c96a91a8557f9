# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of the batch problem of a start.

Features are triangulated again after every step (variable projection, Golub & Pereyra 1973): over
so short a window their depths are far from linear, and steps that move states and points together
hardly get on along the direction of scale and tilt, which the data determine least.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.cost import Cost, Linearization
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.triangulation import Triangulation, triangulate
from slam_graph.backend.solve.square_root import Layout


class BatchCost(Cost):
    """The cost of a window whose features outside the state follow the poses."""

    defines_unit = True
    # squared residuals (N,) of some observations at some points, where a step has led
    _moved: tuple[Observations, FloatArray, FloatArray] | None = None
    _known_rows: tuple[tuple[object, ...], FloatArray] | None = None  # of GTSAM's factors

    def apply(self, delta: FloatArray, linear: Linearization, layout: Layout) -> None:
        """Move the states by an increment (n,), and triangulate the features from there."""
        super().apply(delta, linear, layout)
        assert self.tracks is not None
        tracks, obs = self.tracks, self.tracks.obs
        found = self.triangulated(obs)
        squares = [self.squared_errors(obs, points) for points in (found.points, tracks.points)]
        ours, theirs = (np.bincount(obs.feature, part, len(obs.ids)) for part in squares)
        better = found.good & (ours < theirs)
        points = np.where(better[:, None], found.points, tracks.points)
        self.tracks = replace(tracks, points=points)
        self._moved = obs, points, np.where(better[obs.feature], *squares)

    def _loss(self, obs: Observations, points: FloatArray | None) -> float:
        known, self._moved = self._moved, None
        if known is None or known[0] is not obs or known[1] is not points:
            return super()._loss(obs, points)
        return float(np.sum(self.robust.value(np.sqrt(known[2]))))

    def triangulated(self, obs: Observations) -> Triangulation:
        """Features from the current estimates of the poses."""
        rig = self.rig.at(self.state)
        poses = rig.when_taken(obs.frames, *self.state.poses(obs.frames))
        return triangulate(rig.renormalized(obs), rig, *poses, self.config.triangulation)

    def factor_rows(self, layout: Layout) -> FloatArray:
        """Rows [A b] of GTSAM's factors; those at the same estimates are not linearised again."""
        at = self.state.frames, self.state.first_frames, layout
        known = self._known_rows
        if known is None or any(a is not b for a, b in zip(known[0], at, strict=True)):
            known = self._known_rows = at, super().factor_rows(layout)
        return known[1].copy(order="F")
