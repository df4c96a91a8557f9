# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The gate where the prediction of a pose is vague: what does not move with most features fails.

Without an IMU the new pose may be nearly anywhere. A gate against that prediction lets the features
of a moving object pass, which then pull the pose. So the features that fit the pose at which the
step is linearised, which is that of PnP, update the prediction first. The others have to pass the
gate against what is known then (as in 1-point RANSAC for filters: Civera, Grasa, Davison & Montiel
2010).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend.cost.cost import Cost, Linearization
from slam_graph.backend.cost.feature_factors import WhitenedObservations, sum_features
from slam_graph.backend.cost.gating import Gate
from slam_graph.backend.cost.measurement_rows import columns_of_state
from slam_graph.backend.cost.robust_loss import MEDIAN_2D, WIDTH_2D
from slam_graph.backend.solve.square_root import SquareRootInformation

_FEWEST, _LEAST_SHARE = 10, 0.5
"""Fewer features, or a smaller part of them, are no consensus."""
_CONFIDENCE = 0.99
"""Share of features at rest that pass the second test, of those that did not fit before."""


@dataclass(frozen=True, slots=True, eq=False)
class _Fitting:
    """Which features fit the linearisation point: of the state (N,), and new ones (J,)."""

    landmarks: BoolArray
    tracks: BoolArray


def gate_by_consensus(
    cost: Cost,
    linear: Linearization,
    predicted: SquareRootInformation,
    tested: BoolArray | None = None,
) -> Gate:
    """Which observations of features of the state and which new features pass; see `Cost.gate`.

    Args:
        cost: the cost of the step.
        linear: of it, not summed up, without the weights of Cauchy's loss.
        predicted: what is known of the variables before these measurements.
        tested: (J,) which of the new features are tested; all of them if it is not given.
    """
    fitting = _fitting(cost, linear)
    if fitting is None:
        return cost.gate(linear, predicted, tested)
    try:
        second = _second_gate(cost, linear, predicted, fitting, tested)
    except np.linalg.LinAlgError:  # the features that fit do not determine the step
        return cost.gate(linear, predicted, tested)
    tracks = fitting.tracks | second.tracks
    admitted = fitting.landmarks | second.landmarks, tracks if tested is None else tracks[tested]
    return cost.gate(linear, predicted, tested, admitted=admitted)


def _second_gate(
    cost: Cost,
    linear: Linearization,
    predicted: SquareRootInformation,
    fitting: _Fitting,
    tested: BoolArray | None,
) -> Gate:
    """The gate against what is known once the features that fit have updated the prediction."""
    posterior = predicted
    for rows in _rows(cost, linear, predicted, fitting):
        posterior = posterior.updated(rows)
    moved = posterior.solution()
    after = _after(cost, linear, moved, predicted)
    return cost.gate(after, posterior, tested, _CONFIDENCE)


def _fitting(cost: Cost, linear: Linearization) -> _Fitting | None:
    """The features without outliers at the linearisation point, None if these are too few.

    The limit follows the errors themselves, most of which are of features at rest.
    """
    errors = linear.errors[np.isfinite(linear.errors)]
    if not len(errors):
        return None
    limit = WIDTH_2D / MEDIAN_2D * float(np.median(errors))
    landmarks, tracks = np.zeros(0, np.bool_), np.zeros(0, np.bool_)
    if linear.landmarks is not None:
        landmarks = linear.landmarks.errors < limit
        # nearer or behind, the slope of the projection tells nothing
        landmarks &= linear.landmarks.depths >= cost.config.triangulation.min_depth_m
    if linear.tracks is not None and cost.tracks is not None:
        assert isinstance(linear.tracks, WhitenedObservations)
        worst = np.zeros(len(cost.tracks.points))
        np.maximum.at(worst, cost.tracks.obs.feature, linear.tracks.errors)
        tracks = worst < limit
    together = np.concatenate([landmarks, tracks])
    if np.sum(together) < max(_FEWEST, _LEAST_SHARE * len(together)):
        return None
    return _Fitting(landmarks, tracks)


def _rows(
    cost: Cost, linear: Linearization, predicted: SquareRootInformation, fitting: _Fitting
) -> list[FloatArray]:
    """Rows [A b] (m, n + 1) of the features that fit; new ones say what they say of poses."""
    part = replace(cost, landmarks=None, tracks=None)
    landmarks = summed = None
    if linear.landmarks is not None and cost.landmarks is not None:
        part.landmarks = cost.landmarks.rows(fitting.landmarks)
        landmarks = linear.landmarks.subset(fitting.landmarks)
    if linear.tracks is not None and cost.tracks is not None and fitting.tracks.any():
        assert isinstance(linear.tracks, WhitenedObservations)
        chosen = cost.tracks.subset(fitting.tracks)
        part.tracks = replace(chosen, in_state=np.zeros(len(chosen.points), np.bool_))
        observed = linear.tracks.subset(fitting.tracks[cost.tracks.obs.feature])
        summed = sum_features(part.tracks.obs, observed)
    return part.rows(Linearization(landmarks, summed, linear.errors), predicted.layout)


def _after(
    cost: Cost, linear: Linearization, moved: FloatArray, predicted: SquareRootInformation
) -> Linearization:
    """The linearisation with the residuals after an increment (n,) of the variables.

    Those of new features are after it of poses and calibration; the gate eliminates their points.
    """
    landmarks, tracks = linear.landmarks, linear.tracks
    if landmarks is not None and cost.landmarks is not None:
        along = moved[columns_of_state(cost.landmarks, predicted.layout, cost.rig.common_keys)]
        r = landmarks.r - np.einsum("nij,nj->ni", landmarks.H, along)
        landmarks = replace(landmarks, r=r)
    if tracks is not None and cost.tracks is not None:
        assert isinstance(tracks, WhitenedObservations)
        obs = cost.tracks.obs
        along = moved[predicted.layout.indices(cost.rig.keys_of(obs))]
        poses, common = np.split(along, [6 * len(obs.frames)])
        r = tracks.r - np.einsum("nij,nj->ni", tracks.by_pose, poses.reshape(-1, 6)[obs.frame])
        tracks = replace(tracks, r=r - tracks.by_calibration @ common)
    return Linearization(landmarks, tracks, linear.errors)
