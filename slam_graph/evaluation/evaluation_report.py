# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What ground truth says about an estimate, as plain tables for a file or a printer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.evaluation.absolute_pose_error import ErrorSeries, ape
from slam_graph.evaluation.alignment_covariance import aligned_by_smoothed
from slam_graph.evaluation.consistency import CONFIDENCE, Nees, mean_bounds, nees, ratio_bounds
from slam_graph.evaluation.relative_pose_error import rpe
from slam_graph.evaluation.truth_pairing import synchronize
from slam_graph.evaluation.unknown_scale import mounted_covariances, scale_of_covariances
from slam_graph.evaluation.worlds_apart import PiecewiseAlignment
from slam_graph.geometry import (
    AlignmentMode,
    Similarity,
    StateHistory,
    Trajectory,
)

if TYPE_CHECKING:
    from slam_graph.backend import FinalBa

_REPORTED_ALIGNMENTS: tuple[AlignmentMode, ...] = ("none", "yaw", "se3", "sim3")

_RPE_DELTA_M = 1.0
"""Relative errors are taken over all pairs of poses about one metre of path apart."""

_NO_SCALE = "the scale is unknown: see sim3"

Table = dict[str, Any]

_NeesAlignment = AlignmentMode | Literal["first_pose", "first_pose_and_scale"]


def accuracy_report(
    reference: Trajectory,
    estimate: Trajectory,
    scaled_camera: gtsam.Pose3 | None = None,
    breaks_ns: Sequence[int] = (),
) -> Table:
    """Absolute and relative errors, translation (m) and rotation (deg), under each alignment.

    Args:
        reference: the true trajectory.
        estimate: the other one.
        scaled_camera: body_T_camera, where lengths of the estimate are known up to a scale. Errors
            are then those of the camera's path, and only after an alignment in scale.
        breaks_ns: increasing times at which the estimate goes on in another world; each world is
            aligned by itself, and a scale that is not common to all is NaN.

    Returns:
        For each alignment `{"scale", "poses", "ate": {"translation_m", "rotation_deg"}, "rpe":
        …}` with the statistics of each; a table of the form `{"unavailable": reason}` stands
        where the trajectories do not allow it.
    """
    if scaled_camera is not None:
        reference, estimate = (path.mounted(scaled_camera) for path in (reference, estimate))
    return {
        mode: _or_reason(partial(_errors_under, reference, estimate, mode, breaks_ns))
        if scaled_camera is None or mode == "sim3"
        else {"unavailable": _NO_SCALE}
        for mode in _REPORTED_ALIGNMENTS
    }


def consistency_report(
    truth: Trajectory,
    history: StateHistory,
    aligned: bool,
    smoothed: FinalBa | None = None,
    breaks_ns: Sequence[int] = (),
) -> Table | None:
    """NEES of orientation, position and pose, or None without covariances.

    Args:
        truth: the true trajectory.
        history: estimated states.
        aligned: whether the estimate already lives in the world of the truth (the start was
            given, or fixes have told it); otherwise it is aligned as `nees_of_run` says.
        smoothed: see `nees_of_run`.
        breaks_ns: see `nees_of_run`.
    """
    result, alignment = nees_of_run(truth, history, aligned, smoothed, breaks_ns)
    if len(result.stamps_ns) == 0:
        return None
    table: Table = {
        "alignment": alignment,
        "states": len(result.pose),
        "left_out": result.left_out,
    }
    for name, (values, dof) in result.series().items():
        low, high = mean_bounds(dof, 1)
        table[name] = {
            "mean": float(values.mean()),
            "median": float(np.median(values)),
            "ideal_mean": dof,
            "chi2_bounds": [low, high],
            "confidence": CONFIDENCE,
            "inside_bounds": float(np.mean((values >= low) & (values <= high))),
        }
    return table


def innovation_report(columns: Mapping[str, NDArray[np.float64]]) -> Table | None:
    """NIS over its degrees of freedom, which should be 1, or None if nothing was predicted.

    Args:
        columns: for N frames the numbers of measurements that were `tested` and `rejected` by the
            gate; squared Mahalanobis distances and degrees of freedom of all, `distance` and `dof`,
            and of those that passed, `passed_distance` and `passed_dof`; and the mean that a right
            covariance lets one expect of these behind the gate, `expected`.

    Returns:
        `mean` is of what entered the update, `expected_mean` what the gate leaves of the ideal 1,
        `chi2_bounds` those of a frame with the median number of degrees of freedom, and
        `inside_bounds` the share of the frames whose NIS, divided by what is expected of it, is
        inside its own; `mean_before_gate` is of all that was tested.
    """
    entered = columns["passed_dof"] > 0
    if not entered.any():
        return None
    distance, dof, expected = (
        columns[name][entered] for name in ("passed_distance", "passed_dof", "expected")
    )
    low, high = ratio_bounds(dof)
    inside = (distance / expected >= low) & (distance / expected <= high)
    return {
        "frames": int(np.sum(entered)),
        "mean": float(distance.sum() / dof.sum()),
        "ideal_mean": 1.0,
        "expected_mean": float(expected.sum() / dof.sum()),
        "mean_bounds": ratio_bounds(dof.sum(keepdims=True))[:, 0].tolist(),
        "chi2_bounds": ratio_bounds(np.median(dof, keepdims=True))[:, 0].tolist(),
        "confidence": CONFIDENCE,
        "inside_bounds": float(inside.mean()),
        "mean_before_gate": float(columns["distance"].sum() / columns["dof"].sum()),
        "dof_per_frame": float(dof.mean()),
        "rejected": float(columns["rejected"].sum() / columns["tested"].sum()),
    }


