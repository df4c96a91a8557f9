# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Which pose of an estimate belongs to which pose of a reference: the nearest in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.errors import DataError
from slam_graph.geometry.trajectory import Trajectory

DEFAULT_MAX_DIFFERENCE_S = 0.01


def nearest(stamps_ns: IntArray, queries_ns: IntArray) -> IntArray:
    """Index into increasing `stamps_ns` (N ≥ 1) of the stamp nearest to each query.

    Of two that are equally near the earlier one is taken.
    """
    after = np.clip(np.searchsorted(stamps_ns, queries_ns), 1, max(len(stamps_ns) - 1, 1))
    after = np.minimum(after, len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer_after = stamps_ns[after] - queries_ns < queries_ns - stamps_ns[before]
    return np.where(closer_after, after, before).astype(np.int64)


def associate(
    reference_ns: IntArray, estimate_ns: IntArray, max_difference_s: float
) -> tuple[IntArray, IntArray]:
    """Pairs of indices of poses that were taken at the same time.

    Every pose of the trajectory with fewer poses is paired with the nearest one of the other, if
    they are at most `max_difference_s` apart.

    Returns:
        (M,) indices into `reference_ns`, and (M,) into `estimate_ns`.
    """
    if len(reference_ns) == 0 or len(estimate_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    few_is_reference = len(estimate_ns) > len(reference_ns)
    few, many = (reference_ns, estimate_ns) if few_is_reference else (estimate_ns, reference_ns)
    partner = nearest(many, few)
    kept = np.flatnonzero(np.abs(many[partner] - few) <= round(max_difference_s * 1e9))
    pairs = (kept.astype(np.int64), partner[kept])
    return pairs if few_is_reference else (pairs[1], pairs[0])


def select(trajectory: Trajectory, indices: IntArray) -> Trajectory:
    """The rows of a trajectory at `indices`."""
    optional = {
        name: None if values is None else values[indices]
        for name in ("velocities", "accel_biases", "gyro_biases")
        for values in (getattr(trajectory, name),)
    }
    return replace(
        trajectory,
        stamps_ns=trajectory.stamps_ns[indices],
        positions=trajectory.positions[indices],
        quaternions=trajectory.quaternions[indices],
        **optional,
    )


def synchronize(
    reference: Trajectory,
    estimate: Trajectory,
    max_difference_s: float = DEFAULT_MAX_DIFFERENCE_S,
) -> tuple[Trajectory, Trajectory]:
    """Both trajectories at the times that they share, pose by pose.

    Raises:
        DataError: if they share none.
    """
    in_reference, in_estimate = associate(reference.stamps_ns, estimate.stamps_ns, max_difference_s)
    if len(in_reference) == 0:
        raise DataError(
            f"no pose of the estimate ({_span(estimate)}) is within {max_difference_s:g} s of one "
            f"of the reference ({_span(reference)}); check their clocks or raise --t_max_diff"
        )
    return select(reference, in_reference), select(estimate, in_estimate)


def _span(trajectory: Trajectory) -> str:
    """Number of poses and time range, for a message."""
    if len(trajectory) == 0:
        return "no poses"
    first, last = trajectory.stamps_ns[0] * 1e-9, trajectory.stamps_ns[-1] * 1e-9
    return f"{len(trajectory)} poses from {first:.3f} to {last:.3f} s"
