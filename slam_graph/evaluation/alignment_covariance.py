# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is left of an error after an alignment in yaw and position, and how uncertain it is.

Position and yaw are only known relative to something (Kelly & Sukhatme 2011). The covariances of an
estimate are relative to its first state, where they vanish. An error against a ground truth is
relative to whatever the alignment fits, and needs another covariance.

The alignment here fits the smoothed trajectory to the truth over the whole run, so that it does not
depend on the truth's orientation at one time. The same transformation is applied to the causal
estimate. Let the two coincide in position and yaw at the first causal state. The smoothed state is
the best estimate from all data y, so that its error is uncorrelated with every function of y, and
so with d, the difference of the two estimates. With e the error of a causal state, s that of the
smoothed one, and g the part of all errors s that the alignment takes away,

    e - N g = (s - N g) + d,    Cov(e - N g) = Cov(s - N g) + Cov(e) - Cov(s).

The first term is `FinalBa.aligned`, the others are covariances relative to the first state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.evaluation.truth_pairing import nearest, synchronize
from slam_graph.geometry import Similarity, StateHistory, Trajectory

if TYPE_CHECKING:
    from slam_graph.backend import FinalBa

_SAME_FRAME_NS = 10_000_000
"""A causal and a smoothed state at most so far apart are of the same frame: the time offset of the
camera that was known then and at the end may differ."""


def aligned_by_smoothed(
    truth: Trajectory, history: StateHistory, smoothed: FinalBa
) -> tuple[Similarity, FloatArray] | None:
    """The alignment of a run by its smoothed trajectory, and what it leaves uncertain.

    Args:
        truth: the true trajectory.
        history: N states with covariances relative to the first: causal ones, or the smoothed.
        smoothed: the smoothed trajectory of the same run.

    Returns:
        The map from the world of the states to that of the truth, and (N, 6, 6) pose covariances of
        what is left, body frame, rotation before position, NaN where there is no smoothed state, or
        none with a positive definite covariance; None if the smoothed covariances are not known.

    Raises:
        DataError: if truth and smoothed trajectory share no time, or no yaw is determined.
    """
    after, best, estimate = smoothed.aligned, smoothed.trajectory, history.trajectory()
    if after is None or not np.isfinite(after).all() or len(estimate) == 0:
        return None
    rows = nearest(best.stamps_ns, estimate.stamps_ns)
    same = np.abs(best.stamps_ns[rows] - estimate.stamps_ns) <= _SAME_FRAME_NS
    if not same.any():
        return None
    true, fitted = synchronize(truth, best)
    onto = Similarity.of_positions(true.positions, fitted.positions, "yaw")
    first = np.flatnonzero(same)[:1]
    link = Similarity.of_first_pose(best.select(rows[first]), estimate.select(first))
    own, whole = history.pose_covariances(), smoothed.history.pose_covariances()[rows]
    covariances = np.full_like(own, np.nan)
    known = same & np.isfinite(own).all(axis=(1, 2)) & np.isfinite(whole).all(axis=(1, 2))
    known[known] = np.linalg.eigvalsh(whole[known])[:, 0] > 0.0
    covariances[known] = after[rows[known]] + _excess(own[known], whole[known])
    rotation = onto.rotation @ link.rotation
    return Similarity(rotation, onto.rotation @ link.translation + onto.translation), covariances


def _excess(causal: FloatArray, smoothed: FloatArray) -> FloatArray:
    """Causal less smoothed covariances (N, 6, 6), zero in directions where they are smaller.

    With more data a covariance is not larger, unless other noise was assumed.
    """
    L = np.linalg.cholesky(smoothed)
    inverse = np.linalg.inv(L)
    ratios, axes = np.linalg.eigh(inverse @ causal @ inverse.transpose(0, 2, 1))
    root = L @ axes
    more = np.maximum(ratios - 1.0, 0.0)
    return np.asarray((root * more[:, None]) @ root.transpose(0, 2, 1))
