# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The modules on linear problems against the textbook Kalman filter."""

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import gtsam
import numpy as np
import pytest
from flight import Flight, rig
from gtsam.symbol_shorthand import B, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.cost import Cost
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.marginalization.marginalize import LinearizationPoints, marginalize
from slam_graph.backend.policies import GaussNewtonPolicy
from slam_graph.backend.solve.gauss_newton import minimize
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import State, dims_of

ONE_STEP = GaussNewtonPolicy(max_steps=1)
SIZE = 9  # velocity and bias: variables whose retraction is a sum


def covariance(rng: np.random.Generator, size: int) -> FloatArray:
    root = rng.normal(size=(size, 2 * size))
    return root @ root.T / size


def gaussian(keys: list[int], mean: FloatArray, P: FloatArray) -> SquareRootInformation:
    """The square-root form of a mean and a covariance."""
    n = len(mean)
    Rd = np.zeros((n + 1, n + 1), order="F")
    Rd[:-1, :-1] = np.linalg.cholesky(np.linalg.inv(P)).T
    Rd[:-1, -1] = Rd[:-1, :-1] @ mean
    return SquareRootInformation(Layout(dims_of(keys)), Rd)


def tangent(origin: gtsam.Values, values: gtsam.Values, key: int) -> FloatArray:
    """Where a variable is, as seen from another value of it."""
    kind = chr(gtsam.Symbol(key).chr())
    if kind == "x":
        local = origin.atPose3(key).localCoordinates(values.atPose3(key))
    elif kind == "b":
        local = values.atConstantBias(key).vector() - origin.atConstantBias(key).vector()
    else:
        local = values.atVector(key) - origin.atVector(key)
    return np.asarray(local)


def linear_factor(
    state: State, keys: list[int], A: FloatArray, b: FloatArray, R: FloatArray
) -> gtsam.CustomFactor:
    """A (x ⊖ x₀) - b with noise covariance R, from the present linearisation points x₀ on."""
    points = gtsam.Values(state.first)
    ends = np.cumsum([0, *dims_of(keys).values()]).tolist()

    def residual(
        _: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None
    ) -> FloatArray:
        if H is not None:
            for k, (start, end) in enumerate(pairwise(ends)):
                H[k] = A[:, start:end]
        away = np.concatenate([tangent(points, values, key) for key in keys])
        return np.asarray(A @ away - b)

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(R), keys, residual)


def cost_of(
    state: State, prior: SquareRootInformation, factors: list[gtsam.NonlinearFactor]
) -> Cost:
    return Cost(state, RigProjection(rig()), BackendConfig(), prior, factors)


@pytest.mark.parametrize("seed", range(4))
def test_one_step_is_the_kalman_update(seed: int) -> None:
    """From the linearisation point, on pose, velocity and bias."""
    rng = np.random.default_rng(seed)
    state = State()
    state.insert_imu_state(0, Flight().nav_state(0.7))
    keys = [X(0), V(0), B(0)]
    mean, P, R = 0.05 * rng.normal(size=15), covariance(rng, 15), covariance(rng, 7)
    H, z = rng.normal(size=(7, 15)), rng.normal(size=7)
    cost = cost_of(state, gaussian(keys, mean, P), [linear_factor(state, keys, H, z, R)])
    before = state.copy()
    posterior = minimize(cost, ONE_STEP).posterior
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    expected = mean + K @ (z - H @ mean)
    I_KH = np.eye(15) - K @ H
    np.testing.assert_allclose(state.offset(posterior.layout), expected, atol=1e-9)
    joseph = I_KH @ P @ I_KH.T + K @ R @ K.T
    np.testing.assert_allclose(posterior.covariance(), joseph, atol=1e-9)
    # the posterior is over an increment of the moved estimates, so its own solution is zero
    np.testing.assert_allclose(posterior.solution(), 0.0, atol=1e-9)
    pose = before.first.atPose3(X(0)).retract(expected[:6])
    np.testing.assert_allclose(state.estimate.atPose3(X(0)).matrix(), pose.matrix(), atol=1e-9)


@pytest.mark.parametrize("damping", ["none", "levenberg_marquardt"])
def test_more_steps_do_not_move_a_linear_solution(
    damping: Literal["none", "levenberg_marquardt"],
) -> None:
    rng = np.random.default_rng(9)
    mean, P, R = rng.normal(size=SIZE), covariance(rng, SIZE), covariance(rng, 4)
    H, z = rng.normal(size=(4, SIZE)), rng.normal(size=4)
    many = GaussNewtonPolicy(max_steps=40, damping=damping, tolerance=1e-15)
    solutions = []
    for policy in (ONE_STEP, many):
        state = State()
        state.insert_imu_state(0, Flight().nav_state(0.0))
        keys = [V(0), B(0)]
        state.freeze(keys)
        cost = cost_of(state, gaussian(keys, mean, P), [linear_factor(state, keys, H, z, R)])
        solutions.append(
            (minimize(cost, policy).posterior.covariance(), _vector(state.estimate, 0))
        )
    np.testing.assert_allclose(solutions[1][1], solutions[0][1], atol=1e-8)
    np.testing.assert_allclose(solutions[1][0], solutions[0][0], atol=1e-8)


