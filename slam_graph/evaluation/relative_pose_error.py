# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Relative pose error: how far the estimated motion over a step is from the true one (drift).

Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems"; with `pairing="nearest"`
the numbers are evo's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.evaluation.absolute_pose_error import (
    ErrorSeries,
    Statistics,
    aligned_pair,
    errors,
    relative_poses,
)
from slam_graph.evaluation.choices import (
    ERROR_UNITS,
    STEP_UNITS,
    DeltaUnit,
    Pairing,
    PoseRelation,
    require_known,
)
from slam_graph.geometry import AlignmentMode, Trajectory

DEFAULT_TOLERANCE = 0.1


def rpe(
    reference: Trajectory,
    estimate: Trajectory,
    relation: PoseRelation = "trans_part",
    alignment: AlignmentMode = "none",
    delta: float = 1.0,
    unit: DeltaUnit = "f",
    all_pairs: bool = False,
    tolerance: float = DEFAULT_TOLERANCE,
    pairs_from_reference: bool = False,
    pairing: Pairing = "interpolate",
    limit_s: float | None = None,
    breaks_ns: Sequence[int] | IntArray = (),
) -> ErrorSeries:
    """Relative pose error of an estimate.

    Args:
        reference: the true trajectory.
        estimate: the trajectory to judge.
        relation: which part of the difference of two motions counts.
        alignment: fitted over all poses that both share; only a scale changes this error.
        delta: length of a step, in `unit`.
        unit: frames, metres of path, degrees or radians of rotation.
        all_pairs: every pair of poses that is `delta` apart, instead of consecutive steps.
        tolerance: with `all_pairs`, how far from `delta` a pair may be, as a fraction of it.
        pairs_from_reference: measure the steps along the reference instead of the estimate.
        pairing: whether the truth is interpolated at the times of the estimate, or the pose
            nearest in time is taken.
        limit_s: the longest gap or difference in time that is bridged; None: as `synchronize` says.
        breaks_ns: as for `ape`; no step is from one world to another.

    Raises:
        ConfigError: if there is no such relation, alignment, unit or pairing.
        DataError: if the trajectories share no time, cannot be aligned, or have no such step, or
            the length of a step is not finite, or no whole number of frames.
    """
    require_known(relation, ERROR_UNITS, "relation")
    require_known(unit, STEP_UNITS, "unit of a step")
    _require_length(delta, unit)
    truth, aligned, worlds = aligned_pair(
        reference, estimate, alignment, pairing, limit_s, breaks_ns
    )
    start, end = _step_pairs(
        truth if pairs_from_reference else aligned, delta, unit, all_pairs, tolerance
    )
    world = worlds.world_of(aligned.stamps_ns)
    inside = world[start] == world[end]
    start, end = start[inside], end[inside]
    if len(start) == 0:
        raise DataError(
            f"no step of {delta:g} {STEP_UNITS[unit]} in {len(truth)} shared poses; "
            "choose a smaller --delta"
        )
    difference = relative_poses(*_motions(truth, start, end), *_motions(aligned, start, end))
    values = errors(*difference, relation)
    return ErrorSeries(
        aligned.stamps_ns[end],
        values,
        Statistics.of(values),
        worlds,
        len(truth),
        ERROR_UNITS[relation],
        STEP_UNITS[unit],
    )


def _require_length(delta: float, unit: DeltaUnit) -> None:
    """Refuse a length of steps that has no meaning.

    Raises:
        DataError: saying why.
    """
    if not np.isfinite(delta):
        raise DataError(f"a step of {delta:g} {STEP_UNITS[unit]}; choose a finite --delta")
    if unit != "f":
        return
    if delta != round(delta):
        raise DataError(
            f"a step is a whole number of frames, not {delta:g}; choose another --delta"
        )
    if delta < 1:
        raise DataError(f"a step of {delta:g} frames is too short; choose --delta of at least 1")


def _step_pairs(
    trajectory: Trajectory, delta: float, unit: DeltaUnit, all_pairs: bool, tolerance: float
) -> tuple[IntArray, IntArray]:
    """Indices (M,) of the first and the last pose of each step of length `delta`."""
    if unit == "f":
        return _frame_pairs(len(trajectory), delta, all_pairs)
    radians = np.radians(delta) if unit == "d" else delta
    if unit == "m":
        advance = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
        if all_pairs:
            return _pairs_at_distance(np.concatenate([[0.0], np.cumsum(advance)]), delta, tolerance)
        return _consecutive(advance, delta)
    rotations = Rotation.from_quat(trajectory.quaternions)
    if all_pairs:
        return _pairs_at_angle(rotations, radians, tolerance)
    return _consecutive((rotations[:-1].inv() * rotations[1:]).magnitude(), radians)


def _motions(trajectory: Trajectory, start: IntArray, end: IntArray) -> tuple[Rotation, FloatArray]:
    """The relative poses from `start` to `end`."""
    rotations = Rotation.from_quat(trajectory.quaternions)
    positions = trajectory.positions
    return relative_poses(rotations[start], positions[start], rotations[end], positions[end])


def _frame_pairs(count: int, delta: float, all_pairs: bool) -> tuple[IntArray, IntArray]:
    """Pairs of poses `delta` rows apart, a whole number."""
    step = round(min(delta, count))
    start = np.arange(0, count - step, 1 if all_pairs else step, dtype=np.int64)
    return start, start + step


def _consecutive(advance: FloatArray, delta: float) -> tuple[IntArray, IntArray]:
    """Steps that follow one another, each ending where it has reached `delta`.

    Args:
        advance: (N - 1,) length from each pose to the next.
        delta: length of a step.
    """
    ends = [0]
    length = 0.0
    for index, increment in enumerate(advance.tolist(), start=1):
        length += increment
        if length >= delta:
            ends.append(index)
            length = 0.0
    marks = np.array(ends, dtype=np.int64)
    return marks[:-1], marks[1:]


def _pairs_at_distance(
    path: FloatArray, delta: float, tolerance: float
) -> tuple[IntArray, IntArray]:
    """For every pose the later one whose distance along the path is nearest to `delta`."""
    start = np.arange(len(path) - 1, dtype=np.int64)
    goal = path[:-1] + delta
    right = np.clip(np.searchsorted(path, goal), start + 1, len(path) - 1)
    left = np.maximum(right - 1, start + 1)
    end = np.where(np.abs(path[left] - goal) <= np.abs(path[right] - goal), left, right)
    # poses at the same distance (standing still): the first of them
    end = np.maximum(np.searchsorted(path, path[end]), start + 1)
    kept = np.abs(path[end] - path[start] - delta) <= tolerance * delta
    return start[kept], end[kept].astype(np.int64)


def _pairs_at_angle(
    rotations: Rotation, delta: float, tolerance: float
) -> tuple[IntArray, IntArray]:
    """All pairs whose relative rotation has an angle within the tolerance of `delta` (radians)."""
    starts, ends = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for first in range(len(rotations) - 1):
        angles = (rotations[first].inv() * rotations[first + 1 :]).magnitude()
        last = first + 1 + np.flatnonzero(np.abs(angles - delta) <= tolerance * delta)
        starts.append(np.full(len(last), first, dtype=np.int64))
        ends.append(last.astype(np.int64))
    return np.concatenate(starts), np.concatenate(ends)
