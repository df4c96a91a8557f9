# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The start in motion: gyroscope bias, alignment, and the whole on real images."""

from pathlib import Path

import numpy as np
import pytest
from flight import GRAVITY, Flight, features, packets, rig, room, scene
from scipy.stats import chi2

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig, NoiseConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.batch_cost import BatchCost
from slam_graph.backend.initialization.dynamic_start import (
    StartFrames,
    StartGuess,
    guess_states,
)
from slam_graph.backend.initialization.gyroscope_bias import BearingPairs, estimate_gyro_bias
from slam_graph.backend.initialization.inertial_motion import Intervals, Motion
from slam_graph.backend.initialization.initializer import FRAME_SPACING_S
from slam_graph.backend.initialization.start_consensus import random_samples, static_features
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.initialization.visual_inertial_alignment import (
    AlignmentEquations,
    Sightings,
    align,
)
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.frontend.frontend_protocol import build_frontend
from slam_graph.geometry.trajectory import NavState, Trajectory, interpolate
from slam_graph.sensors import Rig
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import (
    CameraFrame,
    FeatureFrame,
    FeatureObservations,
    ImuData,
)

TIMES = np.linspace(0.0, 1.5, 11)
MOTION = BackendConfig(initialization=InitializationConfig(mode="motion"))


def exact_motion(flight: Flight, times_s: FloatArray) -> Motion:
    """The inertial motion from the first body, without any integration."""
    R = flight.rotation(times_s)
    first = R[0].inv()
    t = times_s[:, None] - times_s[0]
    p, v = flight.positions(times_s), flight.velocities(times_s)
    return Motion(
        t[:, 0],
        (first * R).as_matrix(),
        first.apply(p - p[0] - v[0] * t - 0.5 * GRAVITY * t**2),
        first.apply(v - v[0] - GRAVITY * t),
    )


def equations_of(obs: Observations, motion: Motion, mounted: Rig) -> AlignmentEquations:
    """The equations of the alignment for one motion."""
    return Sightings(obs, RigProjection(mounted)).equations(motion)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("start_s", [0.0, 1.0, 7.0])
def test_alignment_is_exact_without_noise(cameras: int, start_s: float) -> None:
    flight, mounted, times = Flight(), rig(cameras), start_s + TIMES
    obs, _ = scene(flight, mounted, room(200, np.random.default_rng(0)), times, min_frames=4)
    motion = exact_motion(flight, times)
    found = align(equations_of(obs, motion, mounted), 9.81)
    assert found is not None
    first = flight.rotation(times[:1]).inv()
    np.testing.assert_allclose(
        found.velocity, first.apply(flight.velocities(times[:1]))[0], atol=1e-6
    )
    np.testing.assert_allclose(found.gravity, first.apply(GRAVITY)[0], atol=1e-6)
    p, v = flight.positions(times), flight.velocities(times)
    np.testing.assert_allclose(found.positions(motion), first.apply(p - p[0]), atol=1e-6)
    np.testing.assert_allclose(found.velocities(motion), first.apply(v), atol=1e-6)


