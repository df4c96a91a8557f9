# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The path of a recorded flight that agrees with its IMU: ground truth and IMU in one batch.

A ground truth is not the path that an IMU measured: that of a laser tracker drifts while the
tracker has lost its prism and then jumps back, that of motion capture has gaps, and both differ
from the IMU in orientation and in their clock. A camera that is simulated along it would be
teleported. So the path is the least-squares solution of preintegrated IMU factors (Forster et al.
2017) and the positions and orientations of the ground truth, in which a Cauchy loss on the
positions rejects stretches that no motion explains (Barfoot 2017, section 5.3). How late its
positions are is estimated first, as the time offset under which this problem has its least cost.

The solution itself would follow every sample of the IMU, noise included, and an estimator would
find the IMU better than it is. So white noise of the densities of the calibration is drawn and
added to the samples first: the path is then a draw from the posterior instead of its mode, and the
difference between recorded samples and path is white and of the size that the calibration claims
(Papandreou and Yuille 2010, "Gaussian sampling by local perturbations").
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.sensors import ImuData, ImuNoise
from slam_graph.simulation.path_batch import PathBatch
from slam_graph.simulation.path_report import PathReport, report_on

_LONGEST_GAP_S = 2.5
"""Longest gap of the ground truth that the IMU bridges."""

_LATE_SIGMA_S, _LATEST_S = 0.02, 0.1
"""Standard deviation of the time offset of a ground truth before it is estimated, and its bound."""

_SHORTEST_S = 10.0
"""A shorter overlap of truth and IMU does not show the time offset: in 6 s a simulated one of 30 ms
is found as 18 to 27 ms, in 4 s as 0 to 24 ms."""

_LATE_COST, _LATE_SLOPE = 1e-4, 0.5
"""The time offset is found when a step changes the cost by less than this part of it, or when the
slope of the cost is below this per millisecond: a tenth to a fifth of σ."""

_LATE_NOTED_S = 5e-3
"""Smaller time offsets are not told from other errors of the truth. These move what is found by up
to 4 ms in halves of one flight (V1_02, V2_01), and by more in shorter parts."""

_OFFSET_ROUNDS = 10
"""How often constant rotation between truth and IMU and the states are estimated in turn."""

_NOISE_STREAM = 20260101
"""Seed of the noise: a recorded flight has one path, whatever the seed of the simulation."""


def truth_delay_s(truth: Trajectory, imu: ImuData, noise: ImuNoise) -> float:
    """How late the stamps of the positions of a ground truth are by the clock of the IMU.

    The cost of the best path is a function of this delay. Its slope is nearly that of the cost of
    the positions on a path that stays, as the path is a minimum but for the weak orientations.

    Args:
        truth: recorded poses of the body (the IMU), at some tens per second or more.
        imu: recorded samples; the time that both cover counts.
        noise: calibrated densities of the IMU.

    Returns:
        Seconds, positive if the stamps are late and negative if they are early. 0 if the delay is
        below 5 ms, or if truth and IMU overlap for less than 10 s, which is too short to tell.

    Raises:
        DataError: if they overlap for less than a second, a gap of the truth is longer than 2.5 s,
            no path fits truth and IMU, the delay is 0.1 s or more either way, or the search for
            it does not converge.
    """
    first, last = overlap(truth, imu)
    if (imu.stamps_ns[last - 1] - imu.stamps_ns[first]) * 1e-9 < _SHORTEST_S:
        return 0.0
    # the samples that the truth covers under every delay, so that they are integrated once
    margin_ns = round(_LATEST_S * 1e9)
    first, last = np.searchsorted(
        imu.stamps_ns,
        [imu.stamps_ns[first] + margin_ns, imu.stamps_ns[last - 1] - margin_ns],
    ).tolist()
    block, offset = imu[first:last], Rotation.identity()
    batch = PathBatch(truth, block, block, noise)

    def cost(late_ms: FloatArray) -> tuple[float, FloatArray]:
        nonlocal offset
        late_s = 1e-3 * float(late_ms[0])
        batch.measure(at_imu_times(truth, late_s))
        states, offset = batch.solve_with_offset(offset, 2)
        value, slope = batch.cost(states)
        value += 0.5 * (late_s / _LATE_SIGMA_S) ** 2
        return value, np.array([1e-3 * (slope + late_s / _LATE_SIGMA_S**2)])

    bound = 1e3 * _LATEST_S
    found = minimize(
        cost,
        np.zeros(1),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-bound, bound)],
        options={"ftol": _LATE_COST, "gtol": _LATE_SLOPE},
    )
    late_s = 1e-3 * float(found.x[0])
    if abs(late_s) >= 0.99 * _LATEST_S:
        raise DataError(
            f"the ground truth is {_LATEST_S} s or more off the IMU's clock; correct its stamps"
        )
    if not found.success:  # no convergence: what it returns may be anywhere between the bounds
        raise DataError(
            "how late the ground truth is by the IMU's clock cannot be found: the search ended at "
            f"{1e3 * late_s:.1f} ms without convergence ({found.message}); choose another part of "
            "the flight (start_s, duration_s)"
        )
    return late_s if abs(late_s) >= _LATE_NOTED_S else 0.0


