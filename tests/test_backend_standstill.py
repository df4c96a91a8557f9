# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Standing still: when it is detected, and that the platform then stays where it is."""

from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from estimating import BELIEVED
from flight import AT_REST, packets, rig, room
from groups import slow
from gtsam.symbol_shorthand import V, X

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, ZeroVelocityConfig
from slam_graph.backend.cost.zero_velocity import (
    POSITION_SIGMA,
    VELOCITY_SIGMA,
    StandstillDetector,
    zero_velocity_factors,
)
from slam_graph.backend.estimator import Estimator
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.geometry.state_history import StateHistory
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData
from slam_graph.simulation import simulate

Motion = Callable[[float], FloatArray]
CONFIG = ZeroVelocityConfig()
FRAME_S = 0.05


def decisions(
    drift_px: Motion,
    gyro_std: float = 0.01,
    accel_std: float = 0.05,
    features: int = 40,
    length_s: float = 2.0,
    config: ZeroVelocityConfig = CONFIG,
    noise_px: float = 0.15,
) -> tuple[list[bool], StandstillDetector]:
    """What the detector says frame by frame of noisy features that move together."""
    rng = np.random.default_rng(0)
    stamps = np.arange(0.0, length_s + 1e-9, 0.005)
    imu = ImuBuffer()
    gyro = np.array([0.02, -0.01, 0.03]) + rng.normal(0.0, gyro_std, (len(stamps), 3))
    accel = np.array([0.3, 0.2, 9.8]) + rng.normal(0.0, accel_std, (len(stamps), 3))
    imu.add(ImuData(np.round(stamps * 1e9).astype(np.int64), gyro, accel))
    detector, said = StandstillDetector(config), []
    home = rng.uniform(50.0, 400.0, (features, 2))
    for t_s in np.arange(0.0, length_s + 1e-9, FRAME_S).tolist():
        pixels = home + drift_px(t_s) + rng.normal(0.0, noise_px, home.shape)
        seen = FeatureObservations(np.arange(features), pixels, pixels / 400.0)
        stamp_ns = round(t_s * 1e9)
        sigma = detector.add_frame(imu, stamp_ns, FeatureFrame(stamp_ns, (seen,)))
        said.append(sigma is not None)
    return said, detector


def no_drift(_: float) -> FloatArray:
    return np.zeros(2)


def test_still_is_still_once_the_window_is_full() -> None:
    said, detector = decisions(no_drift)
    needed = round(CONFIG.window_s / FRAME_S)
    assert said == [False] * needed + [True] * (len(said) - needed)
    assert detector.since_ns == 0


def test_a_slow_hover_is_not_still() -> None:
    """Two pixels a second are less than the noise from frame to frame, not over the window."""
    said, detector = decisions(lambda t_s: np.array([2.0 * t_s, 0.5 * t_s]))
    assert not any(said)
    assert detector.since_ns is None


@pytest.mark.parametrize("noise_px", [0.05, 0.5, 1.0, 2.0])
def test_the_limit_follows_the_noise_of_the_tracks(noise_px: float) -> None:
    """Noise is no motion, and does not hide motion: 1 px of noise is 1.7 px between two frames."""
    features = 150
    said, detector = decisions(no_drift, features=features, noise_px=noise_px)
    assert detector.noise_px == pytest.approx(noise_px, rel=0.1)
    assert all(said[round(CONFIG.window_s / FRAME_S) :])
    assert len(detector.dynamic) <= 0.02 * features
    drifting, _ = decisions(
        lambda t_s: np.array([max(2.0, 1.5 * noise_px) * t_s, 0.5 * t_s]),
        features=features,
        noise_px=noise_px,
    )
    assert not any(drifting)


def test_running_motors_may_shake_a_platform_on_the_ground() -> None:
    said, _ = decisions(no_drift, gyro_std=0.1, accel_std=1.5)
    assert all(said[round(CONFIG.window_s / FRAME_S) :])


@pytest.mark.parametrize(("gyro_std", "accel_std"), [(0.5, 0.05), (0.01, 4.0)])
def test_a_hard_shake_is_not_still(gyro_std: float, accel_std: float) -> None:
    """The images alone do not decide: they may show the inside of what moves."""
    said, _ = decisions(no_drift, gyro_std=gyro_std, accel_std=accel_std)
    assert not any(said)


def test_a_sudden_start_ends_it_and_it_begins_anew() -> None:
    def jump(t_s: float) -> FloatArray:
        return np.array([4.0 if t_s > 1.0 else 0.0, 0.0])

    said, detector = decisions(jump, length_s=2.5)
    jumped = round(1.0 / FRAME_S) + 1
    full = round(CONFIG.window_s / FRAME_S)
    assert all(said[full:jumped])
    assert not any(said[jumped : jumped + full - 1])
    assert all(said[jumped + full :])
    assert detector.since_ns is not None
    assert detector.since_ns >= 1_000_000_000


@pytest.mark.parametrize("features", [0, 4])
def test_too_few_features_are_no_evidence(features: int) -> None:
    assert not any(decisions(no_drift, features=features)[0])