@pytest.mark.parametrize("cameras", [1, 2])
def test_alignment_bears_pixel_noise(cameras: int) -> None:
    rng, flight, mounted = np.random.default_rng(1), Flight(), rig(cameras)
    obs, _ = scene(flight, mounted, room(300, rng), TIMES, rng, 0.5, min_frames=4)
    found = align(equations_of(obs, exact_motion(flight, TIMES), mounted), 9.81)
    assert found is not None
    first = flight.rotation(TIMES[:1]).inv()
    velocity = first.apply(flight.velocities(TIMES[:1]))[0]
    np.testing.assert_allclose(found.velocity, velocity, atol=0.05)
    np.testing.assert_allclose(found.gravity, first.apply(GRAVITY)[0], atol=0.2)
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("dynamic", [60, 130])
def test_the_imu_tells_the_static_world_from_an_object(cameras: int, dynamic: int) -> None:
    """Even where most features are on the object, which moves as the room of another flight."""
    rng, mounted, window = np.random.default_rng(5), rig(cameras), FeatureTracks()
    flight, other = Flight(), Flight(position_rate=np.array([2.5, -1.2, 1.6]))
    still, moving = room(400, rng), room(dynamic * 4, rng)
    for number, t_s in enumerate(TIMES.tolist()):
        seen = features(flight, mounted, still, t_s, rng, 0.5)
        object_seen = features(other, mounted, moving, t_s, rng, 0.5)
        cameras_seen = (
            FeatureObservations(
                np.concatenate([a.ids, b.ids + len(still)]),
                np.concatenate([a.pixels, b.pixels]),
                np.concatenate([a.normalized, b.normalized]),
            )
            for a, b in zip(seen.cameras, object_seen.cameras, strict=True)
        )
        window.add(number, FeatureFrame(seen.stamp_ns, tuple(cameras_seen)))
    ids, lengths = window.lengths()
    obs = window.observations(ids[lengths >= 4])
    motion = exact_motion(flight, TIMES)
    static = static_features(equations_of(obs, motion, mounted), 9.81, 3.0 / 458.0, rng)
    true = obs.ids < len(still)
    assert (np.sum(~true) > np.sum(true)) == (dynamic > 100)
    assert np.mean(static[true]) > 0.95
    assert np.mean(static[~true]) < 0.05


@pytest.mark.parametrize("count", [3, 4, 7])
def test_samples_have_different_features_all_equally_likely(count: int) -> None:
    rng, size = np.random.default_rng(0), min(4, count)
    samples = np.concatenate([random_samples(count, rng) for _ in range(20)])
    assert np.all(samples.sum(axis=1) == size)
    spread = np.sqrt(size / count * (1.0 - size / count) / len(samples))
    assert np.all(np.abs(samples.mean(axis=0) - size / count) <= 4.0 * spread)


@pytest.mark.parametrize("count", [3, 4, 5, 40, 150])
def test_samples_are_those_that_numpy_chooses_one_by_one(count: int) -> None:
    ours, theirs = (np.random.default_rng(count) for _ in range(2))
    samples = random_samples(count, ours)
    for sample in samples:
        chosen = theirs.choice(count, min(4, count), replace=False)
        assert set(np.flatnonzero(sample)) == set(chosen.tolist())
    assert ours.random() == theirs.random()


def window_of(
    flight: Flight, points: FloatArray, cameras: int, rng: np.random.Generator | None
) -> tuple[StartFrames, ImuBuffer]:
    """A start window, with the noise of a tracker and an IMU where `rng` is given."""
    mounted, imu = rig(cameras), ImuBuffer()
    stamps, frames = [], []
    for packet in packets(flight, mounted, points, 1.5, rng, 1.0 / FRAME_SPACING_S, 0.2):
        assert isinstance(packet.frame, FeatureFrame)
        imu.add(packet.imu)
        stamps.append(packet.frame.stamp_ns)
        frames.append(packet.frame)
    return StartFrames(stamps, frames), imu


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_gyro_bias_from_images(cameras: int, seed: int) -> None:
    """Exact without noise, and within 5 mrad/s with that of a tracker."""
    rng = np.random.default_rng(seed)
    bias = rng.uniform(-0.1, 0.1, 3)
    flight, points = Flight(gyro_bias=bias), room(600, rng)
    for noise, tolerance in ((None, 1e-4), (rng, 5e-3)):
        window, imu = window_of(flight, points, cameras, noise)
        intervals = Intervals(window.imu_between(imu))
        pairs = BearingPairs.between(window.frames, RigProjection(rig(cameras)))
        found = estimate_gyro_bias(pairs, intervals)
        assert found is not None
        np.testing.assert_allclose(found, bias, atol=tolerance)