def at_imu_times(truth: Trajectory, late_s: float) -> Trajectory:
    """A ground truth whose positions are late, with stamps by the clock of the IMU.

    Positions keep their values and get earlier stamps. Orientations are taken to be in time, so
    they are interpolated at the new stamps.

    Args:
        truth: (N) recorded poses.
        late_s: how late the stamps of its positions are, as `truth_delay_s` returns it.

    Returns:
        The poses at the new stamps, without velocities and biases. Those at which no orientation
        is known (before the first recorded one, after the last, in gaps of more than 5 s) are left
        out. If `late_s` is 0 it is `truth` itself, with all that it has.
    """
    if late_s == 0.0:
        return truth
    stamps_ns = truth.stamps_ns - round(late_s * 1e9)
    turned, valid = interpolate(truth, stamps_ns, max_gap_s=2.0 * _LONGEST_GAP_S)
    return Trajectory(stamps_ns[valid], truth.positions[valid], turned.quaternions)


def consistent_path(
    truth: Trajectory, imu: ImuData, noise: ImuNoise, late_s: float | None = None
) -> tuple[Trajectory, PathReport]:
    """The path of a flight that agrees with its IMU and is near its ground truth.

    Args:
        truth: recorded poses of the body (the IMU), at some tens per second or more.
        imu: recorded samples; the path covers the time that both cover.
        noise: calibrated densities of the IMU.
        late_s: how late the stamps of the positions of the truth are, if it is known; estimated
            by `truth_delay_s` otherwise. Of a part of a recording it is less certain.

    Returns:
        The path at the times of the samples, with velocities and biases, and how it differs from
        both.

    Raises:
        DataError: if they overlap for less than a second, a gap of the truth is longer than 2.5 s,
            its positions are 0.1 s or more late or early, how late they are cannot be found, or no
            path fits both.
    """
    if late_s is None:
        late_s = truth_delay_s(truth, imu, noise)
    truth = at_imu_times(truth, late_s)
    first, last = overlap(truth, imu)
    batch = PathBatch(truth, imu[first:last], _with_noise(imu, noise)[first:last], noise)
    states, offset = batch.solve_with_offset(Rotation.identity(), _OFFSET_ROUNDS)
    path = batch.path(states)
    return path, report_on(truth, path, batch.imu, noise, offset, late_s)


def overlap(truth: Trajectory, imu: ImuData) -> tuple[int, int]:
    """The first sample during the truth, and the one after the last.

    Raises:
        DataError: if they overlap for less than a second, or a gap of the truth is longer than
            2.5 s.
    """
    first = int(np.searchsorted(imu.stamps_ns, truth.stamps_ns[0]))
    last = int(np.searchsorted(imu.stamps_ns, truth.stamps_ns[-1], side="right"))
    if last - first < 2 or imu.stamps_ns[last - 1] - imu.stamps_ns[first] < 1_000_000_000:
        raise DataError("ground truth and IMU overlap for less than a second")
    gaps_s = np.diff(truth.stamps_ns) * 1e-9
    longest = int(np.argmax(gaps_s))
    if gaps_s[longest] > _LONGEST_GAP_S:
        raise DataError(
            f"the ground truth has a gap of {gaps_s[longest]:.2f} s at "
            f"{truth.stamps_ns[longest]}, and the IMU bridges {_LONGEST_GAP_S} s; choose another "
            "part of it (start_s, duration_s)"
        )
    return first, last


def _with_noise(imu: ImuData, noise: ImuNoise) -> ImuData:
    """The samples with white noise of the calibrated densities added."""
    rng = np.random.default_rng(_NOISE_STREAM)
    root_rate = 1.0 / float(np.sqrt(np.median(np.diff(imu.stamps_ns)) * 1e-9))
    gyro = rng.normal(size=imu.gyro.shape) * noise.gyro_noise_density * root_rate
    accel = rng.normal(size=imu.accel.shape) * noise.accel_noise_density * root_rate
    return ImuData(imu.stamps_ns, imu.gyro + gyro, imu.accel + accel)