def nees_of_run(
    truth: Trajectory,
    history: StateHistory,
    aligned: bool,
    smoothed: FinalBa | None = None,
    breaks_ns: Sequence[int] = (),
) -> tuple[Nees, _NeesAlignment]:
    """NEES of the states of a run, and the alignment under which it was taken.

    An estimate that does not live in the world of the truth is aligned in yaw and position, which
    nothing tells it (without an IMU in all of the rotation), and a covariance has to be that of
    what the alignment leaves:

    - `yaw`: over the whole run, by the smoothed trajectory (`alignment_covariance.py`);
    - `first_pose`, without one: at the first state, relative to which covariances are. A truth
      whose orientation is wrong there turns all positions;
    - `first_pose_and_scale`, where nothing measures lengths: the scale, too, is that to which
      covariances are relative (`unknown_scale.py`). So a wrong scale as a whole is no error, and
      one that drifts is. The poses are those of the camera, whose path it is that is scaled.

    Args:
        truth: the true trajectory.
        history: estimated states, or those of the smoothed trajectory.
        aligned: whether the estimate lives in the world of the truth already.
        smoothed: the smoothed trajectory of the run, if there is one.
        breaks_ns: increasing times at which the estimate goes on in another world. Each world is
            aligned by the pose to which its covariances are relative: causal ones by the first,
            smoothed ones by that whose position is known best. Causal covariances of a world whose
            place is not known are relative to none of its poses: its states are left out, and
            counted.

    Raises:
        DataError: if truth and estimate share no time.
    """
    estimate, covariances = history.trajectory(), history.pose_covariances()
    aligned_in_all = aligned and not len(breaks_ns)
    within = smoothed.within if smoothed is not None and history is smoothed.history else None
    if within is not None and not aligned_in_all:
        covariances = within
    if history.scaled_camera is not None:
        covariances = mounted_covariances(covariances, history.scaled_camera)
        truth, estimate = (path.mounted(history.scaled_camera) for path in (truth, estimate))
    if aligned_in_all:
        return nees(estimate, covariances, truth), "none"
    if smoothed is not None and not len(breaks_ns):
        synchronize(truth, estimate)
        with suppress(DataError):  # what never moves determines no yaw
            found = aligned_by_smoothed(truth, history, smoothed)
            if found is not None:
                return nees(estimate, found[1], truth, found[0]), "yaw"
    parts, failures, left_out = [], [], 0
    world = np.searchsorted(breaks_ns, estimate.stamps_ns, "right")
    for number in range(len(breaks_ns) + 1):
        rows = np.flatnonzero(world == number)
        part, known = estimate.select(rows), covariances[rows]
        if number and len(rows) and not _is_placed(known[0]):
            left_out += len(rows)
            continue
        try:
            given, first = aligned and number == 0, 0
            if within is not None and len(rows):
                spreads = np.trace(known[:, 3:, 3:], axis1=1, axis2=2)
                first = int(np.argmin(np.nan_to_num(spreads, nan=np.inf)))
            own = part[first:], known[first:]
            onto = None if given else _by_first_pose(truth, *own, history)
            parts.append(nees(part, known, truth, onto))
        except DataError as error:
            failures.append(error)
    if not parts:
        raise failures[0]
    how: _NeesAlignment = "first_pose" if history.has_scale else "first_pose_and_scale"
    return Nees.joined(parts, left_out), how


def _is_placed(covariance: FloatArray) -> bool:
    """Whether a covariance (6, 6) of the first pose of a world says that its place is known.

    If not those of later ones say the same, and nothing of what has been estimated since.
    """
    return bool(PiecewiseAlignment.placed(np.diag(covariance)[None, 3:])[0])


def _by_first_pose(
    truth: Trajectory, estimate: Trajectory, covariances: FloatArray, history: StateHistory
) -> Similarity:
    """The alignment of N states, with covariances (N, 6, 6), to whose first these are relative.

    Raises:
        DataError: if truth and estimate share no time.
    """
    true, own = synchronize(truth, estimate)
    if history.has_scale:
        return Similarity.of_first_pose(true, own, history.level)
    scale = scale_of_covariances(truth, estimate, covariances)
    if scale is None:
        scale = Similarity.of_positions(true.positions, own.positions, "sim3").scale
    scaled = Similarity(np.eye(3), np.zeros(3), scale)
    first = Similarity.of_first_pose(true, scaled.apply(own), level=False)
    return replace(first, scale=scale)


def _errors_under(
    reference: Trajectory, estimate: Trajectory, mode: AlignmentMode, breaks_ns: Sequence[int]
) -> Table:
    """The errors under one alignment, against the truth interpolated at the estimate's times."""
    options: Table = {"alignment": mode, "breaks_ns": breaks_ns}
    steps: Table = {**options, "delta": _RPE_DELTA_M, "unit": "m", "all_pairs": True}
    translation = ape(reference, estimate, "trans_part", **options)
    return {
        "poses": translation.poses,
        "scale": translation.alignment.scale,
        "ate": {
            "translation_m": _statistics(translation),
            "rotation_deg": _statistics(ape(reference, estimate, "angle_deg", **options)),
        },
        "rpe": _or_reason(
            lambda: {
                "delta_m": _RPE_DELTA_M,
                "translation_m": _statistics(rpe(reference, estimate, "trans_part", **steps)),
                "rotation_deg": _statistics(rpe(reference, estimate, "angle_deg", **steps)),
            }
        ),
    }


def _or_reason(compute: Callable[[], Table]) -> Table:
    """The table, or why there is none."""
    try:
        return compute()
    except DataError as error:
        return {"unavailable": str(error)}


def _statistics(series: ErrorSeries) -> Table:
    """Statistics as a table."""
    return asdict(series.statistics)
