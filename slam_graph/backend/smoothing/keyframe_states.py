# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States between, before and after known states, by IMU prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.world_gauge import with_unknown_gauge
from slam_graph.geometry import NavState, StateHistory, Trajectory, interpolate
from slam_graph.kernels.imu_prediction import predict_motion
from slam_graph.sensors import ImuBuffer

_MAX_GAP_S = 1.0
"""States farther apart are not interpolated: the IMU predicts across the gap."""


def state_at(trajectory: Trajectory, row: int) -> NavState:
    """One row of a trajectory with velocities and biases."""
    assert trajectory.velocities is not None
    assert trajectory.gyro_biases is not None
    assert trajectory.accel_biases is not None
    return NavState(
        int(trajectory.stamps_ns[row]),
        trajectory.pose(row),
        trajectory.velocities[row],
        accel_bias=trajectory.accel_biases[row],
        gyro_bias=trajectory.gyro_biases[row],
    )


def states_in(values: gtsam.Values, stamps_ns: Sequence[int]) -> list[NavState]:
    """The states X(k), V(k) and B(k) among some values, with their times, without covariances."""
    states = []
    for k, stamp_ns in enumerate(stamps_ns):
        bias = values.atConstantBias(B(k))
        states.append(
            NavState(
                stamp_ns,
                values.atPose3(X(k)),
                np.asarray(values.atVector(V(k))),
                accel_bias=np.asarray(bias.accelerometer()),
                gyro_bias=np.asarray(bias.gyroscope()),
            )
        )
    return states


def states_at(
    known: Trajectory,
    stamps_ns: IntArray,
    imu: ImuBuffer,
    params: gtsam.PreintegrationCombinedParams,
) -> list[NavState]:
    """States at given times: interpolated, or predicted by the IMU from the nearest one.

    Args:
        known: the causal estimate.
        stamps_ns: (K,) ascending times, at least one within `known`.
        imu: samples over all of these times.
        params: gravity and noise.
    """
    inside, valid = interpolate(known, stamps_ns, _MAX_GAP_S)
    rows = np.cumsum(valid) - 1
    states: dict[int, NavState] = {
        k: state_at(inside, int(rows[k])) for k in np.flatnonzero(valid).tolist()
    }
    count, first = len(stamps_ns), int(np.argmax(valid))
    for k in range(first - 1, -1, -1):
        states[k] = _predict_backward(states[k + 1], int(stamps_ns[k]), imu, params)
    for k in range(first + 1, count):
        if k not in states:
            states[k] = _predict_forward(states[k - 1], int(stamps_ns[k]), imu, params)
    return [states[k] for k in range(count)]


def _predict_forward(
    state: NavState, stamp_ns: int, imu: ImuBuffer, params: gtsam.PreintegrationCombinedParams
) -> NavState:
    """The state at a later time."""
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
    pim = imu.between(state.stamp_ns, stamp_ns).preintegrated(bias, params)
    return state.predicted(pim, stamp_ns)


def _predict_backward(
    state: NavState, stamp_ns: int, imu: ImuBuffer, params: gtsam.PreintegrationCombinedParams
) -> NavState:
    """The state at an earlier time: the inverse of the dynamics.

    With ΔR, Δv and Δp preintegrated over the time T in between (Forster et al. 2017, eq. 33),
    R = R' ΔRᵀ, v = v' - g T - R Δv, p = p' - v T - ½ g T² - R Δp.
    """
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
    pim = imu.between(stamp_ns, state.stamp_ns).preintegrated(bias, params)
    seconds, gravity = pim.deltaTij(), params.n_gravity
    rotation = state.world_T_body.rotation().compose(pim.deltaRij().inverse())
    velocity = state.velocity - gravity * seconds - rotation.rotate(pim.deltaVij())
    position = (
        state.world_T_body.translation()
        - velocity * seconds
        - 0.5 * gravity * seconds**2
        - rotation.rotate(pim.deltaPij())
    )
    pose = gtsam.Pose3(rotation, position)
    return NavState(
        stamp_ns, pose, velocity, accel_bias=state.accel_bias, gyro_bias=state.gyro_bias
    )


def with_angular_rates(states: list[NavState], imu: ImuBuffer) -> list[NavState]:
    """The states with the rates of the motion to the next one, as `constant_velocity` has them.

    Args:
        states: ascending in time.
        imu: what is known of the motion; what differs from it stands in the place of the bias.
    """
    biases = []
    for state, later in pairwise(states):
        seconds = (later.stamp_ns - state.stamp_ns) * 1e-9
        turn = state.world_T_body.rotation().between(later.world_T_body.rotation())
        known = imu.between(state.stamp_ns, later.stamp_ns).gyro.mean(axis=0)
        biases.append(known - gtsam.Rot3.Logmap(turn) / seconds)
    biases += biases[-1:] or [np.zeros(3)]
    return [replace(s, gyro_bias=bias) for s, bias in zip(states, biases, strict=True)]