def test_gyro_bias_needs_features_in_common() -> None:
    rng = np.random.default_rng(0)
    window, imu = window_of(Flight(), room(6, rng), 1, rng)
    intervals = Intervals(window.imu_between(imu))
    pairs = BearingPairs.between(window.frames, RigProjection(rig()))
    assert estimate_gyro_bias(pairs, intervals) is None


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_guess_of_all_states(cameras: int) -> None:
    """World upright, origin and heading at the first body."""
    rng, flight = np.random.default_rng(4), Flight(gyro_bias=np.array([0.03, -0.02, 0.05]))
    window, imu = window_of(flight, room(600, rng), cameras, rng)
    found = guess_states(window, imu, RigProjection(rig(cameras)), NoiseConfig(), rng)
    assert isinstance(found, StartGuess)
    guess = found.states
    assert [s.stamp_ns for s in guess] == window.stamps_ns
    truth = [flight.nav_state(stamp * 1e-9) for stamp in window.stamps_ns]
    origin = guess[0].world_T_body
    np.testing.assert_allclose(origin.translation(), 0.0, atol=1e-9)
    assert abs(origin.rotation().yaw()) < 1e-9
    for found, true in zip(guess, truth, strict=True):
        between = truth[0].world_T_body.between(true.world_T_body)
        ours = origin.between(found.world_T_body)
        np.testing.assert_allclose(ours.translation(), between.translation(), atol=0.1)
        np.testing.assert_allclose(body_velocity(found), body_velocity(true), atol=0.15)
        up = true.world_T_body.rotation().matrix()[2]
        np.testing.assert_allclose(found.world_T_body.rotation().matrix()[2], up, atol=0.03)


def test_a_guess_says_what_it_lacks() -> None:
    rng = np.random.default_rng(0)
    mounted = RigProjection(rig())
    few, imu = window_of(Flight(), room(6, rng), 1, rng)
    reason = guess_states(few, imu, mounted, NoiseConfig(), rng)
    assert isinstance(reason, Refusal)
    assert "features" in reason.needs


def test_a_window_is_thinned_from_its_end() -> None:
    stamps = [50_000_000 * k for k in range(21)]
    frames = [FeatureFrame(t, ()) for t in stamps]
    thin = StartFrames.thinned(stamps, frames, 0.15)
    assert thin.stamps_ns[-1] == stamps[-1]
    assert set(np.diff(thin.stamps_ns)) == {150_000_000}
    assert [f.stamp_ns for f in thin.frames] == thin.stamps_ns


def body_velocity(state: NavState) -> FloatArray:
    """Velocity in the body frame, which does not depend on where the world begins."""
    return np.asarray(state.world_T_body.rotation().unrotate(state.velocity))


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", range(2))
def test_a_simulated_flight_starts_in_motion(cameras: int, seed: int) -> None:
    """As soon as the window is full, and no more certain than it is right."""
    rng, mounted = np.random.default_rng(seed), rig(cameras)
    flight = Flight(gyro_bias=np.array([0.03, -0.02, 0.05]), accel_bias=np.array([0.05, 0.1, -0.1]))
    estimator = Estimator(mounted, load_config().algorithm, MOTION)
    state = None
    for packet in packets(flight, mounted, room(600, rng), 3.0, rng, 20.0):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame)
        if state is not None:
            break
    assert state is not None, estimator.waiting_for
    assert state.covariance is not None
    assert state.stamp_ns < 2_000_000_000
    truth = flight.nav_state(state.stamp_ns * 1e-9)
    assert np.linalg.norm(body_velocity(state) - body_velocity(truth)) < 0.039
    np.testing.assert_allclose(state.gyro_bias, flight.gyro_bias, atol=5e-3)
    assert tilt_rad(state, truth) < 0.0205
    biases = np.concatenate([state.accel_bias, state.gyro_bias])
    error = biases - np.concatenate([flight.accel_bias, flight.gyro_bias])
    assert error @ np.linalg.solve(state.covariance[9:, 9:], error) < chi2.ppf(0.999, 6)


