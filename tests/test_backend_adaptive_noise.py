# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive noise: found where the IMU is worse than its calibration, left alone elsewhere."""

import numpy as np
import pytest
from estimating import BELIEVED, from_given_state

from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.backend.cost.adaptive_imu_noise import (
    ACCEL_SCALE_SIGMA,
    FEWEST_FEATURES,
    GYRO_SCALE_SIGMA,
    RESPONSE_TIME_S,
    DensityScales,
    DynamicsNoise,
    MotionChange,
)
from slam_graph.config import load_config
from slam_graph.evaluation.consistency import nees
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import ImuNoise
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

DT_S = 0.05
COVARIANCE = np.array([[2.0, 0.4, 0.0], [0.4, 1.0, -0.3], [0.0, -0.3, 0.5]])


def factors(corrections: np.ndarray, fall_time_s: float = RESPONSE_TIME_S) -> np.ndarray:
    """The factor after each of some corrections (N, 3), whose covariance is said to be as above."""
    scale = DensityScales([fall_time_s])
    history = []
    for correction in corrections:
        scale.observe(correction[None], COVARIANCE[None], DT_S)
        history.append(float(scale.factors[0]))
    return np.array(history)


def corrections(persistence: float, size: float) -> np.ndarray:
    """A first-order Markov sequence (4000, 3) with the covariance above times `size` squared."""
    rng = np.random.default_rng(5)
    white = rng.normal(size=(4000, 3)) @ np.linalg.cholesky(COVARIANCE).T * size
    values = np.zeros_like(white)
    for k in range(1, len(white)):
        values[k] = persistence * values[k - 1] + np.sqrt(1.0 - persistence**2) * white[k]
    return values


def test_white_corrections_of_the_right_size_leave_the_densities_alone() -> None:
    history = factors(corrections(0.0, 1.0))
    assert history.mean() < 1.03
    assert history.max() < 1.5


def test_corrections_that_are_only_persistent_or_only_large_leave_them_alone() -> None:
    assert factors(corrections(0.95, 0.6)).mean() < 1.1  # images whose errors last
    assert factors(np.tile([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]], (500, 1))).mean() < 1.1


def test_large_and_persistent_corrections_raise_them_and_they_fall_back() -> None:
    history = factors(np.concatenate([corrections(0.9, 2.0)[:200], corrections(0.0, 1.0)]))
    assert history[200] > 3.0
    assert history[1000:].mean() < 1.03


def test_a_slow_fall_keeps_what_was_learned_and_does_not_creep_up() -> None:
    surprised = np.concatenate([corrections(0.9, 2.0)[:200], corrections(0.0, 1.0)])
    assert factors(surprised, fall_time_s=10.0)[400] > 1.5 * factors(surprised)[400]
    assert factors(corrections(0.0, 1.0), fall_time_s=10.0).mean() < 1.25


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 1000.0])
def test_vibration_raises_the_noise_at_once_and_motion_does_not(rate_hz: float) -> None:
    """A swing of 3 m/s² at 2 Hz with the noise of the calibration, then with thirty times that."""
    calibrated = ImuNoise(rate_hz=rate_hz)
    noise, imu, rng = (
        DynamicsNoise(calibrated, NoiseConfig()),
        ImuBuffer(),
        np.random.default_rng(1),
    )
    t = np.arange(0.0, 4.0, 1.0 / rate_hz)
    sigma = calibrated.accel_noise_density * np.sqrt(rate_hz)
    sigmas = np.where(t < 2.0, sigma, 30.0 * sigma)[:, None]
    swing = np.outer(np.sin(4.0 * np.pi * t), [3.0, -2.0, 1.0])
    accel = swing + sigmas * rng.normal(size=swing.shape)
    imu.add(ImuData(np.round(t * 1e9).astype(np.int64), np.zeros_like(accel), accel))
    found = {}
    samples = imu.data
    for frame_s in np.arange(0.5, 3.0, 0.05).round(2):
        imu.data = samples[: int(np.searchsorted(samples.stamps_ns, frame_s * 1e9))]
        noise.watch_vibration(imu, round(frame_s * 1e9))
        found[frame_s] = noise.factors
    assert found[2.0] == (1.0, 1.0)
    gyro, accel_factor = found[2.5]
    assert gyro == 1.0
    assert accel_factor > 3.0