def fill_in(
    keyframes: list[NavState],
    stamps_ns: IntArray,
    imu: ImuBuffer,
    params: gtsam.PreintegrationCombinedParams,
) -> list[NavState]:
    """States at all frames, from those of the keyframes.

    The IMU predicts from each keyframe to the next one. The difference to the estimate there is
    distributed over the frames in between in proportion to time, so that both ends are met.

    Args:
        keyframes: at least one state.
        stamps_ns: (N,) ascending times, those of the keyframes among them.
        imu: samples over all of these times.
        params: gravity and noise.
    """
    known_ns = [state.stamp_ns for state in keyframes]
    at = np.searchsorted(stamps_ns, known_ns)
    if len(stamps_ns) == len(keyframes):
        return list(keyframes)
    rotations, positions, velocities = _predicted(keyframes, stamps_ns, at, imu, params)
    states: list[NavState] = []
    for k, (start, end) in enumerate(pairwise(keyframes)):
        states.append(start)
        if at[k] + 1 == at[k + 1]:
            continue
        there = _pose(rotations[at[k + 1]], positions[at[k + 1]])
        pose_error = gtsam.Pose3.Logmap(there.between(end.world_T_body))
        velocity_error = end.velocity - velocities[at[k + 1]]
        biases = {"accel_bias": start.accel_bias, "gyro_bias": start.gyro_bias}
        for i in range(at[k] + 1, at[k + 1]):
            part = (stamps_ns[i] - known_ns[k]) / (known_ns[k + 1] - known_ns[k])
            pose = _pose(rotations[i], positions[i])
            pose = pose.compose(gtsam.Pose3.Expmap(part * pose_error))
            velocity = velocities[i] + part * velocity_error
            states.append(NavState(int(stamps_ns[i]), pose, velocity, **biases))
    return [*states, keyframes[-1]]


def _predicted(
    keyframes: list[NavState],
    stamps_ns: IntArray,
    at: IntArray,
    imu: ImuBuffer,
    params: gtsam.PreintegrationCombinedParams,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations (N, 3, 3), positions and velocities (N, 3), predicted from the keyframe before.

    Args:
        keyframes: their states.
        stamps_ns: (N,) times.
        at: (K,) rows of the keyframes in these.
        imu: as for `fill_in`.
        params: as for `fill_in`.
    """
    steps, first = imu.steps_at(stamps_ns)
    count = len(stamps_ns)
    rotations, (positions, velocities) = np.empty((count, 3, 3)), np.empty((2, count, 3))
    poses = np.array([state.world_T_body.matrix() for state in keyframes])
    rotations[at], positions[at] = poses[:, :3, :3], poses[:, :3, 3]
    velocities[at] = [state.velocity for state in keyframes]
    predict_motion(
        steps.durations_s,
        steps.gyro,
        steps.accel,
        first,
        at,
        rotations,
        positions,
        velocities,
        np.array([state.gyro_bias for state in keyframes]),
        np.array([state.accel_bias for state in keyframes]),
        np.array(params.n_gravity, np.float64),
    )
    return rotations, positions, velocities


def _pose(rotation: FloatArray, position: FloatArray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(rotation), position)


def fill_in_by_motion(
    keyframes: list[NavState],
    stamps_ns: IntArray,
    causal: Trajectory,
    imu: ImuBuffer,
    params: gtsam.PreintegrationCombinedParams,
) -> list[NavState]:
    """States at all frames by the motion of the causal estimate between the keyframes.

    Its difference to the motion between two keyframes is distributed over the frames in between.

    Args:
        keyframes: at least one state.
        stamps_ns: (N,) ascending times, those of the keyframes among them.
        causal: poses with velocities; where it has none, `fill_in` takes its place.
        imu: as for `fill_in`.
        params: as for `fill_in`.
    """
    known, valid = interpolate(causal, stamps_ns, _MAX_GAP_S)
    rows = np.cumsum(valid) - 1
    states: list[NavState] = []
    at = np.searchsorted(stamps_ns, [state.stamp_ns for state in keyframes])
    for k, (start, end) in enumerate(pairwise(keyframes)):
        between = range(int(at[k]), int(at[k + 1]) + 1)
        if not valid[list(between)].all():
            inside = stamps_ns[between.start : between.stop]
            states += fill_in([start, end], inside, imu, params)[:-1]
            continue
        states.append(start)
        first, last = (known.pose(int(rows[i])) for i in (between[0], between[-1]))
        moved = first.between(last)
        error = gtsam.Pose3.Logmap(moved.between(start.world_T_body.between(end.world_T_body)))
        for i in between[1:-1]:
            state = state_at(known, int(rows[i]))
            part = (state.stamp_ns - start.stamp_ns) / (end.stamp_ns - start.stamp_ns)
            motion = first.between(state.world_T_body).compose(gtsam.Pose3.Expmap(part * error))
            pose = start.world_T_body.compose(motion)
            turn = pose.rotation().compose(state.world_T_body.rotation().inverse())
            velocity = np.asarray(turn.rotate(state.velocity))
            states.append(replace(state, world_T_body=pose, velocity=velocity))
    return [*states, keyframes[-1]]


def values_of(states: list[NavState]) -> gtsam.Values:
    """Poses, velocities and biases of the keyframes as variables."""
    values = gtsam.Values()
    for k, state in enumerate(states):
        values.insert(X(k), state.world_T_body)
        values.insert(V(k), np.asarray(state.velocity, dtype=np.float64))
        values.insert(B(k), gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias))
    return values


def extended_by(earlier: list[NavState], later: Trajectory) -> Trajectory:
    """A trajectory with velocities and biases, with states before its first one."""
    history = StateHistory()
    for state in earlier:
        history.append(state)
    return Trajectory.concatenate([history.trajectory(), later])


def in_unknown_world(history: StateHistory, unknown: FloatArray) -> StateHistory:
    """States with the uncertainty of the gauge of their world added to their covariances.

    Args:
        history: whose world turns about its first state.
        unknown: (4, 4) or (6, 6) covariance of the gauge (m, rad), see `world_gauge.py`.
    """
    if len(history) == 0 or not unknown.any():
        return history
    path, added = history.trajectory(), history.like()
    poses, sigmas = history.pose_covariances(), history.sigmas()
    for k, (pose, own) in enumerate(zip(poses, sigmas, strict=True)):
        covariance = np.diag(own**2)
        covariance[: len(pose), : len(pose)] = pose
        state = replace(state_at(path, k), covariance=covariance)
        added.append(with_unknown_gauge(state, unknown, path.positions[0]))
    return added