@pytest.mark.parametrize("shift_ns", [-30_000_000_000, 1_800_000_000_000_000_000])
def test_times_count_from_anywhere(shift_ns: int) -> None:
    """A recorder may stamp by the time of day, or by the time since a trigger that came late."""
    mounted, runs = rig(2), []
    for shift in (0, shift_ns):
        rng = np.random.default_rng(0)
        estimator = Estimator(mounted, load_config().algorithm, MOTION)
        states: list[NavState] = []
        for packet in packets(Flight(), mounted, room(600, rng), 3.0, rng, 20.0):
            assert isinstance(packet.frame, FeatureFrame)
            imu, frame = packet.imu, packet.frame
            estimator.add_imu(ImuData(imu.stamps_ns + shift, imu.gyro, imu.accel))
            estimator.add_frame(FeatureFrame(frame.stamp_ns + shift, frame.cameras))
            states += estimator.states
        runs.append(states)
    assert len(runs[0]) > 20
    assert [s.stamp_ns for s in runs[1]] == [s.stamp_ns + shift_ns for s in runs[0]]
    found, expected = (np.array([s.world_T_body.translation() for s in states]) for states in runs)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_step_of_the_refinement_knows_its_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without projecting again what it chose its features by."""
    values: list[tuple[float, float]] = []
    value, squared = BatchCost.value, BatchCost.squared_errors
    projected: list[int] = []

    def both(cost: BatchCost, *given: object) -> float:
        count = len(projected)
        known = value(cost, *given)
        if given[0] is None and len(projected) == count:
            values.append((known, value(cost, *given)))
        return known

    def counted(cost: BatchCost, *given: object) -> FloatArray:
        projected.append(1)
        return squared(cost, *given)

    monkeypatch.setattr(BatchCost, "value", both)
    monkeypatch.setattr(BatchCost, "squared_errors", counted)
    rng, flight = np.random.default_rng(0), Flight()
    estimator = Estimator(rig(), load_config().algorithm, MOTION)
    for packet in packets(flight, rig(), room(600, rng), 2.0, rng, 20.0):
        estimator.add_imu(packet.imu)
        if estimator.add_frame(packet.frame) is not None:
            break
    assert len(values) > 2
    assert all(known == anew for known, anew in values)


def tilt_rad(a: NavState, b: NavState) -> float:
    """Angle between what two states take for up."""
    up_a, up_b = (s.world_T_body.rotation().matrix()[2] for s in (a, b))
    return float(np.linalg.norm(np.cross(up_a, up_b)))


# --- real images ----------------------------------------------------------------------------------


def true_body_velocity(truth: Trajectory, stamp_ns: int) -> FloatArray:
    """From positions 40 ms apart, in the body frame."""
    half = 20_000_000
    near, valid = interpolate(truth, np.array([stamp_ns - half, stamp_ns, stamp_ns + half]))
    assert valid.all()
    velocity = (near.positions[2] - near.positions[0]) / (2e-9 * half)
    return np.asarray(near.pose(1).rotation().unrotate(velocity))


@pytest.mark.data
@pytest.mark.parametrize("cameras", [1, 2], ids=["mono", "stereo"])
def test_real_images_start_in_motion_within_three_seconds(data_dir: Path, cameras: int) -> None:
    sequence = open_dataset(data_dir / "euroc" / "MH_01_easy_17s", cameras=cameras)
    frontend = build_frontend(sequence.rig)
    estimator = Estimator(sequence.rig, load_config().algorithm, BackendConfig())
    truth = sequence.groundtruth()
    assert truth is not None
    start_ns, state = sequence.info().start_ns, None
    for packet in sequence.packets(end_ns=start_ns + 3_000_000_000):
        assert isinstance(packet.frame, CameraFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(frontend.track(packet.frame))
        if state is not None:
            break
    assert state is not None, estimator.waiting_for
    velocity = true_body_velocity(truth, state.stamp_ns)
    assert np.linalg.norm(body_velocity(state) - velocity) < 0.01
    near, _ = interpolate(truth, np.array([state.stamp_ns]))
    up = near.pose(0).rotation().matrix()[2]
    tilt = np.degrees(np.arccos(up @ state.world_T_body.rotation().matrix()[2]))
    assert tilt < 1.5
