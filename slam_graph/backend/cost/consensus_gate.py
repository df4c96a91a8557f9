# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The gate where the prediction of a pose is vague: what does not move with most features fails.

Without an IMU the new pose may be nearly anywhere. A gate against that prediction lets the features
of a moving object pass, which then pull the pose. So the features that fit the pose at which the
step is linearised, which is that of PnP, update the prediction first. The others have to pass the
gate against what is known then (as in 1-point RANSAC for filters: Civera, Grasa, Davison & Montiel
2010).

The nearest third of the features are always among the others. They tell most of the translation, so
that a pose which follows them fits nearly all of the farther ones too, if these may turn a little.
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
"""Where fewer features fit, or a smaller part of all, there is no consensus. Counted before the
nearest third is left out."""
_NEAREST = 1.0 / 3.0
"""Part of the features that fit, the nearest ones, that is left out of the consensus."""
_CONFIDENCE = 0.999
"""Share of features at rest that pass the second test, of those that are not of the consensus."""


@dataclass(frozen=True, slots=True, eq=False)
class _Consensus:
    """What updates the prediction before the second test.

    Attributes:
        landmarks: (N,) which observations of features of the state.
        tracks: (J,) which new features.
    """

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
    consensus = _consensus(cost, linear)
    if consensus is None:
        return cost.gate(linear, predicted, tested)
    try:
        second = _second_gate(cost, linear, predicted, consensus, tested)
    except np.linalg.LinAlgError:  # they do not determine the step
        return cost.gate(linear, predicted, tested)
    landmarks, tracks = consensus.landmarks.copy(), consensus.tracks | second.tracks
    landmarks[~landmarks] = second.landmarks
    admitted = landmarks, tracks if tested is None else tracks[tested]
    return cost.gate(linear, predicted, tested, admitted=admitted)


def _second_gate(
    cost: Cost,
    linear: Linearization,
    predicted: SquareRootInformation,
    consensus: _Consensus,
    tested: BoolArray | None,
) -> Gate:
    """The gate of all others against what is known with the consensus.

    Returns:
        Of the observations of features of the state only those that are not of the consensus.
    """
    posterior = predicted
    for rows in _rows(cost, linear, predicted, consensus):
        posterior = posterior.updated(rows)
    others = replace(cost)
    if linear.landmarks is not None and cost.landmarks is not None:
        others.landmarks = cost.landmarks.rows(~consensus.landmarks)
        linear = replace(linear, landmarks=linear.landmarks.subset(~consensus.landmarks))
    after = _after(others, linear, posterior.solution(), predicted)
    new = ~consensus.tracks if tested is None else tested & ~consensus.tracks
    return others.gate(after, posterior, new, _CONFIDENCE)


def _consensus(cost: Cost, linear: Linearization) -> _Consensus | None:
    """The features without outliers at the linearisation point, but for the nearest of them.

    The limit follows the errors themselves, most of which are of features at rest.

    Returns:
        None if too few fit.
    """
    errors = linear.errors[np.isfinite(linear.errors)]
    if not len(errors):
        return None
    limit = WIDTH_2D / MEDIAN_2D * float(np.median(errors))
    worst, depths = _of_features(cost, linear)
    # nearer or behind, the slope of the projection tells nothing
    fits = (worst < limit) & (depths >= cost.config.triangulation.min_depth_m)
    if np.sum(fits) < max(_FEWEST, _LEAST_SHARE * len(fits)):
        return None
    fits &= depths >= np.quantile(depths[fits], _NEAREST)
    count = 0 if linear.landmarks is None else len(linear.landmarks.errors)
    return _Consensus(fits[:count], fits[count:])


def _of_features(cost: Cost, linear: Linearization) -> tuple[FloatArray, FloatArray]:
    """Largest errors and smallest depths, of observations of the state and then of new features."""
    worst, depths = [np.zeros(0)], [np.zeros(0)]
    if linear.landmarks is not None:
        worst.append(linear.landmarks.errors)
        depths.append(linear.landmarks.depths)
    if linear.tracks is not None and cost.tracks is not None:
        assert isinstance(linear.tracks, WhitenedObservations)
        starts = cost.tracks.obs.starts[:-1]
        worst.append(np.maximum.reduceat(linear.tracks.errors, starts))
        depths.append(np.minimum.reduceat(linear.tracks.depths, starts))
    return np.concatenate(worst), np.concatenate(depths)


def _rows(
    cost: Cost, linear: Linearization, predicted: SquareRootInformation, consensus: _Consensus
) -> list[FloatArray]:
    """Rows [A b] (m, n + 1) of the consensus; new features say what they say of poses."""
    part = replace(cost, landmarks=None, tracks=None)
    landmarks = summed = None
    if linear.landmarks is not None and cost.landmarks is not None:
        part.landmarks = cost.landmarks.rows(consensus.landmarks)
        landmarks = linear.landmarks.subset(consensus.landmarks)
    if linear.tracks is not None and cost.tracks is not None and consensus.tracks.any():
        assert isinstance(linear.tracks, WhitenedObservations)
        chosen = cost.tracks.subset(consensus.tracks)
        part.tracks = replace(chosen, in_state=np.zeros(len(chosen.points), np.bool_))
        observed = linear.tracks.subset(consensus.tracks[cost.tracks.obs.feature])
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
