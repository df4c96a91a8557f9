# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Absolute pose error: how far each estimated pose is from the true one (ATE, for its positions).

The difference of two poses is E = T_reference⁻¹ T_estimate, with rotation R and translation t. The
pose relation, under evo's names, says which part of it is the error:

| relation | error | unit |
|---|---|---|
| `full` | Frobenius norm of E - I | none (mixes rad and m) |
| `trans_part` | norm of t | m |
| `rot_part` | Frobenius norm of R - I | none |
| `angle_deg`, `angle_rad` | angle of R | deg, rad |

Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems"; with `pairing="nearest"`
the numbers are evo's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.display import Displayed
from slam_graph.evaluation.choices import ERROR_UNITS, Pairing, PoseRelation, require_known
from slam_graph.evaluation.truth_pairing import synchronize
from slam_graph.evaluation.worlds_apart import PiecewiseAlignment
from slam_graph.geometry import AlignmentMode, Similarity, Trajectory


@dataclass(frozen=True)
class Statistics:
    """Summary of N errors, in their unit (`sse`: in its square).

    Attributes:
        rmse: root of the mean square.
        mean: arithmetic mean.
        median: middle value.
        std: standard deviation, divided by N.
        min: smallest.
        max: largest.
        sse: sum of squares.
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float

    @staticmethod
    def of(errors: NDArray[np.float64]) -> Statistics:
        """The statistics of (N,) errors, N ≥ 1."""
        squares = errors * errors
        return Statistics(
            rmse=float(np.sqrt(squares.mean())),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
            sse=float(squares.sum()),
        )


@dataclass(frozen=True, eq=False, repr=False)
class ErrorSeries(Displayed):
    """Errors over time.

    Attributes:
        stamps_ns: (N,) times of the estimate; of the end of the pair for a relative error.
        values: (N,) errors.
        statistics: their summary.
        alignment: the maps that were applied to the estimate, of each of its worlds.
        poses: number of poses that both trajectories share.
        unit: of the errors; empty where they have none.
        step_unit: of the length of a step of a relative error.
    """

    stamps_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    statistics: Statistics
    alignment: PiecewiseAlignment
    poses: int
    unit: str = ""
    step_unit: str = ""

    def __len__(self) -> int:
        return len(self.values)

    @property
    def similarity(self) -> Similarity:
        """The map that was applied to the estimate, or to its first world."""
        return self.alignment.first

    def __repr__(self) -> str:
        parts = ", ".join(
            f"{name} {getattr(self.statistics, name):.4g}" for name in ("rmse", "mean", "max")
        )
        return f"ErrorSeries({len(self)} errors{f' [{self.unit}]' * bool(self.unit)}: {parts})"

    def table(self) -> dict[str, Any]:
        """Unit, scale of the alignment, numbers of poses and errors, and statistics."""
        return {
            "unit": self.unit,
            "scale": self.alignment.scale,
            "poses": self.poses,
            "errors": len(self.values),
            "statistics": asdict(self.statistics),
        }

    def _facts(self) -> dict[str, object]:
        unit = f" {self.unit}" if self.unit else ""
        table: dict[str, object] = {"errors": f"{len(self)}, of {self.poses} poses"}
        for name in ("rmse", "mean", "median", "std", "min", "max"):
            table[name] = f"{getattr(self.statistics, name):.4g}{unit}"
        return table

    def plot(self) -> Any:
        """The errors over time, and the share of them below each value, as a figure."""
        label = f"error [{self.unit}]" if self.unit else "error"
        rmse = self.statistics.rmse
        return self._drawn_by("notebook_figures").error_figure(
            self.stamps_ns, self.values, label, rmse
        )

    def _sketch(self) -> Any:
        return self.plot()


def ape(
    reference: Trajectory,
    estimate: Trajectory,
    relation: PoseRelation = "trans_part",
    alignment: AlignmentMode = "none",
    pairing: Pairing = "interpolate",
    limit_s: float | None = None,
    breaks_ns: Sequence[int] | IntArray = (),
) -> ErrorSeries:
    """Absolute pose error of an estimate.

    Args:
        reference: the true trajectory.
        estimate: the trajectory to judge.
        relation: which part of the difference of two poses counts.
        alignment: fitted over all poses that both share, before errors are taken.
        pairing: whether the truth is interpolated at the times of the estimate, or the pose
            nearest in time is taken.
        limit_s: the longest gap or difference in time that is bridged; None: as `synchronize` says.
        breaks_ns: increasing times at which the estimate goes on in another world. Each world is
            aligned by itself then, and left out if it cannot be.

    Raises:
        ConfigError: if there is no such relation, alignment or pairing.
        DataError: if the trajectories share no time, or cannot be aligned.
    """
    require_known(relation, ERROR_UNITS, "relation")
    truth, guess, worlds = aligned_pair(reference, estimate, alignment, pairing, limit_s, breaks_ns)
    difference = relative_poses(
        Rotation.from_quat(truth.quaternions),
        truth.positions,
        Rotation.from_quat(guess.quaternions),
        guess.positions,
    )
    values = errors(*difference, relation)
    statistics, unit = Statistics.of(values), ERROR_UNITS[relation]
    return ErrorSeries(guess.stamps_ns, values, statistics, worlds, len(truth), unit)


def aligned_pair(
    reference: Trajectory,
    estimate: Trajectory,
    alignment: AlignmentMode,
    pairing: Pairing,
    limit_s: float | None,
    breaks_ns: Sequence[int] | IntArray = (),
) -> tuple[Trajectory, Trajectory, PiecewiseAlignment]:
    """The truth and the estimate pose by pose, the estimate aligned, and the maps that did so.

    Raises:
        ConfigError: if there is no such alignment or pairing.
        DataError: if the trajectories share no time, or cannot be aligned.
    """
    require_known(alignment, get_args(AlignmentMode), "alignment")
    truth, guess = synchronize(reference, estimate, pairing, limit_s)
    worlds = PiecewiseAlignment.fitted(truth, guess, alignment, breaks_ns)
    return truth.select(worlds.known(guess.stamps_ns)), worlds.apply(guess), worlds


def relative_poses(
    rotations_a: Rotation, positions_a: FloatArray, rotations_b: Rotation, positions_b: FloatArray
) -> tuple[Rotation, FloatArray]:
    """T_a⁻¹ T_b of N pairs of poses, as rotations and (N, 3) translations."""
    inverse = rotations_a.inv()
    return inverse * rotations_b, inverse.apply(positions_b - positions_a)


def errors(rotations: Rotation, translations: FloatArray, relation: PoseRelation) -> FloatArray:
    """The (N,) errors of N relative poses.

    Args:
        rotations: R of the relative poses.
        translations: (N, 3) t of the relative poses, in metres.
        relation: which part counts.

    Raises:
        ConfigError: if there is no such relation.
    """
    require_known(relation, ERROR_UNITS, "relation")
    squared_distance: FloatArray = np.sum(translations**2, axis=1)
    if relation == "trans_part":
        return np.sqrt(squared_distance)
    if relation in ("full", "rot_part"):
        squared = np.sum((rotations.as_matrix() - np.eye(3)) ** 2, axis=(1, 2))
        return np.asarray(np.sqrt(squared + (squared_distance if relation == "full" else 0.0)))
    angles = np.asarray(rotations.magnitude(), dtype=np.float64)
    return np.degrees(angles) if relation == "angle_deg" else angles