def test_it_can_be_switched_off() -> None:
    assert not any(decisions(no_drift, config=ZeroVelocityConfig(enabled=False))[0])


def test_without_imu_there_is_no_evidence() -> None:
    seen = FeatureObservations(np.arange(20), np.ones((20, 2)), np.ones((20, 2)))
    detector = StandstillDetector(CONFIG)
    stamps = [round(t_s * 1e9) for t_s in np.arange(0.0, 2.0, 0.1).tolist()]
    said = [detector.add_frame(ImuBuffer(), t, FeatureFrame(t, (seen,))) for t in stamps]
    assert said == [None] * len(stamps)


def test_samples_that_have_ended_are_no_evidence() -> None:
    """What is held of the last one does not change, though the platform moves."""
    stamps_s = np.arange(0.0, 1.0, 0.005)
    rng = np.random.default_rng(2)
    gyro, accel = (rng.normal(0.0, sigma, (len(stamps_s), 3)) for sigma in (1.5, 4.0))
    imu = ImuBuffer()
    imu.add(ImuData(np.round(stamps_s * 1e9).astype(np.int64), gyro, accel))
    seen = FeatureObservations(np.arange(20), np.ones((20, 2)), np.ones((20, 2)))
    detector = StandstillDetector(CONFIG)
    stamps = [round(t_s * 1e9) for t_s in np.arange(0.0, 4.0, 0.1).tolist()]
    said = [detector.add_frame(imu, t, FeatureFrame(t, (seen,))) for t in stamps]
    assert said == [None] * len(stamps)


@pytest.mark.parametrize(("accel_mps2", "since_s"), [(0.0, 0.0), (0.2, 0.08), (0.1, 0.15)])
def test_a_velocity_that_the_imu_has_gained_is_not_taken_for_zero(
    accel_mps2: float, since_s: float
) -> None:
    """The first frames of a take-off pass the limits; their velocity is within its sigma."""
    stamps_s = np.arange(0.0, 1.5, 0.005)
    rng = np.random.default_rng(1)
    accel = np.array([0.3, 0.2, 9.8]) + rng.normal(0.0, 0.02, (len(stamps_s), 3))
    accel[stamps_s > stamps_s[-1] - since_s, 0] += accel_mps2
    imu = ImuBuffer()
    imu.add(ImuData(np.round(stamps_s * 1e9).astype(np.int64), 0.0 * accel, accel))
    detector, home = StandstillDetector(CONFIG), rng.uniform(50.0, 400.0, (40, 2))
    for stamp_s in stamps_s[::10].tolist() + stamps_s[-1:].tolist():
        pixels = home + rng.normal(0.0, 0.5, home.shape)
        seen = FeatureObservations(np.arange(40), pixels, pixels / 400.0)
        stamp_ns = round(stamp_s * 1e9)
        sigma = detector.add_frame(imu, stamp_ns, FeatureFrame(stamp_ns, (seen,)))
        assert (sigma is not None) == (detector.since_ns is not None)
    gained = accel_mps2 * since_s
    assert sigma is not None
    assert (sigma > VELOCITY_SIGMA) == (gained > 0.0)
    assert gained < 1.2 * sigma


def test_the_factors_hold_the_pose_and_stop_the_velocity() -> None:
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0]))
    values = gtsam.Values()
    for i in (3, 4):
        values.insert(X(i), pose)
        values.insert(V(i), np.zeros(3))
    factors, looser = (zero_velocity_factors(3, 4, k * VELOCITY_SIGMA) for k in (1.0, 2.0))
    assert sum(f.error(values) for f in factors) == 0.0
    values.update(V(4), np.array([VELOCITY_SIGMA, 0.0, 0.0]))
    assert sum(f.error(values) for f in factors) == pytest.approx(0.5)
    assert sum(f.error(values) for f in looser) == pytest.approx(0.125)
    values.update(X(4), pose.retract(np.array([0, 0, 0, 0, POSITION_SIGMA, 0.0])))
    assert sum(f.error(values) for f in factors) == pytest.approx(1.0)


# --- the estimator at rest ------------------------------------------------------------------------


def distance_m(trajectory: Trajectory) -> float:
    """Largest distance from the first position."""
    return float(np.max(np.linalg.norm(trajectory.positions - trajectory.positions[0], axis=1)))


@pytest.mark.parametrize("cameras", [slow(1), 2])
def test_a_platform_at_rest_stays_within_millimetres(cameras: int) -> None:
    """Ten seconds after the start, with the noise and biases of a real IMU."""
    rng, mounted = np.random.default_rng(3), rig(cameras)
    estimator = Estimator(mounted, load_config().algorithm, BackendConfig())
    history = StateHistory()
    state = None
    for packet in packets(AT_REST, mounted, room(150, rng), 12.0, rng, 20.0, 0.2):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is not None:
            history.append(state)
            assert state.covariance is not None
            assert np.all(np.linalg.eigvalsh(state.covariance) > 0)
    trajectory = history.trajectory()
    assert trajectory.stamps_ns[-1] - trajectory.stamps_ns[0] > 10_000_000_000
    assert distance_m(trajectory) < 2.4e-4
    assert state is not None
    assert np.linalg.norm(state.velocity) < 2e-3
    tilt = state.world_T_body.rotation().matrix()[2]
    truth = AT_REST.rotation(np.zeros(1)).as_matrix()[0][2]
    np.testing.assert_allclose(tilt, truth, atol=0.02)


