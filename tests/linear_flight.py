# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A short flight with hardly any noise, as a recording and as one graph of all its factors.

Noise is scaled down to where the problem is linear, since a filter linearises each feature once.
"""

import gtsam
import numpy as np
from flight import NS_PER_S, Flight, features_from, packets, room
from gtsam.symbol_shorthand import B, L, V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import (
    AdaptiveNoiseConfig,
    BackendConfig,
    GatingConfig,
    InitializationConfig,
    NoiseConfig,
)
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.geometry.trajectory import NavState
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet
from slam_graph.sensors.rig import Rig

EPSILON = 1e-3
"""Noise of the pixels and error of the start, in standard deviations."""
POINTS = 40
SIGMAS = np.array([0.02, 0.05, 0.1, 0.1, 0.01])
CONFIG = BackendConfig(
    noise=NoiseConfig(adaptive=AdaptiveNoiseConfig(enabled=False)),
    gating=GatingConfig(confidence=1.0 - 1e-12, robust_loss="none"),
    initialization=InitializationConfig(mode="given", fix_gauge=False),
)
DURATION_S = 1.5
FRAME_RATE_HZ = 10.0


def recording(
    mounted: Rig,
) -> list[Packet]:
    """A flight after which all features are out of sight, so that each of them has been used."""
    rng = np.random.default_rng(11)
    points = room(POINTS, rng)
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


def exact_recording(
    mounted: Rig, frames: int, points: FloatArray
) -> tuple[list[NavState], list[Packet]]:
    """A flight without any error: its true states are the integrated IMU samples.

    Returns:
        states: the true ones; the first with its covariance.
        packets: one for each frame; the last frame sees nothing.
    """
    state = Flight().nav_state(0.0, SIGMAS)
    states, flown, buffer = [state], [], ImuBuffer()
    step_s = 1.0 / FRAME_RATE_HZ
    imu = Flight().imu(-0.1, frames * step_s)
    buffer.add(imu)
    params, bias = mounted.imu.preintegration_params(9.81), gtsam.imuBias.ConstantBias()
    for _ in range(1, frames):
        stamp_ns = state.stamp_ns + round(step_s * NS_PER_S)
        samples = buffer.between(state.stamp_ns, stamp_ns)
        state = state.predicted(samples.preintegrated(bias, params), stamp_ns)
        states.append(state)
    given = 0
    for i, state in enumerate(states):
        seen = points if i < frames - 1 else points[:0]
        R, p = state.world_T_body.rotation().matrix(), state.world_T_body.translation()
        frame = features_from(R, p, mounted, seen, state.stamp_ns)
        until = int(np.searchsorted(imu.stamps_ns, state.stamp_ns)) + 1
        flown.append(Packet(imu[given:until], frame))
        given = until
    return states, flown


def batch_problem(
    start: NavState,
    flown: list[Packet],
    mounted: Rig,
    points: FloatArray | None = None,
    states: list[NavState] | None = None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All factors of a flight, and the truth to begin at."""
    graph, values, buffer = gtsam.NonlinearFactorGraph(), gtsam.Values(), ImuBuffer()
    buffer.add(ImuData.concatenate([packet.imu for packet in flown]))
    params = mounted.imu.preintegration_params(9.81)
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
        at_s = packet.frame.stamp_ns * 1e-9
        true = Flight().nav_state(at_s) if states is None else states[i]
        values.insert(X(i), true.world_T_body)
        values.insert(V(i), true.velocity)
        values.insert(B(i), gtsam.imuBias.ConstantBias())
        if i:
            samples = buffer.between(flown[i - 1].frame.stamp_ns, packet.frame.stamp_ns)
            graph.add(imu_factor(i - 1, i, samples.preintegrated(bias, params)))
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
    points = room(POINTS, np.random.default_rng(11)) if points is None else points
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
