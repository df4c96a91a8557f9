# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Is an object one rigid body, and is its motion the one that explains its tracks best?

Two things go wrong that the residuals of an estimator hardly show. Two bodies of which one comes
nearer while the other goes away fit one body that turns. And a few points on a plane that faces the
cameras fit two motions, mirror images of one another (Necker's cube), of which an estimator that
began with the wrong one does not find the other. So from time to time the tracks of the last frames
are estimated anew: all of them, and each half. Twice the logarithm of the likelihood ratio, the
difference of the squared errors, has a χ² distribution of as many degrees of freedom as there are
further unknowns, if nothing is wrong (Wilks 1938).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import chdtri

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.gating import threshold
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.free_motion import freely_fitted
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import RelativeMotion, motion_over
from slam_graph.backend.objects.track_assignment import FITS
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.backend.objects.tracked_object import TrackedObject
from slam_graph.backend.policies import AlgorithmConfig

_LEAST_FRAMES = 3
"""Frames of a window that tell anything."""
_AGAIN = 0.01
"""Probability with which an object begins again without need; what it loses is its past."""
_NEARLY = 0.75
"""Part of the gain with which an object begins again, that free poses must have: from other poses
an estimate may find a motion that is a little better than what is found near the one it has."""
_LABEL = 2.0 * float(np.log(2.0))
"""What it costs that a track may be of either half: both are as likely."""
_ROUNDS = 2
"""Times that tracks go to the half that they fit better."""


@dataclass(frozen=True, eq=False)
class Part:
    """Tracks that move as one.

    Attributes:
        members: (N,) their ids, ascending.
        motion: their estimator, which has taken the frames of the window.
    """

    members: IntArray
    motion: RelativeMotion


class ObjectReview:
    """Compares the estimate of an object with those that begin now.

    Args:
        window: the last frames.
        ego: the motion of the platform over them.
        sigma_px: standard deviation of the observations.
        policies: algorithm and settings of the estimators.
        config: of objects.
    """

    def __init__(
        self,
        window: TrackWindow,
        ego: EgoMotion,
        sigma_px: float,
        policies: tuple[AlgorithmConfig, BackendConfig],
        config: ObjectsConfig,
    ) -> None:
        self._window, self._ego, self._sigma_px = window, ego, sigma_px
        self._policies, self._config = policies, config

    def of(self, item: TrackedObject) -> list[Part]:
        """What an object is: nothing if it is as it is known, one part to begin again, or two."""
        least = self._config.min_points
        members = item.taken
        # an estimate that begins anew costs most, and is made only where it can be better
        if not self._in_doubt(item, members) or not self._promising(item, members):
            return []
        anew = self._begun(members)
        if anew is None:
            return []
        stamps = [stamp for stamp in anew.motion.poses if stamp in item.poses]
        if not self._fill_the_window(stamps):
            return []
        current = self._total(members, item, stamps)
        best, part = self._total(members, anew.motion, stamps), anew
        halves: list[Part] = []
        enough = self._enough(members, stamps)
        if (
            item.label == 0  # masks tell objects apart
            and len(members) >= 2 * least
            and min(current, best) > self._expected(members, stamps)
        ):
            halves = self._halves(members, least, min(current, best) - enough)
        for half in halves:
            squares = self._total(members, half.motion, stamps)
            if squares < best:
                best, part = squares, half
        if halves:
            apart = sum(self._total(half.members, half.motion, stamps) for half in halves)
            if min(current, best) - apart > enough:
                return halves
        again = current - best > _as_chance(stamps, _AGAIN)
        return [Part(item.members, part.motion)] if again else []

    def _in_doubt(self, item: TrackedObject, members: IntArray) -> bool:
        """Whether an estimate fills the window, and its errors are larger than those of one body.

        Where they are no larger, no new estimate was so much better that it was taken.
        """
        stamps = [stamp for stamp in self._window.stamps_ns if stamp in item.poses]
        if not self._fill_the_window(stamps):
            return False
        return self._total(members, item, stamps) > self._expected(members, stamps)

    def _promising(self, item: TrackedObject, members: IntArray) -> bool:
        """Whether poses that are free of one another fit so well that a new estimate may as well.

        Those of all tracks, or of two halves. What an estimate finds obeys dynamics, too.
        """
        stamps = [stamp for stamp in self._window.stamps_ns if stamp in item.poses]
        current = self._total(members, item, stamps)
        free = self._free_squares(members, members, item, stamps)
        if current - float(free.sum()) > _NEARLY * _as_chance(stamps, _AGAIN):
            return True
        members, pixels = self._window.pixels(members)
        least = self._config.min_points
        if item.label or len(members) < 2 * least:
            return False
        first = _one_side(pixels)
        if min(np.count_nonzero(first), np.count_nonzero(~first)) < least:
            return False
        of_halves = (
            self._free_squares(members[part], members, item, stamps) for part in (first, ~first)
        )
        together = float(np.minimum(*of_halves).sum()) - 6 * (len(stamps) - 1)
        return together <= current - self._enough(members, stamps)

    def _free_squares(
        self, part: IntArray, members: IntArray, item: TrackedObject, stamps: list[int]
    ) -> FloatArray:
        """(N,) squared errors of tracks under the free poses that fit a part of them best."""
        poses = [item.poses[stamp] for stamp in stamps]
        obs = self._window.observations(part, _LEAST_FRAMES, stamps)
        points = self._window.triangulated(obs, stamps, poses).points
        known = np.asarray(np.isfinite(points).all(axis=1))
        obs, rig = obs.subset(known), self._window.projection(stamps, poses)
        loss = RobustLoss(self._policies[1].gating.loss)
        given = obs, rig, poses, points[known], self._sigma_px, loss
        fitted = freely_fitted(*given) if len(obs) else poses
        return self._squares(members, dict(zip(stamps, fitted, strict=True)))

    def _enough(self, members: IntArray, stamps: list[int]) -> float:
        """By how much squared errors of two halves must be less than those of one body."""
        return _as_chance(stamps, self._config.false_alarm) + _LABEL * len(members)

    def _fill_the_window(self, stamps: list[int]) -> bool:
        """Whether a motion is known over the whole window; earlier too many motions fit."""
        if len(stamps) < _LEAST_FRAMES:
            return False
        period = (stamps[-1] - stamps[0]) / (len(stamps) - 1)
        return len(stamps) * period > self._config.window_s * 1e9

    def _expected(self, members: IntArray, stamps: list[int]) -> float:
        """Sum of the squared errors of one body; larger ones are found in one of six frames."""
        length = np.isin(self._window.stamps_ns, stamps)
        obs = self._window.observations(members, _LEAST_FRAMES, stamps)
        dof = float(np.sum(2 * obs.counts - 3)) - 6 * (np.count_nonzero(length) - 1)
        return dof + float(np.sqrt(2.0 * max(dof, 1.0)))

    def _halves(self, members: IntArray, least: int, most: float) -> list[Part]:
        """Two parts of some tracks, each with a motion of its own; none if one is too small.

        Args:
            members: (N,) ids of the tracks, ascending.
            least: fewest of a part.
            most: squared errors of both above which they are not told apart. Tracks do not go over
                where the errors are above that by more than what a motion takes.
        """
        members, pixels = self._window.pixels(members)
        if len(members) < 2 * least:
            return []
        first = _one_side(pixels)
        halves: list[Part] = []
        for _ in range(1 + _ROUNDS):
            parts = [members[first], members[~first]]
            if min(map(len, parts)) < least:
                return []
            found = [self._begun(part) for part in parts]
            halves = [part for part in found if part is not None]
            if len(halves) < 2:
                return []
            squares = [self._squares(members, half.motion.poses) for half in halves]
            nearer = squares[0] <= squares[1]
            together = float(np.minimum(*squares).sum()) - 6 * (len(halves[0].motion.poses) - 1)
            if np.array_equal(nearer, first) or together > most:
                break
            first = nearer
        return halves

    def _begun(self, members: IntArray) -> Part | None:
        motion = motion_over(members, self._window, self._ego, self._policies, self._config)
        return None if motion is None else Part(members, motion)

    def _squares(self, members: IntArray, poses: dict[int, gtsam.Pose3]) -> FloatArray:
        """(N,) squared errors of tracks over σ²; 0 for those that are too short.

        Beyond what a track of the body has they say that it is of none, not how it moves.
        """
        fit, squares, dof = self._window.misfit(members, poses, self._sigma_px)
        result = np.zeros(len(members))
        result[is_in(members, fit)] = np.minimum(squares, threshold(dof, 1.0 - FITS))
        return result

    def _total(
        self, members: IntArray, motion: RelativeMotion | TrackedObject, stamps: list[int]
    ) -> float:
        """Sum of the squared errors of tracks in some frames."""
        poses = {stamp: motion.poses[stamp] for stamp in stamps if stamp in motion.poses}
        if len(poses) < len(stamps):
            return np.inf
        return float(self._squares(members, poses).sum())


def _as_chance(stamps: list[int], probability: float) -> float:
    """By how much a further motion over some frames lowers squared errors by chance."""
    return float(chdtri(6 * (len(stamps) - 1), probability))


def _one_side(pixels: FloatArray) -> BoolArray:
    """Which points (N, 2) are on one side of their middle, along their longest axis."""
    away = pixels - pixels.mean(axis=0)
    axis = np.linalg.svd(away, full_matrices=False)[2][0]
    return np.asarray(away @ axis > 0)
