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

import math
from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, median
from slam_graph.backend.cost.cost import Cost, Linearization
from slam_graph.backend.cost.feature_factors import WhitenedObservations, sum_features
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.gating import (
    Gate,
    distances_of_rows,
    distances_of_tracks,
    threshold,
)
from slam_graph.backend.cost.measurement_rows import gated_columns
from slam_graph.backend.cost.robust_loss import MEDIAN_2D, WIDTH_2D
from slam_graph.backend.cost.whitened_update import GatedRows, WhitenedUpdate, gated_rows
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM

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
    known = _root_with_rows(cost, linear, predicted)
    try:
        update = WhitenedUpdate(predicted, known.tail, *_rows(cost, linear, known, consensus))
    except np.linalg.LinAlgError:
        return cost.gate(linear, predicted, tested)
    landmarks = consensus.landmarks | _landmarks_pass(linear, update, known)
    others = ~consensus.tracks if tested is None else tested & ~consensus.tracks
    tracks = consensus.tracks | _tracks_pass(cost, linear, update, known, others)
    admitted = landmarks, tracks if tested is None else tracks[tested]
    if tested is not None and cost.tracks is not None:
        obs = cost.tracks.obs.subset(tested).without_idle_frames()
        known = known.of_poses(gated_columns(None, obs, cost.rig, predicted.layout)[1])
    return cost.gate(linear, predicted, tested, admitted=admitted, known=known)


def _root_with_rows(
    cost: Cost, linear: Linearization, predicted: SquareRootInformation
) -> GatedRows:
    """What both tests need of all observations."""
    landmarks = None if linear.landmarks is None else cost.landmarks
    tracks = None if linear.tracks is None or cost.tracks is None else cost.tracks.obs
    columns, poses = gated_columns(landmarks, tracks, cost.rig, predicted.layout)
    H = np.zeros((0, 2, 9)) if linear.landmarks is None else linear.landmarks.H
    return gated_rows(predicted, columns, poses, H)


def _landmarks_pass(linear: Linearization, update: WhitenedUpdate, known: GatedRows) -> BoolArray:
    """Which observations (N,) of features of the state fit what is known with the consensus.

    The distance of a residual is at most its square. Only for what is larger than the limit the
    covariance is wanted.
    """
    if linear.landmarks is None:
        return np.zeros(0, np.bool_)
    rows = known.rows.reshape(-1, len(update.mean))
    r = linear.landmarks.r - (rows @ update.mean).reshape(-1, 2)
    limit = threshold(np.array([2]), _CONFIDENCE)[0]
    passed: BoolArray = np.einsum("ni,ni->n", r, r) < limit
    large = (~passed).nonzero()[0]
    if len(large):
        of_large = known.rows.take(large, axis=0)
        reduction = update.reduction(of_large.reshape(-1, rows.shape[1]))
        reduction = reduction.reshape(len(large), 2, -1)
        passed[large] = distances_of_rows(r[large], of_large, reduction) < limit
    return passed


def _tracks_pass(
    cost: Cost,
    linear: Linearization,
    update: WhitenedUpdate,
    known: GatedRows,
    tested: BoolArray,
) -> BoolArray:
    """Which new features (J,) fit what is known with the consensus, of those that are tested."""
    if linear.tracks is None or cost.tracks is None:
        return tested
    after, obs = _tracks_after(cost.tracks.obs, linear, update, known), cost.tracks.obs
    squares = np.einsum("ni,ni->n", after.r, after.r)
    limits = threshold(2 * obs.counts - POINT_DIM, _CONFIDENCE)
    large = tested & (np.add.reduceat(squares, obs.starts[:-1]) >= limits)
    passed = tested & ~large
    if large.any():
        of_large = after.subset(large[obs.feature])
        covariance = update.covariance(known.pose_root)
        distances = distances_of_tracks(obs.subset(large), of_large, covariance)
        passed[large] = distances < limits[large]
    return passed


def _consensus(cost: Cost, linear: Linearization) -> _Consensus | None:
    """The features without outliers at the linearisation point, but for the nearest of them.

    The limit follows the errors themselves, most of which are of features at rest.

    Returns:
        None if too few fit.
    """
    errors = linear.errors[np.isfinite(linear.errors)]
    if not len(errors):
        return None
    limit = WIDTH_2D / MEDIAN_2D * float(median(errors))
    worst, depths = _of_features(cost, linear)
    # nearer or behind, the slope of the projection tells nothing
    fits = (worst < limit) & (depths >= cost.config.triangulation.min_depth_m)
    if np.sum(fits) < max(_FEWEST, _LEAST_SHARE * len(fits)):
        return None
    ascending = np.sort(depths[fits])
    fits &= depths >= ascending[math.ceil(_NEAREST * (len(ascending) - 1))]
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
    cost: Cost, linear: Linearization, known: GatedRows, consensus: _Consensus
) -> tuple[FloatArray, FloatArray]:
    """Rows [Y b] of the consensus by whitened variables, of new features those of the poses."""
    m = len(known.tail.W)
    Y, b = [np.zeros((0, m))], [np.zeros(0)]
    if linear.landmarks is not None:
        chosen = consensus.landmarks.nonzero()[0]
        Y.append(known.rows.take(chosen, axis=0).reshape(-1, m))
        b.append(linear.landmarks.r.take(chosen, axis=0).ravel())
    if linear.tracks is not None and cost.tracks is not None and consensus.tracks.any():
        assert isinstance(linear.tracks, WhitenedObservations)
        observed = linear.tracks.subset(consensus.tracks[cost.tracks.obs.feature])
        rows = sum_features(cost.tracks.obs.subset(consensus.tracks), observed).rows
        by_poses = np.zeros((len(rows), m))
        by_poses[:, m - len(known.pose_root) :] = rows[:, :-1] @ known.pose_root.T
        Y.append(by_poses)
        b.append(rows[:, -1])
    return np.concatenate(Y), np.concatenate(b)


def _tracks_after(
    obs: Observations, linear: Linearization, update: WhitenedUpdate, known: GatedRows
) -> WhitenedObservations:
    """New features with the residuals after the increment of poses and calibration.

    The gate eliminates their points.
    """
    tracks = linear.tracks
    assert isinstance(tracks, WhitenedObservations)
    moved = update.solution()[known.poses]
    poses, common = np.split(moved, [6 * len(obs.frames)])
    r = tracks.r - np.einsum("nij,nj->ni", tracks.by_pose, poses.reshape(-1, 6)[obs.frame])
    return replace(tracks, r=r - tracks.by_calibration @ common)
