# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Splines of poses: through waypoints, and fitted to a recorded trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, CubicSpline, make_lsq_spline

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.simulation.motion import SplineMotion

_KNOT_SPACING_S = 0.1
"""Distance of the knots of a fitted spline: it follows motions of up to about 4 Hz and smooths
faster ones (noise of the recording)."""

_DEGREE = 5
_LONGEST_GAP_S = 0.5


def through_waypoints(times_s: FloatArray, poses: FloatArray) -> BPoly:
    """A spline through waypoints with continuous velocity and acceleration.

    Between equal neighbours it is constant; it arrives and leaves there with zero velocity and
    acceleration.

    Args:
        times_s: (N,) strictly increasing, N ≥ 2.
        poses: (N, 7) position and quaternion, neighbouring quaternions in the same
            hemisphere.

    Returns:
        A quintic Hermite spline: position, velocity and acceleration at its two ends determine
        each segment.
    """
    slopes, curvatures = np.zeros_like(poses), np.zeros_like(poses)
    held = np.all(poses[1:] == poses[:-1], axis=1)
    for first, last in _stretches(~held):
        ends = (
            "clamped" if first > 0 else "not-a-knot",
            "clamped" if last < len(poses) - 1 else "not-a-knot",
        )
        rows = slice(first, last + 1)
        moving = CubicSpline(times_s[rows], poses[rows], bc_type=ends)
        slopes[rows], curvatures[rows] = moving(times_s[rows], 1), moving(times_s[rows], 2)
        for end, clamped in ((first, first > 0), (last, last < len(poses) - 1)):
            if clamped:
                slopes[end] = curvatures[end] = 0.0
    return BPoly.from_derivatives(times_s, np.stack([poses, slopes, curvatures], axis=1))


def _stretches(moving: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last waypoint of each run of moving segments (N-1,)."""
    edges = np.flatnonzero(np.diff(moving.astype(int), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def fit(trajectory: Trajectory, spacing_s: float = _KNOT_SPACING_S) -> SplineMotion:
    """A smooth motion along a recorded trajectory, by least squares.

    Args:
        trajectory: with at least some tens of poses per second.
        spacing_s: distance of the knots.

    Raises:
        DataError: if there are too few poses, or gaps among them.
    """
    times_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    if len(times_s) < 2 * _DEGREE + 2:
        raise DataError(f"a trajectory of {len(times_s)} poses is too short to fly along")
    gap = int(np.argmax(np.diff(times_s)))
    if times_s[gap + 1] - times_s[gap] > _LONGEST_GAP_S:
        raise DataError(
            f"the recorded trajectory has a gap of {times_s[gap + 1] - times_s[gap]:.2f} s at "
            f"{trajectory.stamps_ns[gap]}; choose another part of it (start_s, duration_s)"
        )
    knots = _knots(times_s, spacing_s)
    poses = np.column_stack([trajectory.positions, continuous(trajectory.quaternions)])
    spline = make_lsq_spline(times_s, poses, knots, _DEGREE)
    return SplineMotion(int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1]), spline)


def _knots(times_s: FloatArray, spacing_s: float) -> FloatArray:
    """Knots with at least two poses between neighbours, so that the fit is determined."""
    wanted = np.arange(times_s[0] + spacing_s, times_s[-1] - 0.5 * spacing_s, spacing_s)
    index = np.unique(np.searchsorted(times_s, wanted))
    kept = [0]
    for candidate in index.tolist():
        if candidate - kept[-1] >= 2 and candidate < len(times_s) - 2:
            kept.append(candidate)
    ends = np.full(_DEGREE + 1, times_s[0]), np.full(_DEGREE + 1, times_s[-1])
    return np.concatenate([ends[0], times_s[kept[1:]], ends[1]])


def continuous(quaternions: FloatArray) -> FloatArray:
    """The same rotations (N, 4), with signs such that neighbours are in the same hemisphere."""
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.where(np.cumsum(np.concatenate([[False], turned])) % 2 == 1, -1.0, 1.0)
    smooth: FloatArray = quaternions * signs[:, None]
    return smooth


def stamps_between(start_ns: int, end_ns: int, rate_hz: float) -> IntArray:
    """Times from `start_ns` to at most `end_ns` at a rate; rounding errors do not add up."""
    count = int((end_ns - start_ns) * 1e-9 * rate_hz + 1e-6) + 1
    steps = np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return start_ns + steps
