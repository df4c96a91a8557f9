# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Least squares over the states of a recorded flight: ground truth and preintegrated IMU."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.spatial.transform import Rotation, Slerp

from slam_graph.arrays import FloatArray
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory
from slam_graph.sensors import ImuData, ImuNoise
from slam_graph.simulation.motion import GRAVITY

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

_ITERATIONS = 15

_OFFSET_CONVERGED_RAD = np.deg2rad(0.02)
"""The constant rotation between truth and IMU, and the states, are estimated in turn."""


class PathStates:
    """Poses, velocities and biases of the batch, K of each.

    Attributes:
        values: the same as GTSAM has them.
        positions: (K, 3) of the body in the world, m.
        rotations: K of the body, world_R_body.
        velocities: (K, 3) in the world, m/s.
        biases: (K, 6) of accelerometer (m/s²) and gyroscope (rad/s).
    """

    def __init__(self, values: gtsam.Values, count: int) -> None:
        poses = [values.atPose3(X(k)) for k in range(count)]
        self.values = values
        self.positions = np.array([pose.translation() for pose in poses])
        self.rotations = Rotation.from_matrix([pose.rotation().matrix() for pose in poses])
        self.velocities = np.array([values.atVector(V(k)) for k in range(count)])
        self.biases = np.array([values.atConstantBias(B(k)).vector() for k in range(count)])


class PathBatch:
    """The least-squares problem over all states of a flight."""

    def __init__(self, truth: Trajectory, imu: ImuData, noisy: ImuData, noise: ImuNoise) -> None:
        """Integrate the samples between states.

        Args:
            truth: poses that cover all samples.
            imu: N samples as they were recorded.
            noisy: the same samples as they are integrated.
            noise: calibrated densities.
        """
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

    def measure(self, truth: Trajectory) -> None:
        """Take the poses of another ground truth; states begin where they are."""
        self.truth = truth
        self._measured = self._used_rows()

    def solve_with_offset(self, offset: Rotation, rounds: int) -> tuple[PathStates, Rotation]:
        """States and the rotation path_R_truth of the body, in turn.

        Args:
            offset: a guess of the rotation.
            rounds: how often both are estimated at most.

        Raises:
            DataError: if no path fits.
        """
        for _ in range(rounds):
            states = self._solve(offset)
            before, offset = offset, self._rotation_offset(states)
            if (before.inv() * offset).magnitude() < _OFFSET_CONVERGED_RAD:
                break
        return states, offset

    def cost(self, states: PathStates) -> tuple[float, float]:
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

    def _solve(self, offset: Rotation) -> PathStates:
        """The optimum; `offset` is path_R_truth of the body."""
        graph = gtsam.NonlinearFactorGraph(self._imu_factors)
        graph.add(
            gtsam.PriorFactorConstantBias(
                B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(_BIAS_SIGMAS)
            )
        )
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY_WIDTH)
        of_position = gtsam.noiseModel.Robust.Create(
            cauchy, gtsam.noiseModel.Isotropic.Sigma(3, _POSITION_SIGMA_M)
        )
        of_rotation = gtsam.noiseModel.Isotropic.Sigma(3, _ROTATION_SIGMA_RAD)
        rows, states = (np.array(column) for column in zip(*self._measured, strict=True))
        turned = (Rotation.from_quat(self.truth.quaternions[rows]) * offset.inv()).as_matrix()
        delays = self._state_times()[states] - self._truth_times()[rows]
        velocities = np.array([self._start.atVector(V(state)) for state in states])
        there = self.truth.positions[rows] + velocities * delays[:, None]
        for state, position, R in zip(states.tolist(), there, turned, strict=True):
            graph.add(gtsam.PoseTranslationPrior3D(X(state), position, of_position))
            graph.add(gtsam.PoseRotationPrior3D(X(state), gtsam.Rot3(R), of_rotation))
        parameters = gtsam.GaussNewtonParams()
        parameters.setMaxIterations(_ITERATIONS)
        parameters.setRelativeErrorTol(1e-4)
        parameters.setOrderingType("COLAMD")
        try:
            values = gtsam.GaussNewtonOptimizer(graph, self._start, parameters).optimize()
        except RuntimeError as error:  # it went so far off that the linear system is singular
            raise DataError(
                "no path fits ground truth and IMU; check their stamps and units, or choose "
                "another part of the flight (start_s, duration_s)"
            ) from error
        self._start = values
        return PathStates(values, len(self._rows))

    def _rotation_offset(self, states: PathStates) -> Rotation:
        """Mean rotation path_R_truth of the body."""
        rows, indices = (np.array(column) for column in zip(*self._measured, strict=True))
        truth = Rotation.from_quat(self.truth.quaternions[rows])
        return (states.rotations[indices].inv() * truth).mean()

    def path(self, states: PathStates) -> Trajectory:
        """The path at all N samples: integrated from each state, and bent to end in the next."""
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
