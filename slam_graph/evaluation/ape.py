# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Absolute pose error: how far each estimated pose is from the true one (ATE, for its positions).

Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems"; numbers as evo's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.evaluation.association import DEFAULT_MAX_DIFFERENCE_S, synchronize
from slam_graph.evaluation.choices import PoseRelation
from slam_graph.evaluation.relations import errors, relative_poses
from slam_graph.evaluation.statistics import Statistics
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.geometry.trajectory_alignment import AlignmentMode, Similarity, align


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors over time.

    Attributes:
        stamps_ns: (N,) times of the estimate; of the end of the pair for a relative error.
        values: (N,) errors.
        statistics: their summary.
        similarity: the map that was applied to the estimate.
        poses: number of poses that both trajectories share.
    """

    stamps_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    statistics: Statistics
    similarity: Similarity
    poses: int


def ape(
    reference: Trajectory,
    estimate: Trajectory,
    relation: PoseRelation = "trans_part",
    alignment: AlignmentMode = "none",
    max_difference_s: float = DEFAULT_MAX_DIFFERENCE_S,
) -> ErrorSeries:
    """Absolute pose error of an estimate.

    Args:
        reference: the true trajectory.
        estimate: the trajectory to judge.
        relation: which part of the difference of two poses counts.
        alignment: fitted over all poses that both share, before errors are taken.
        max_difference_s: how far apart in time two poses may be to be compared.

    Raises:
        DataError: if the trajectories share no time, or cannot be aligned.
    """
    truth, guess = synchronize(reference, estimate, max_difference_s)
    similarity = align(truth.positions, guess.positions, alignment)
    aligned = similarity.apply(guess)
    difference = relative_poses(
        Rotation.from_quat(truth.quaternions),
        truth.positions,
        Rotation.from_quat(aligned.quaternions),
        aligned.positions,
    )
    values = errors(*difference, relation)
    return ErrorSeries(guess.stamps_ns, values, Statistics.of(values), similarity, len(truth))