def range_factor(state: State, key: int, z: float, sigma: float) -> gtsam.CustomFactor:
    """A measurement that is not linear: the length of a velocity."""

    def residual(
        _: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None
    ) -> FloatArray:
        v = values.atVector(key)
        if H is not None:
            H[0] = (v / np.linalg.norm(v))[None]
        return np.array([np.linalg.norm(v) - z])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), [key], residual)


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_several_steps_are_the_iterated_kalman_update(iterations: int) -> None:
    """After a prediction, against x⁻ + K (z - h(xᵢ) - H (x⁻ - xᵢ)) with K and H at each xᵢ."""
    rng = np.random.default_rng(6)
    state = State()
    state.insert_imu_state(0, Flight().nav_state(0.0))
    state.freeze([V(0)])
    P, Q, F = covariance(rng, 3), covariance(rng, 3), np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    old = state.first.atVector(V(0))
    predicted, P = F @ old, F @ P @ F.T + Q
    state.insert_imu_state(1, replace(Flight().nav_state(0.0), velocity=predicted))
    transition = np.hstack([-F, np.eye(3)])
    dynamics = linear_factor(state, [V(0), V(1)], transition, F @ old - predicted, Q)
    z, sigma = 1.7 * float(np.linalg.norm(predicted)), 0.05
    prior = gaussian([V(0)], np.zeros(3), np.linalg.inv(F) @ (P - Q) @ np.linalg.inv(F).T)
    cost = cost_of(state, prior, [dynamics, range_factor(state, V(1), z, sigma)])
    minimize(cost, GaussNewtonPolicy(max_steps=iterations, tolerance=0.0))

    x = predicted
    for _ in range(iterations):
        H = (x / np.linalg.norm(x))[None]
        K = P @ H.T / (H @ P @ H.T + sigma**2)
        x = predicted + K[:, 0] * (z - np.linalg.norm(x) - (H @ (predicted - x))[0])
    np.testing.assert_allclose(state.estimate.atVector(V(1)), x, atol=1e-9)


@pytest.mark.parametrize("max_steps", [1, 3])
@pytest.mark.parametrize("first_estimates", [True, False])
def test_the_loop_is_a_kalman_filter(first_estimates: bool, max_steps: int) -> None:
    """Predict, update, marginalise over twenty steps; also with new linearisation points."""
    steps = GaussNewtonPolicy(max_steps=max_steps, tolerance=0.0)
    rng = np.random.default_rng(4)
    state = State()
    start = Flight().nav_state(0.0)
    state.insert_imu_state(0, start)
    x = np.concatenate([start.velocity, start.accel_bias, start.gyro_bias])
    P = covariance(rng, SIZE)
    prior = gaussian([V(0), B(0)], np.zeros(SIZE), P)
    state.freeze([V(0), B(0)])
    for k in range(20):
        F, u = np.eye(SIZE) + 0.1 * rng.normal(size=(SIZE, SIZE)), rng.normal(size=SIZE)
        Q, R = covariance(rng, SIZE), covariance(rng, 3)
        H, z = rng.normal(size=(3, SIZE)), rng.normal(size=3)
        # a new state that is deliberately not at its prediction
        state.insert_imu_state(k + 1, Flight().nav_state(0.3 * k))
        old, new = [V(k), B(k)], [V(k + 1), B(k + 1)]
        old_point, new_point = _vector(state.first, k), _vector(state.first, k + 1)
        transition = np.hstack([-F, np.eye(SIZE)])
        dynamics = linear_factor(state, [*old, *new], transition, F @ old_point + u - new_point, Q)
        measurement = linear_factor(state, new, H, z - H @ new_point, R)
        cost = cost_of(state, prior, [dynamics, measurement])
        points: LinearizationPoints = "first" if first_estimates else "current"
        prior = marginalize(minimize(cost, steps).posterior, state, new, points)

        x, P = F @ x + u, F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z - H @ x), (np.eye(SIZE) - K @ H) @ P
        np.testing.assert_allclose(_vector(state.estimate, k + 1), x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(prior.covariance(), P, rtol=1e-9, atol=1e-9)
        at_estimate = prior.shifted(state.offset(prior.layout))
        np.testing.assert_allclose(at_estimate.solution(), 0.0, atol=1e-8)
        assert not state.estimate.exists(V(k))
        assert set(new) <= state.frozen
        assert first_estimates or not state.offset(prior.layout).any()


def _vector(values: gtsam.Values, frame: int) -> FloatArray:
    bias = values.atConstantBias(B(frame)).vector()
    return np.concatenate([values.atVector(V(frame)), bias])


def test_an_undetermined_variable_is_refused() -> None:
    state = State()
    state.insert_imu_state(0, Flight().nav_state(0.0))
    prior = gaussian([V(0)], np.zeros(3), np.eye(3))
    free = linear_factor(state, [B(0)], np.eye(2, 6), np.zeros(2), np.eye(2))
    with pytest.raises(np.linalg.LinAlgError):
        minimize(cost_of(state, prior, [free]), ONE_STEP)
