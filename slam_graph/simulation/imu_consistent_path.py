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

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation, Slerp

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.sensors import (
    ImuData,
    ImuNoise,
)
from slam_graph.simulation.motion import GRAVITY
from slam_graph.simulation.path_report import PathReport, report_on

_GRAVITY = -float(GRAVITY[2])

_STATE_SPACING_S = 0.025
"""Time between the states of the batch; between two of them the path is integrated."""

_MEASUREMENT_SPACING_S = 0.05
"""Time between the poses of the ground truth that are used. Errors of neighbours are alike."""

_POSITION_SIGMA_M = 3e-3
_CAUCHY_WIDTH = 3.0
"""Standard deviation of a true position, and residual (σ) from which the Cauchy loss flattens."""

_ROTATION_SIGMA_RAD = np.deg2rad(3.0)
"""Standard deviation of a true orientation. The errors last for seconds, over which forty
orientations count as one: together they weigh as much as one with 0.5°."""

_BIAS_SIGMAS = np.array([0.3] * 3 + [0.1] * 3)
"""Standard deviation of the first biases: accelerometer (m/s²), gyroscope (rad/s)."""

_LONGEST_GAP_S = 2.5
"""Longest gap of the ground truth that the IMU bridges."""

_ITERATIONS = 15

_LATE_SIGMA_S, _LATEST_S = 0.02, 0.1
"""Standard deviation of the time offset of a ground truth before it is estimated, and its bound."""

_SHORTEST_S = 2.0
"""A shorter path does not show it."""

_LATE_COST, _LATE_SLOPE = 1e-4, 0.5
"""The time offset is found when the cost changes by less than this part of it, or by less than
this per millisecond: a tenth to a fifth of σ."""

_LATE_NOTED_S = 5e-3
"""Smaller time offsets are not told from other errors of the truth, which move what is found in
parts of one flight by up to 3.5 ms (V2_01, V2_02). They are left as they are."""

_OFFSET_ROUNDS = 10
_OFFSET_CONVERGED_RAD = np.deg2rad(0.02)
"""The constant rotation between truth and IMU, and the states, are estimated in turn."""

_NOISE_STREAM = 20260101
"""Seed of the noise: a recorded flight has one path, whatever the seed of the simulation."""


def truth_delay_s(truth: Trajectory, imu: ImuData, noise: ImuNoise) -> float:
    """How much later the positions of a ground truth are than the IMU says; 0 below 5 ms.

    The cost of the best path is a function of this delay. Its slope is nearly that of the cost of
    the positions on a path that stays, as the path is a minimum but for the weak orientations.

    Args:
        truth: recorded poses of the body (the IMU), at some tens per second or more.
        imu: recorded samples; the time that both cover counts.
        noise: calibrated densities of the IMU.

    Raises:
        DataError: as `consistent_path` does; or if it is 0.1 s or more.
    """
    first, last = _overlap(truth, imu)
    if (imu.stamps_ns[last - 1] - imu.stamps_ns[first]) * 1e-9 < _SHORTEST_S:
        return 0.0
    offset = Rotation.identity()

    def cost(late_ms: FloatArray) -> tuple[float, FloatArray]:
        nonlocal offset
        late_s = 1e-3 * float(late_ms[0])
        moved = at_imu_times(truth, late_s)
        first, last = _overlap(moved, imu)
        batch = _Batch(moved, imu[first:last], imu[first:last], noise)
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
    return late_s if abs(late_s) >= _LATE_NOTED_S else 0.0


def at_imu_times(truth: Trajectory, late_s: float) -> Trajectory:
    """A ground truth whose positions are late, with them at the right times.

    Its orientations are not late: against the matches of MH_01's images they fit best as they are,
    while positions do some 7 ms earlier. So they are interpolated at the times of the positions.

    Args:
        truth: recorded poses.
        late_s: how much later the times of its positions are than those of the IMU.

    Returns:
        The poses at the times of their positions, without velocities.
    """
    if late_s == 0.0:
        return truth
    stamps_ns = truth.stamps_ns - round(late_s * 1e9)
    turned, valid = interpolate(truth, stamps_ns, max_gap_s=2.0 * _LONGEST_GAP_S)
    return Trajectory(stamps_ns[valid], truth.positions[valid], turned.quaternions)


def consistent_path(
    truth: Trajectory, imu: ImuData, noise: ImuNoise
) -> tuple[Trajectory, PathReport]:
    """The path of a flight that agrees with its IMU and is near its ground truth.

    Args:
        truth: recorded poses of the body (the IMU), at some tens per second or more.
        imu: recorded samples; the path covers the time that both cover.
        noise: calibrated densities of the IMU.

    Returns:
        The path at the times of the samples, with velocities and biases, and how it differs from
        both.

    Raises:
        DataError: if they overlap for less than a second, or a gap of the truth is too long.
    """
    late_s = truth_delay_s(truth, imu, noise)
    truth = at_imu_times(truth, late_s)
    first, last = _overlap(truth, imu)
    batch = _Batch(truth, imu[first:last], _with_noise(imu, noise)[first:last], noise)
    states, offset = batch.solve_with_offset(Rotation.identity(), _OFFSET_ROUNDS)
    path = batch.path(states)
    return path, report_on(truth, path, batch.imu, noise, offset, late_s)