def test_the_first_seconds_of_the_wheel_are_at_rest() -> None:
    """By its ground truth the platform is rocked by 3 mm there."""
    result = run(open_dataset("demo"), load_config(duration_s=4.8))
    trajectory = result.trajectory
    assert trajectory.stamps_ns[-1] - trajectory.stamps_ns[0] > 2_000_000_000
    assert distance_m(trajectory) < 3.7e-3


@pytest.mark.data
@pytest.mark.parametrize("cameras", [1, 2])
def test_real_images_before_take_off(data_dir: Path, cameras: int) -> None:
    """The motors start up and shake the picture by more than a pixel."""
    sequence = open_dataset(data_dir / "euroc" / "V1_01_easy_static_2s", cameras=cameras)
    config = load_config(overrides=["backend.zero_velocity.max_disparity_px=1.5"])
    result = run(sequence, config)
    assert result.status == "ok"
    trajectory = result.trajectory
    assert trajectory.stamps_ns[-1] - trajectory.stamps_ns[0] >= 1_000_000_000
    assert distance_m(trajectory) < 1.5e-3
    assert trajectory.velocities is not None
    assert np.linalg.norm(trajectory.velocities, axis=1).max() < 0.01


@pytest.mark.parametrize("algorithm", ["msckf", slow("swf"), slow("okvis"), slow("ekf")])
def test_a_stop_during_a_flight_loses_nothing(algorithm: str) -> None:
    """Whatever knows the past, prior or features: a stop of three seconds moves no estimate.

    Simulated figures of eight with stops of four seconds, with one pixel of noise.
    """
    flight = {"hover_s": 4.0, "hover_every_s": 6.0}
    sequence = simulate(
        duration_s=14.0, rate_hz=10.0, seed=7, cameras=2, flight=flight, tracks={"features": 60}
    )
    result = run(
        sequence, load_config(algorithm=algorithm, overrides=["final_ba.enabled=false", BELIEVED])
    )
    truth, history = sequence.groundtruth(), result.history
    assert truth is not None
    assert truth.velocities is not None
    trajectory = history.trajectory()
    rows = np.searchsorted(truth.stamps_ns, trajectory.stamps_ns)
    error = np.linalg.norm(trajectory.positions - truth.positions[rows], axis=1)
    sigma = np.sqrt(np.trace(history.pose_covariances()[:, 3:, 3:], axis1=1, axis2=2))
    seconds = (trajectory.stamps_ns - truth.stamps_ns[0]) * 1e-9
    stopped = (np.linalg.norm(truth.velocities[rows], axis=1) < 1e-6) & (seconds > 8.0)
    assert np.sum(stopped) > 30, "three seconds"
    before = int(np.flatnonzero(stopped)[0]) - 1
    assert np.max(error[stopped]) < error[before] + 0.01
    assert np.max(sigma[stopped]) < 1.5 * sigma[before] + 0.01


def test_frames_that_may_stand_are_found_without_looking_at_each() -> None:
    """None is left out for which the detector finds standstill, and those in motion are."""
    config, features = ZeroVelocityConfig(), 40
    times_s = np.arange(0.0, 8.0, FRAME_S)
    moved_px = 60.0 * np.clip(times_s - 2.0, 0.0, 3.0)  # still, in motion for 3 s, still
    rng = np.random.default_rng(0)
    home = rng.uniform(50.0, 400.0, (features, 2))
    pixels = home + moved_px[:, None, None] + rng.normal(0.0, 0.3, (len(times_s), features, 2))
    stamps_ns = np.round(times_s * 1e9).astype(np.int64)
    imu = ImuBuffer()
    samples_ns = np.arange(-1_000_000_000, 9_000_000_000, 5_000_000)
    accel = np.tile([0.0, 0.0, 9.8], (len(samples_ns), 1)) + rng.normal(
        0.0, 0.05, (len(samples_ns), 3)
    )
    imu.add(ImuData(samples_ns, rng.normal(0.0, 0.01, accel.shape), accel))
    detector = StandstillDetector(config)
    still = []
    for stamp_ns, seen in zip(stamps_ns.tolist(), pixels, strict=True):
        observed = FeatureObservations(np.arange(features), seen, seen / 400.0)
        frame = FeatureFrame(stamp_ns, (observed,))
        still.append(detector.add_frame(imu, stamp_ns, frame) is not None)
    frames = np.repeat(np.arange(len(times_s)), features)
    ids = np.tile(np.arange(features), len(times_s))
    may = StandstillDetector(config).may_stand(stamps_ns, frames, ids, pixels.reshape(-1, 2))
    assert np.any(still)
    assert np.all(may[still])
    in_motion = (times_s > 2.5) & (times_s < 5.0)
    assert not may[in_motion].any()
    assert not may[times_s < config.window_s - 1e-9].any()
