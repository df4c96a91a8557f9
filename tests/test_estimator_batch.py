# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A window as long as the sequence is batch Gauss-Newton: GTSAM's solution of all factors at once.

Noise is scaled down to where the problem is linear, since a filter linearises each feature once.
"""

import gtsam
import numpy as np
import pytest
from flight import Flight, packets, rig, room
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, GatingConfig, InitializationConfig
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.policies import (
    AlgorithmConfig,
    CostPolicy,
    GaussNewtonPolicy,
    MarginalizationPolicy,
)
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import ImuBuffer, preintegrate, preintegration_params
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet
from slam_graph.sensors.rig import Rig

EPSILON = 1e-3
"""Noise of the pixels and error of the start, in standard deviations."""
SIGMAS = np.array([0.02, 0.05, 0.1, 0.1, 0.01])
CONFIG = BackendConfig(
    gating=GatingConfig(confidence=1.0 - 1e-12, robust_loss="none"),
    initialization=InitializationConfig(mode="given", fix_gauge=False),
)
DURATION_S = 1.5
FRAME_RATE_HZ = 10.0


def recording(mounted: Rig) -> list[Packet]:
    """A flight after which all features are out of sight, so that each of them has been used."""
    rng = np.random.default_rng(11)
    points = room(40, rng)
    flown = list(packets(Flight(), mounted, points, DURATION_S, None, FRAME_RATE_HZ, 1.0))
    noisy = []
    for packet in flown:
        assert isinstance(packet.frame, FeatureFrame)
        cameras = []
        for mount, seen in zip(mounted.cameras, packet.frame.cameras, strict=True):
            pixels = seen.pixels + EPSILON * rng.normal(size=seen.pixels.shape)
            cameras.append(FeatureObservations(seen.ids, pixels, mount.camera.undistort(pixels)))
        noisy.append(Packet(packet.imu, FeatureFrame(packet.frame.stamp_ns, tuple(cameras))))
    blind = FeatureFrame(
        noisy[-1].frame.stamp_ns, (FeatureObservations.empty(),) * len(mounted.cameras)
    )
    return [*noisy[:-1], Packet(noisy[-1].imu, blind)]


def given_start() -> NavState:
    """The true state with a small error, and its covariance."""
    rng = np.random.default_rng(12)
    true = Flight().nav_state(0.0, SIGMAS)
    error = EPSILON * np.repeat(SIGMAS, 3) * rng.normal(size=15)
    return NavState(
        true.stamp_ns,
        true.world_T_body.retract(error[:6]),
        true.velocity + error[6:9],
        accel_bias=true.accel_bias + error[9:12],
        gyro_bias=true.gyro_bias + error[12:],
        covariance=true.covariance,
    )


def batch_problem(
    start: NavState, flown: list[Packet], mounted: Rig
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All factors of a flight, and the truth to begin at."""
    graph, values, buffer = gtsam.NonlinearFactorGraph(), gtsam.Values(), ImuBuffer()
    buffer.add(ImuData.concatenate([packet.imu for packet in flown]))
    params = preintegration_params(mounted.imu, 9.81)
    bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
    S = start.covariance
    assert S is not None
    noise = gtsam.noiseModel.Gaussian.Covariance
    graph.add(gtsam.PriorFactorPose3(X(0), start.world_T_body, noise(S[:6, :6])))
    graph.add(gtsam.PriorFactorVector(V(0), start.velocity, noise(S[6:9, 6:9])))
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, noise(S[9:, 9:])))
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, CONFIG.noise.pixel_sigma)
    seen: dict[int, list[gtsam.NonlinearFactor]] = {}
    for i, packet in enumerate(flown):
        true = Flight().nav_state(packet.frame.stamp_ns * 1e-9)
        values.insert(X(i), true.world_T_body)
        values.insert(V(i), true.velocity)
        values.insert(B(i), gtsam.imuBias.ConstantBias())
        if i:
            samples = buffer.between(flown[i - 1].frame.stamp_ns, packet.frame.stamp_ns)
            graph.add(imu_factor(i - 1, i, preintegrate(samples, bias, params)))
        assert isinstance(packet.frame, FeatureFrame)
        for mount, observed in zip(mounted.cameras, packet.frame.cameras, strict=True):
            c = mount.camera
            K = gtsam.Cal3DS2(c.fx, c.fy, 0.0, c.cx, c.cy, *c.coefficients)
            for j, z in zip(observed.ids.tolist(), observed.pixels, strict=True):
                seen.setdefault(j, []).append(
                    gtsam.GenericProjectionFactorCal3DS2(
                        z, pixel, X(i), L(j), K, False, False, mount.body_T_camera
                    )
                )
    points = room(40, np.random.default_rng(11))
    for j, factors in seen.items():
        if len({f.keys()[0] for f in factors}) >= 2:
            values.insert(L(j), points[j])
            for factor in factors:
                graph.add(factor)
    return graph, values


def solved(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """The least cost, by Gauss-Newton from the truth, which is near."""
    params = gtsam.GaussNewtonParams()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setRelativeErrorTol(1e-14)
    return gtsam.GaussNewtonOptimizer(graph, values, params).optimize()


def differences(state: NavState, values: gtsam.Values, i: int) -> FloatArray:
    """The tangent (15,) from the state of frame i to a state."""
    bias = values.atConstantBias(B(i))
    return np.concatenate(
        [
            values.atPose3(X(i)).localCoordinates(state.world_T_body),
            state.velocity - values.atVector(V(i)),
            state.accel_bias - bias.accelerometer(),
            state.gyro_bias - bias.gyroscope(),
        ]
    )


ONCE = CostPolicy(max_past_poses=1000, max_state_features=0, max_features_per_step=1000)
ALL_ALONG = ONCE.model_copy(update={"features": "window", "recent_frames": 1000})
LONG_WINDOWS = {
    "swf": AlgorithmConfig(name="swf", cost=ONCE),
    "msckf": AlgorithmConfig(
        name="msckf", cost=ONCE.model_copy(update={"past_poses": "evenly_spaced"})
    ),
    "several steps": AlgorithmConfig(
        name="smoother",
        cost=ALL_ALONG,
        gauss_newton=GaussNewtonPolicy(max_steps=10, tolerance=1e-12),
        marginalization=MarginalizationPolicy(absorb="touching"),
    ),
}
"""Policies under which no pose leaves: features are used once, or linearised anew in every step."""


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("name", LONG_WINDOWS)
def test_a_window_as_long_as_the_sequence_is_batch_gauss_newton(name: str, cameras: int) -> None:
    mounted = rig(cameras)
    flown, start = recording(mounted), given_start()
    estimator = Estimator(mounted, LONG_WINDOWS[name], CONFIG)
    estimator.start(start)
    for packet in flown:
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
    assert state is not None
    assert state.covariance is not None

    graph, values = batch_problem(start, flown, mounted)
    best, last = solved(graph, values), len(flown) - 1
    sigmas = np.sqrt(np.diag(state.covariance))
    moved = differences(Flight().nav_state(state.stamp_ns * 1e-9), best, last) / sigmas
    missed = differences(state, best, last) / sigmas
    assert np.linalg.norm(missed) < 2e-3 * np.linalg.norm(moved)
    marginals = gtsam.Marginals(graph, best)
    for key, rows in ((X(last), slice(0, 6)), (V(last), slice(6, 9)), (B(last), slice(9, 15))):
        expected = marginals.marginalCovariance(key)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(
            state.covariance[rows, rows] / scale, expected / scale, atol=1e-3
        )
