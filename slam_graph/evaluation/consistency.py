# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Is an estimator as sure as it should be? Normalised errors (NEES) and innovations (NIS) squared.

The NEES of an error e with covariance P is eᵀ P⁻¹ e. If P is right it follows a χ² distribution
with as many degrees of freedom as e has, so its mean over independent runs is that number: 3 for
an orientation or a position, 6 for a pose. More means too sure, less too careful. Over the frames
of one run the values are correlated, so that their mean scatters more than `mean_bounds` says.

The NIS asks the same of an innovation, what is measured less what was predicted of it, with its own
covariance: it needs no truth, and the innovations of a consistent filter are independent in time.

Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and Navigation", sec. 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from slam_graph.arrays import FloatArray
from slam_graph.evaluation.truth_pairing import paired
from slam_graph.geometry import Similarity, Trajectory

CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Nees:
    """NEES of the N states that have a covariance and a true pose at their time.

    Attributes:
        stamps_ns: (N,) their times.
        orientation: (N,) with 3 degrees of freedom.
        position: (N,) with 3.
        pose: (N,) with 6.
        covariances: (N, 6, 6) of these poses, rotation before position, body frame.
        similarity: the map from the world of the estimate to that of the truth that was applied.
        left_out: number of states of worlds whose place is not known, which have no NEES.
    """

    stamps_ns: NDArray[np.int64]
    orientation: FloatArray
    position: FloatArray
    pose: FloatArray
    covariances: FloatArray
    similarity: Similarity
    left_out: int = 0

    @staticmethod
    def joined(parts: Sequence[Nees], left_out: int = 0) -> Nees:
        """That of W ≥ 1 worlds, in the order of time, with the map of the first.

        Args:
            parts: of the worlds.
            left_out: number of states of further worlds.
        """

        def column(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(part, name) for part in parts])

        return Nees(
            column("stamps_ns"),
            orientation=column("orientation"),
            position=column("position"),
            pose=column("pose"),
            covariances=column("covariances"),
            similarity=parts[0].similarity,
            left_out=left_out,
        )

    def series(self) -> dict[str, tuple[FloatArray, int]]:
        """Each series by its name, with its degrees of freedom."""
        return {
            "orientation": (self.orientation, 3),
            "position": (self.position, 3),
            "pose": (self.pose, 6),
        }


def nees(
    estimate: Trajectory,
    pose_covariances: FloatArray,
    truth: Trajectory,
    similarity: Similarity | None = None,
) -> Nees:
    """NEES of the poses of an estimate.

    The error is the tangent from the estimated to the true pose, in the estimated body frame, as
    GTSAM's `Pose3.Logmap(estimate⁻¹ truth)` gives it; for the position alone it is
    R_estimateᵀ (p_truth - p_estimate). A rigid map of the world leaves body-frame covariances as
    they are, so only the poses are mapped.

    Args:
        estimate: N estimated poses.
        pose_covariances: (N, 6, 6) rotation before position, body frame; NaN where unknown.
        truth: interpolated at the times of the estimate; states outside it are left out.
        similarity: map from the estimate's world to that of the truth; covariances are scaled, too.
    """
    similarity = similarity or Similarity.identity()
    estimate = similarity.apply(estimate)
    known = np.flatnonzero(np.isfinite(pose_covariances).all(axis=(1, 2)))
    true, rows = paired(truth, estimate.select(known))
    own, P = estimate.select(known[rows]), pose_covariances[known[rows]]
    if similarity.scale != 1.0:
        units = np.repeat([1.0, similarity.scale], 3)
        P = units[:, None] * P * units
    rotations = Rotation.from_quat(own.quaternions)
    e_rotation = (rotations.inv() * Rotation.from_quat(true.quaternions)).as_rotvec()
    e_position = rotations.inv().apply(true.positions - own.positions)
    e_pose = [
        gtsam.Pose3.Logmap(gtsam.Pose3(gtsam.Rot3.Expmap(turn), shift))
        for turn, shift in zip(e_rotation, e_position, strict=True)
    ]
    return Nees(
        true.stamps_ns,
        orientation=_normalized_square(e_rotation, P[:, :3, :3]),
        position=_normalized_square(e_position, P[:, 3:, 3:]),
        pose=_normalized_square(np.reshape(e_pose, (-1, 6)), P),
        covariances=P,
        similarity=similarity,
    )


@dataclass(frozen=True, eq=False)
class AverageNees:
    """NEES over R independent runs, at T times.

    Attributes:
        average: (T,) mean over the runs: R times it is χ² distributed, with R times the degrees
            of freedom.
        bounds: between what each average lies with 95 % probability.
        inside: share of the times at which it does.
        mean: over all runs and times.
    """

    average: FloatArray
    bounds: tuple[float, float]
    inside: float
    mean: float


def average_nees(runs: FloatArray, dof: int) -> AverageNees:
    """Average the NEES (R, T) of Monte Carlo runs, each drawn with its own noise and start."""
    average = runs.mean(axis=0)
    low, high = mean_bounds(dof, len(runs))
    inside = np.mean((average >= low) & (average <= high))
    return AverageNees(average, (low, high), float(inside), float(average.mean()))


def mean_bounds(dof: int, count: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Between what the mean of `count` independent NEES values lies with a given probability."""
    low, high = dof * ratio_bounds(np.array(float(dof * count)), confidence)
    return float(low), float(high)


def ratio_bounds(dof: FloatArray, confidence: float = CONFIDENCE) -> FloatArray:
    """Between what χ² over its degrees of freedom lies with a given probability.

    Args:
        dof: any shape.
        confidence: the probability.

    Returns:
        (2, …) the lower and the upper bound.
    """
    tail = (1.0 - confidence) / 2.0
    # the quantile function of χ² with k degrees of freedom is 2 γ⁻¹(k/2, ·)
    quantiles = [2.0 * gammaincinv(dof / 2.0, p) for p in (tail, 1.0 - tail)]
    return np.asarray(quantiles) / dof


def _normalized_square(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Σ eᵀ P⁻¹ e of N errors (N, d) with covariances (N, d, d)."""
    if len(errors) == 0:
        return np.zeros(0)
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return np.asarray(np.sum(errors * solved, axis=1))