def _overlap(truth: Trajectory, imu: ImuData) -> tuple[int, int]:
    """The first sample during the truth, and the one after the last."""
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


class _States:
    """Poses, velocities and biases of the batch, K of each."""

    def __init__(self, values: gtsam.Values, count: int) -> None:
        poses = [values.atPose3(X(k)) for k in range(count)]
        self.values = values
        self.positions = np.array([pose.translation() for pose in poses])
        self.rotations = Rotation.from_matrix([pose.rotation().matrix() for pose in poses])
        self.velocities = np.array([values.atVector(V(k)) for k in range(count)])
        self.biases = np.array([values.atConstantBias(B(k)).vector() for k in range(count)])


class _Batch:
    """The least-squares problem over all states of a flight."""

    def __init__(self, truth: Trajectory, imu: ImuData, noisy: ImuData, noise: ImuNoise) -> None:
        self.truth = truth
        self.imu = imu
        self._noisy = noisy
        self._params = noise.preintegration_params(_GRAVITY)
        self._seconds = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9
        every = max(1, round(_STATE_SPACING_S / float(np.median(np.diff(self._seconds)))))
        last = len(imu) - 1
        self._rows = np.unique(np.append(np.arange(0, last, every), last))  # samples with a state
        self._start = self._initial()
        self._imu_factors = self._between_states()
        self._measured = self._used_rows()

    def solve_with_offset(self, offset: Rotation, rounds: int) -> tuple[_States, Rotation]:
        """States and the rotation path_R_truth of the body, in turn, from a guess of the latter."""
        for _ in range(rounds):
            states = self._solve(offset)
            before, offset = offset, self._rotation_offset(states)
            if (before.inv() * offset).magnitude() < _OFFSET_CONVERGED_RAD:
                break
        return states, offset

    def cost(self, states: _States) -> tuple[float, float]:
        """Cost of IMU and positions, and its slope over how late the ground truth is, 1/s."""
        rows, indices = (np.array(column) for column in zip(*self._measured, strict=True))
        delays = self._state_times()[indices] - self._truth_times()[rows]
        velocities = np.array([states.values.atVector(V(k)) for k in indices])
        there = self.truth.positions[rows] + velocities * delays[:, None]
        residuals = (states.positions[indices] - there) / _POSITION_SIGMA_M
        squares = np.einsum("ni,ni->n", residuals, residuals) / _CAUCHY_WIDTH**2
        weighted = residuals / (_POSITION_SIGMA_M * (1.0 + squares[:, None]))
        cost = self._imu_factors.error(states.values)
        cost += 0.5 * _CAUCHY_WIDTH**2 * float(np.sum(np.log1p(squares)))
        return cost, -float(np.sum(weighted * velocities))

    def _solve(self, offset: Rotation) -> _States:
        """The optimum; `offset` is path_R_truth of the body."""
        graph = gtsam.NonlinearFactorGraph(self._imu_factors)
        graph.add(
            gtsam.PriorFactorConstantBias(
                B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(_BIAS_SIGMAS)
            )
        )
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY_WIDTH)
        position = gtsam.noiseModel.Robust.Create(
            cauchy, gtsam.noiseModel.Isotropic.Sigma(3, _POSITION_SIGMA_M)
        )
        rotation = gtsam.noiseModel.Isotropic.Sigma(3, _ROTATION_SIGMA_RAD)
        turned = (Rotation.from_quat(self.truth.quaternions) * offset.inv()).as_matrix()
        for row, state in self._measured:
            delay_s = self._state_times()[state] - self._truth_times()[row]
            velocity = self._start.atVector(V(state))
            there = self.truth.positions[row] + velocity * delay_s
            graph.add(gtsam.PoseTranslationPrior3D(X(state), there, position))
            graph.add(gtsam.PoseRotationPrior3D(X(state), gtsam.Rot3(turned[row]), rotation))
        parameters = gtsam.GaussNewtonParams()
        parameters.setMaxIterations(_ITERATIONS)
        parameters.setRelativeErrorTol(1e-4)
        parameters.setOrderingType("COLAMD")
        values = gtsam.GaussNewtonOptimizer(graph, self._start, parameters).optimize()
        self._start = values
        return _States(values, len(self._rows))

    def _rotation_offset(self, states: _States) -> Rotation:
        """Mean rotation path_R_truth of the body."""
        rows, indices = (np.array(column) for column in zip(*self._measured, strict=True))
        truth = Rotation.from_quat(self.truth.quaternions[rows])
        return (states.rotations[indices].inv() * truth).mean()

    def path(self, states: _States) -> Trajectory:
        """The path at all samples: integrated from each state, and led into the next one."""
        stamps, count = self.imu.stamps_ns, len(self.imu)
        positions, velocities = np.empty((count, 3)), np.empty((count, 3))
        quaternions, biases = np.empty((count, 4)), np.empty((count, 6))
        begin, end = self._rows[:-1], self._rows[1:]
        p, v, R = states.positions[:-1], states.velocities[:-1], states.rotations[:-1]
        bias = states.biases[:-1]
        gravity = np.array([0.0, 0.0, -_GRAVITY])
        steps = [(begin, p, v, R)]
        for step in range(int(np.max(end - begin))):
            row = np.minimum(begin + step, end - 1)
            live = (begin + step < end)[:, None]
            dt = np.where(live[:, 0], self._seconds[row + 1] - self._seconds[row], 0.0)[:, None]
            rate = 0.5 * (self._noisy.gyro[row] + self._noisy.gyro[row + 1]) - bias[:, 3:]
            force = 0.5 * (self._noisy.accel[row] + self._noisy.accel[row + 1]) - bias[:, :3]
            half = R * Rotation.from_rotvec(0.5 * rate * dt)
            acceleration = half.apply(force) + gravity
            p = p + v * dt + 0.5 * acceleration * dt**2
            v = v + acceleration * dt
            R = R * Rotation.from_rotvec(rate * dt)
            steps.append((np.where(live[:, 0], begin + step + 1, end), p, v, R))
        # what is left at the end of an interval (far below the noise) is spread evenly over it
        missing_p, missing_v = states.positions[1:] - p, states.velocities[1:] - v
        missing_r = (R.inv() * states.rotations[1:]).as_rotvec()
        for rows, p, v, R in steps:
            share = ((self._seconds[rows] - self._seconds[begin]) / self._durations())[:, None]
            positions[rows], velocities[rows] = p + share * missing_p, v + share * missing_v
            quaternions[rows] = (R * Rotation.from_rotvec(share * missing_r)).as_quat()
            biases[rows] = (1.0 - share) * bias + share * states.biases[1:]
        return Trajectory(
            stamps,
            positions,
            quaternions,
            velocities,
            accel_biases=biases[:, :3],
            gyro_biases=biases[:, 3:],
        )

    def _durations(self) -> FloatArray:
        return np.diff(self._state_times())

    def _state_times(self) -> FloatArray:
        times: FloatArray = self._seconds[self._rows]
        return times

    def _truth_times(self) -> FloatArray:
        times: FloatArray = (self.truth.stamps_ns - self.imu.stamps_ns[0]) * 1e-9
        return times

    def _initial(self) -> gtsam.Values:
        """States from the ground truth: interpolated poses, velocities of its central parts."""
        at = self._state_times()
        seconds = self._truth_times()
        columns = self.truth.positions.T
        positions = np.stack([np.interp(at, seconds, column) for column in columns], axis=1)
        ahead, behind = at + _STATE_SPACING_S, at - _STATE_SPACING_S
        velocities = np.stack(
            [
                (np.interp(ahead, seconds, column) - np.interp(behind, seconds, column))
                / (np.clip(ahead, *seconds[[0, -1]]) - np.clip(behind, *seconds[[0, -1]]))
                for column in columns
            ],
            axis=1,
        )
        rotations = Slerp(seconds, Rotation.from_quat(self.truth.quaternions))(at).as_matrix()
        values = gtsam.Values()
        for k in range(len(at)):
            values.insert(X(k), gtsam.Pose3(gtsam.Rot3(rotations[k]), positions[k]))
            values.insert(V(k), velocities[k])
            values.insert(B(k), gtsam.imuBias.ConstantBias())
        return values

    def _between_states(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        zero = gtsam.imuBias.ConstantBias()
        for k, (first, last) in enumerate(zip(self._rows[:-1], self._rows[1:], strict=True)):
            pim = self._noisy[int(first) : int(last) + 1].preintegrated(zero, self._params)
            keys = X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1)
            graph.add(gtsam.CombinedImuFactor(*keys, pim))
        return graph

    def _used_rows(self) -> list[tuple[int, int]]:
        """Poses of the ground truth that are measurements, each with the nearest state."""
        seconds, at = self._truth_times(), self._state_times()
        wanted = np.arange(at[0], at[-1], _MEASUREMENT_SPACING_S)
        rows = np.unique(np.searchsorted(seconds, wanted).clip(0, len(seconds) - 1))
        after = np.searchsorted(at, seconds[rows]).clip(1, len(at) - 1)
        nearest = after - (seconds[rows] - at[after - 1] < at[after] - seconds[rows])
        near = np.abs(at[nearest] - seconds[rows]) <= 0.5 * _STATE_SPACING_S
        return list(zip(rows[near].tolist(), nearest[near].tolist(), strict=True))


def _with_noise(imu: ImuData, noise: ImuNoise) -> ImuData:
    """The samples with white noise of the calibrated densities added."""
    rng = np.random.default_rng(_NOISE_STREAM)
    root_rate = 1.0 / float(np.sqrt(np.median(np.diff(imu.stamps_ns)) * 1e-9))
    gyro = rng.normal(size=imu.gyro.shape) * noise.gyro_noise_density * root_rate
    accel = rng.normal(size=imu.accel.shape) * noise.accel_noise_density * root_rate
    return ImuData(imu.stamps_ns, imu.gyro + gyro, imu.accel + accel)