@pytest.mark.parametrize("adaptive", [True, False])
def test_errors_of_scale_and_alignment_change_the_biases_as_the_motion_changes(
    adaptive: bool,
) -> None:
    """A sensor measures f + M f and ω + M |ω| ω; their changes have the covariance of the walks."""
    rng = np.random.default_rng(3)
    stamps_ns = np.arange(0, 60_000_000, 5_000_000)
    before, samples = (
        ImuData(stamps_ns + offset_ns, np.tile(gyro, (12, 1)), np.tile(accel, (12, 1)))
        for offset_ns, gyro, accel in (
            (0, [0.1, 2.0, -0.5], [0.0, 1.0, 9.8]),
            (55_000_000, [1.5, -1.0, 0.2], [3.0, -2.0, 8.0]),
        )
    )
    elapsed_s = 0.055
    imu = ImuNoise(gyro_random_walk=1e-9, accel_random_walk=1e-9)
    config = NoiseConfig.model_validate({"adaptive": {"enabled": adaptive}})
    params = DynamicsNoise(imu, config).params(change=MotionChange.between(before, samples))
    squares = [np.linalg.norm(x.gyro[0]) * x.gyro[0] for x in (before, samples)]
    for covariance, sigma, change in (
        (params.getBiasOmegaCovariance(), GYRO_SCALE_SIGMA, squares[1] - squares[0]),
        (params.getBiasAccCovariance(), ACCEL_SCALE_SIGMA, samples.accel[0] - before.accel[0]),
    ):
        drawn = np.cov((rng.normal(0.0, sigma, (20_000, 3, 3)) @ change).T)
        expected = drawn if adaptive else np.full((3, 3), 0.0)
        assert covariance * elapsed_s == pytest.approx(expected, abs=0.04 * drawn.max())


def mean_nees(noise_scale: float, adaptive: bool) -> float:
    """Of the poses (6 is ideal) of a simulated flight with noisier samples than calibrated."""
    flight = {"duration_s": 15.0, "rate_hz": 10.0, "seed": 3, "imu": {"noise_scale": noise_scale}}
    overrides = [
        f"backend.noise.adaptive.enabled={adaptive}",
        "backend.initialization.mode=given",
        "cameras=2",
        "final_ba.enabled=false",
        BELIEVED,
    ]
    sequence = simulate(SimulationConfig(**flight, tracks={"features": 40}))
    result = run(sequence, load_config(algorithm="msckf", overrides=overrides))
    truth = sequence.groundtruth()
    assert truth is not None
    history = result.history
    values = nees(history.trajectory(), history.pose_covariances(), truth)
    return float(values.pose.mean())


@pytest.mark.slow
def test_an_imu_much_noisier_than_its_calibration_is_found_out() -> None:
    believing = mean_nees(12.0, adaptive=False)
    learning = mean_nees(12.0, adaptive=True)
    assert learning < 0.35 * believing


@pytest.mark.slow
def test_nothing_changes_where_the_calibration_is_right() -> None:
    believing = mean_nees(1.0, adaptive=False)
    learning = mean_nees(1.0, adaptive=True)
    assert learning == pytest.approx(believing, rel=0.1)


def largest_gyro_factor(features: int) -> float:
    """In a flight with an IMU twelve times as noisy as its calibration says."""
    flight = {"duration_s": 6.0, "seed": 3, "imu": {"noise_scale": 12.0}}
    sequence = simulate(SimulationConfig(**flight, tracks={"features": features}))
    return max(estimator.imu_noise[0] for estimator in from_given_state(sequence, "msckf"))


def test_a_few_tracks_do_not_judge_an_imu() -> None:
    assert largest_gyro_factor(2 * FEWEST_FEATURES) > 1.5
    assert largest_gyro_factor(FEWEST_FEATURES - 1) == 1.0
