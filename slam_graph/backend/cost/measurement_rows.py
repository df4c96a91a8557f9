# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of all observations of a step, in the form in which an update of the prior is cheapest.

The first variables of a prior are features, its last ones poses, and an observation of a feature of
the state touches three columns of the former. Its rows are triangularised and put in the order of
the features, so that row i has nothing to the left of column i. What is left of them, of poses
only, and what other features say of poses is folded in afterwards, behind the columns of features.
So an update leaves out most zeros (`updated` in `square_root.py`): half of its arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_factors import SummedFeatures, WhitenedObservations
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.solve.square_root import Layout, triangularize
from slam_graph.backend.solve.state import POINT_DIM, POSE_DIM, landmark_keys
from slam_graph.kernels.state_rows import fill_state_rows


def state_feature_rows(
    obs: Observations,
    linear: WhitenedObservations,
    of_points: IntArray,
    columns: NDArray[np.intp],
    size: int,
) -> tuple[FloatArray, FloatArray]:
    """Rows of features of the state: those that contain the feature, and the others.

    Args:
        obs: N observations of J features, of which some may have none.
        linear: their linearisation.
        of_points: (J,) first column of each feature.
        columns: (k,) of poses and calibration.
        size: number of all columns, n.

    Returns:
        Rows [A b] (m, n + 1), at most three for each feature, triangular in its columns and in the
        order of these; and rows (K, k + 1) over `columns`, at most as many as these.
    """
    with_feature, order = np.minimum(2 * obs.counts, POINT_DIM), of_points.argsort()
    leading = np.zeros((int(with_feature.sum()), size + 1), order="F")
    rest = np.empty((2 * len(obs) - len(leading), len(columns) + 1))
    parts = linear.r, linear.by_pose, linear.by_point, linear.by_calibration
    fill_state_rows(*parts, obs.frame, obs.starts, order, of_points, columns, leading, rest)
    return leading, triangularize(rest) if len(rest) > rest.shape[1] else rest


def pose_rows(
    rows: FloatArray,
    tracks: SummedFeatures | None,
    new: IntArray,
    own: NDArray[np.intp],
    columns: tuple[NDArray[np.intp], NDArray[np.intp]],
    size: int,
) -> FloatArray:
    """Rows of poses and calibration, and of features that enter the state.

    Args:
        rows: (K, k + 1) of features of the state.
        tracks: J features outside the state.
        new: those of them that become variables.
        own: (3 N,) the columns of these.
        columns: (k,) and (6 F + C,), those of `rows` and those of `tracks`.
        size: number of all columns, n.

    Returns:
        Rows [A b] (m, n + 1), in the order that LAPACK takes.
    """
    end, summed = len(rows), 0 if tracks is None else len(tracks.rows)
    Ab = np.zeros((end + summed + len(own), size + 1), order="F")
    Ab[:end, columns[0]], Ab[:end, -1] = rows[:, :-1], rows[:, -1]
    if tracks is None:
        return Ab
    last = end + summed
    Ab[end:last, columns[1]], Ab[end:last, -1] = tracks.rows[:, :-1], tracks.rows[:, -1]
    if len(new):
        each = np.arange(last, len(Ab)).reshape(-1, POINT_DIM)
        Ab[each[:, :, None], own.reshape(-1, 1, POINT_DIM)] = tracks.R_f[new]
        Ab[last:, columns[1]] = tracks.T[new].reshape(len(own), -1)
        Ab[last:, -1] = tracks.r_1[new].ravel()
    return Ab


def columns_of_state(
    obs: Observations, layout: Layout, common_keys: Sequence[int]
) -> NDArray[np.intp]:
    """Columns (N, 9 + C) of each observation: its pose, its feature, and what all have in common.

    Args:
        obs: of features of the state.
        layout: of the variables.
        common_keys: of the calibration.
    """
    poses = np.array([layout.starts[X(i)] for i in obs.frames])
    points, calibration = starts_of_points(obs, layout), layout.indices(common_keys)
    own = POSE_DIM + POINT_DIM
    columns = np.empty((len(obs), own + len(calibration)), np.intp)
    columns[:, :POSE_DIM] = poses[obs.frame][:, None] + np.arange(POSE_DIM)
    columns[:, POSE_DIM:own] = points[obs.feature][:, None] + np.arange(POINT_DIM)
    columns[:, own:] = calibration
    return columns


def starts_of_points(obs: Observations, layout: Layout) -> NDArray[np.intp]:
    """The first column (J,) of each feature of the state; 0 of others, which have no rows."""
    return np.array([layout.starts.get(key, 0) for key in landmark_keys(obs.ids)], np.intp)


def gated_columns(
    landmarks: Observations | None, tracks: Observations | None, rig: RigProjection, layout: Layout
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Columns (N, 9 + C) of observations of features of the state, and (6 F + C,) of poses.

    Args:
        landmarks: N of features of the state; None for none.
        tracks: of new features, which F poses have seen; None for none.
        rig: the cameras.
        layout: of the variables.
    """
    columns, poses = np.zeros((0, POSE_DIM + POINT_DIM), np.intp), np.zeros(0, np.intp)
    if landmarks is not None:
        columns = columns_of_state(landmarks, layout, rig.common_keys)
    if tracks is not None and len(tracks):
        poses = layout.indices(rig.keys_of(tracks))
    return columns, poses
