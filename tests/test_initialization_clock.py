# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Clock and mounting of a camera, from its rotations and the gyroscope, within the start."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml
from flight import Flight, features, packets, rig, room
from groups import slow
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, InitializationConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.initialization.clock_monitor import ClockMonitor
from slam_graph.backend.initialization.gyro_alignment import (
    GyroAlignment,
    Turns,
    align_gyroscope,
    rotation_vectors,
)
from slam_graph.backend.initialization.start_calibration import FoundCalibration, StartCalibration
from slam_graph.backend.initialization.visual_rotation import visual_rotation
from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import (
    kalibr_text,
    read_kalibr,
    write_kalibr,
)
from slam_graph.geometry.trajectory import NavState
from slam_graph.kernels.epipolar_rotation_numpy import _Pair, _tangent
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData, Packet
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulation_config import FlightConfig, SimulationConfig
from slam_graph.simulation.simulator import simulate


def camera_rotation(start_s: float, end_s: float) -> FloatArray:
    """True rotation (3, 3) of the camera from the later time to the earlier one."""
    C = rig().cameras[0].body_T_camera.rotation().matrix()
    one, two = Flight().rotation(np.array([start_s, end_s])).as_matrix()
    return np.asarray(C.T @ one.T @ two @ C)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 2.0, 3.1])
def test_rotation_vectors_are_those_of_scipy(size: float) -> None:
    axes = np.random.default_rng(2).normal(size=(2, 4, 3))
    vectors = size * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    R = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(2, 4, 3, 3)
    np.testing.assert_allclose(rotation_vectors(R), vectors, rtol=0.0, atol=1e-13)


def test_visual_rotation_is_exact_without_noise() -> None:
    points = room(400, np.random.default_rng(0))
    for t in (0.0, 1.0, 2.0, 3.0):
        one, two = (features(Flight(), rig(), points, t + s).cameras[0] for s in (0.0, 0.3))
        found = visual_rotation(one, two, rig().cameras[0].camera, 1.0, None)
        assert found is not None
        np.testing.assert_allclose(found.R, camera_rotation(t, t + 0.3), atol=2e-5)


def test_visual_rotation_outvotes_wrong_matches() -> None:
    """A few pairs of views have a second solution within the noise; the others are near."""
    rng, camera = np.random.default_rng(3), rig().cameras[0].camera
    points, away = room(400, rng), []
    for t in np.arange(0.0, 12.0, 0.5):
        one, two = (features(Flight(), rig(), points, t + s, rng, 0.3).cameras[0] for s in (0, 0.4))
        wrong = two.normalized.copy()
        wrong[: len(wrong) // 20] = rng.permutation(wrong)[: len(wrong) // 20]
        found = visual_rotation(one, replace(two, normalized=wrong), camera, 0.3, None)
        if found is None:
            away.append(np.inf)
            continue
        turn = Rotation.from_matrix(camera_rotation(t, t + 0.4).T @ found.R).as_rotvec()
        away.append(float(np.linalg.norm(turn)))
    assert np.median(away) < np.deg2rad(0.7)
    assert np.mean(np.array(away) < np.deg2rad(1.5)) > 0.75


def test_derivatives_of_the_epipolar_error_are_the_numerical_ones() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, 20, 3))
    first, second = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (first, second))
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.6, 0.0, 0.8])
    variances, step = np.full((20, 2), 1e-6), 1e-6
    pair = _Pair(first, second, variances, R)
    e, J, across = pair.residuals(t)[0], pair.jacobian(t), _tangent(t)
    np.testing.assert_allclose(across @ np.column_stack([across.T, t]), np.eye(3)[:2], atol=1e-15)
    for column in range(5):
        delta = step * np.eye(5)[column]
        turned = R @ Rotation.from_rotvec(delta[:3]).as_matrix()
        moved, _ = _Pair(first, second, variances, turned).residuals(t + delta[3:] @ across)
        np.testing.assert_allclose((moved - e) / step, J[column], atol=1e-5)


def turns(offset_s: float, noise_rad: float, seconds: float = 3.0) -> Turns:
    """True rotations of the camera with noise, stamped by a clock that is off."""
    rng = np.random.default_rng(5)
    start = 1.0 + np.arange(0.0, seconds, 0.05)
    R = np.array([camera_rotation(t, t + 0.4) for t in start])
    R = R @ Rotation.from_rotvec(rng.normal(0.0, noise_rad, (len(R), 3))).as_matrix()
    stamps = [np.round(1e9 * (t - offset_s)).astype(np.int64) for t in (start, start + 0.4)]
    information = np.broadcast_to(np.eye(3) / max(noise_rad, 1e-4) ** 2, R.shape)
    return Turns(stamps[0], stamps[1], R, information)


@pytest.mark.parametrize("offset_s", [-0.1, -0.01, 0.0, 0.055, 0.1])
@pytest.mark.parametrize("mounted", [True, False])
def test_offset_bias_and_mounting_are_found_together(offset_s: float, mounted: bool) -> None:
    flight = replace(Flight(), gyro_bias=np.array([0.02, -0.03, 0.01]))
    C = rig().cameras[0].body_T_camera.rotation().matrix()
    found = align_gyroscope(
        turns(offset_s, 1e-4), flight.imu(0.5, 5.0), C if mounted else None, 0.0
    )
    assert found is not None
    assert abs(found.offset_s - offset_s) < 2e-4
    assert np.linalg.norm(found.gyro_bias - flight.gyro_bias) < 2e-3
    assert np.arccos((np.trace(C.T @ found.body_R_camera) - 1) / 2) < np.deg2rad(0.2)
    assert found.margin > 100.0


def test_sigma_of_the_offset_covers_its_error() -> None:
    C = rig().cameras[0].body_T_camera.rotation().matrix()
    found = align_gyroscope(turns(0.03, 3e-3), Flight().imu(0.5, 5.0), C, 0.0)
    assert found is not None
    assert abs(found.offset_s - 0.03) < 3 * found.offset_sigma_s < 0.01


def test_rotations_at_rest_do_not_make_the_others_more_certain() -> None:
    flight, C = Flight(), rig().cameras[0].body_T_camera.rotation().matrix()
    moving, imu = turns(0.03, 3e-3), flight.imu(0.5, 5.0)
    alone = align_gyroscope(moving, imu, C, 0.0)
    before_ns, noise = imu.stamps_ns[-1] - imu.stamps_ns[0] + 10_000_000, np.full((120, 3), 1e-4)
    still = ImuData(imu.stamps_ns - before_ns, 0.0 * imu.gyro + flight.gyro_bias, 0.0 * imu.accel)
    first_ns = still.stamps_ns[0] + 300_000_000 + 20_000_000 * np.arange(len(noise))
    with_rest = Turns(
        np.concatenate([first_ns, moving.first_ns]),
        np.concatenate([first_ns + 400_000_000, moving.second_ns]),
        np.concatenate([Rotation.from_rotvec(noise).as_matrix(), moving.R]),
        np.concatenate([np.repeat(moving.information[:1], len(noise), 0), moving.information]),
    )
    found = align_gyroscope(with_rest, ImuData.concatenate([still, imu]), C, 0.0)
    assert alone is not None
    assert found is not None
    assert found.misfit == pytest.approx(alone.misfit, rel=0.2)
    assert found.offset_sigma_s == pytest.approx(alone.offset_sigma_s, rel=0.2)


def test_a_first_estimate_that_was_wrong_is_no_earlier_clock() -> None:
    """One of 34.2 ± 4.1 ms, soon after a standstill, where the calibration is right."""
    monitor, covered = ClockMonitor(rig().cameras[0]), (turns(0.0, 1e-3), Flight().imu(0.5, 5.0))
    for offset_s, sigma_s in ((0.0342, 4.1e-3), (0.002, 2.5e-3), (-0.0006, 1.1e-3)):
        found = GyroAlignment(offset_s, sigma_s, 100.0, np.zeros(3), np.eye(3), 0.0, 1.0)
        assert monitor.compare(found, covered, ImuBuffer()) is None
    assert monitor.knows


def recorded(
    offset_s: float, cameras: int, seconds: float, seed: int = 2, points: int = 300
) -> list[Packet]:
    """A flight; no frame comes with a later IMU sample than its own stamp."""
    rng = np.random.default_rng(seed)
    whole = list(packets(Flight(), rig(cameras), 0.5 * room(points, rng), seconds, rng, 20.0))
    imu = ImuData.concatenate([packet.imu for packet in whole])
    late_ns, begin, found = round(offset_s * 1e9), 0, []
    for packet in whole:
        stamp_ns = packet.frame.stamp_ns - late_ns
        end = max(begin, int(np.searchsorted(imu.stamps_ns, stamp_ns, side="right")))
        assert isinstance(packet.frame, FeatureFrame)
        found.append(Packet(imu[begin:end], FeatureFrame(stamp_ns, packet.frame.cameras)))
        begin = end
    return found


def estimate(
    stream: list[Packet], mounted: Rig, check: bool = True, name: str = "msckf"
) -> tuple[Estimator, list[NavState]]:
    """The estimator and its states, those that were superseded left out."""
    initialization = InitializationConfig(mode="motion", check_calibration=check)
    config = BackendConfig(initialization=initialization)
    estimator = Estimator(mounted, load_config(algorithm=name).algorithm, config)
    states: list[NavState] = []
    for packet in stream:
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        states = (states if estimator.replayed is None else []) + estimator.states
    return estimator, states + estimator.finish()


def errors_of(states: list[NavState]) -> FloatArray:
    """Errors (N,) of the distance from the first state, m; heading and origin are free."""
    t = np.array([state.stamp_ns for state in states]) * 1e-9
    truth = Flight().positions(t)
    ours = np.array([state.world_T_body.translation() for state in states])
    lengths = [np.linalg.norm(p - p[0], axis=1) for p in (ours, truth)]
    return np.asarray(np.abs(lengths[0] - lengths[1]))


@pytest.mark.parametrize("cameras", [slow(1), 2])
@pytest.mark.parametrize("offset_s", [slow(-0.1), 0.055])
def test_an_unknown_offset_is_found_in_the_start(offset_s: float, cameras: int) -> None:
    stream = recorded(offset_s, cameras, 6.0)
    estimator, states = estimate(stream, rig(cameras))
    assert estimator.diagnostics.counts["calibration_corrected"] == 1
    assert estimator.calibration is not None
    assert abs(estimator.calibration.rig.cameras[0].time_offset_s - offset_s) < 1e-3
    stamps_ns = np.array([state.stamp_ns for state in states])
    steps_ns = np.diff(stamps_ns)
    assert np.all(steps_ns > 0)
    assert np.all(steps_ns < 75_000_000), "no frame is lost"
    last_ns = int(stream[-1].frame.stamp_ns + offset_s * 1e9)
    assert abs(last_ns - stamps_ns[-1]) < 75_000_000, "nor is the last one"
    assert errors_of(states).max() < 0.1


@pytest.mark.parametrize("known", [True, False])
def test_features_that_are_known_to_move_do_not_bend_the_clock(known: bool) -> None:
    """Most features are on a body that turns as the world would under a clock 50 ms off."""
    static = np.arange(120)
    check, imu, found = StartCalibration(rig(1), BackendConfig()), ImuBuffer(), []
    for before, packet in pairwise(recorded(0.0, 1, 6.0, points=1500)):
        assert isinstance(packet.frame, FeatureFrame)
        assert isinstance(before.frame, FeatureFrame)
        world, body = packet.frame.only(static).cameras[0], before.frame.without(static).cameras[0]
        seen = FeatureObservations(
            np.concatenate([world.ids, body.ids]),
            np.vstack([world.pixels, body.pixels]),
            np.vstack([world.normalized, body.normalized]),
        )
        imu.add(packet.imu)
        dynamic = body.ids if known else np.zeros(0, np.int64)
        frame = FeatureFrame(packet.frame.stamp_ns, (seen,))
        found.append(check.add(frame, imu, started=True, dynamic=dynamic))
    adopted = [one for one in found if isinstance(one, FoundCalibration)]
    assert bool(adopted) != known
    for one in adopted:
        assert abs(one.rig.cameras[0].time_offset_s + 0.05) < 0.01


@pytest.mark.parametrize("name", ["msckf", slow("okvis")])
def test_a_calibration_that_fits_changes_nothing(name: str) -> None:
    stream = recorded(0.0, 1, 5.0)
    with_check, without = (estimate(stream, rig(), check, name) for check in (True, False))
    assert with_check[0].corrected_rig is None
    assert with_check[0].calibration is None
    for one, other in zip(with_check[1], without[1], strict=True):
        assert one.world_T_body.matrix().tobytes() == other.world_T_body.matrix().tobytes()


@pytest.mark.slow
def test_gtsams_smoothers_take_the_offset_as_it_is() -> None:
    estimator, states = estimate(recorded(0.055, 2, 6.0), rig(2), name="fixed_lag_isam2")
    assert estimator.corrected_rig is not None
    assert abs(estimator.corrected_rig.cameras[0].time_offset_s - 0.055) < 3e-3
    assert len(states) > 30
    assert errors_of(states).max() < 0.3


def test_an_unknown_mounting_is_found_in_the_start() -> None:
    true = rig()
    unknown = replace(true.cameras[0], body_T_camera=gtsam.Pose3(), rotation_known=False)
    estimator, states = estimate(recorded(0.03, 1, 8.0), Rig((unknown,), true.imu))
    assert estimator.calibration is not None
    found = estimator.calibration.rig.cameras[0]
    away = true.cameras[0].body_T_camera.between(found.body_T_camera)
    assert np.linalg.norm(gtsam.Rot3.Logmap(away.rotation())) < np.deg2rad(0.5)
    assert np.linalg.norm(away.translation()) < 0.05
    assert abs(found.time_offset_s - 0.03) < 2e-3
    assert len(states) > 60


def test_an_unknown_mounting_is_waited_for_without_rotation() -> None:
    unknown = replace(rig().cameras[0], rotation_known=False)
    still = Flight(angles=np.zeros(3))
    rng = np.random.default_rng(0)
    estimator = Estimator(Rig((unknown,)), load_config().algorithm)
    for packet in packets(still, rig(), room(150, rng), 4.0, rng):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        assert estimator.add_frame(packet.frame) is None
    assert "mounted" in estimator.waiting_for


def test_an_unknown_mounting_stands_in_the_file(tmp_path: Path) -> None:
    unknown = replace(rig().cameras[0], body_T_camera=gtsam.Pose3(), rotation_known=False)
    write_kalibr(Rig((unknown,)), tmp_path / "phone.yaml")
    assert "T_cam_imu: unknown" in kalibr_text(Rig((unknown,)))
    assert not read_kalibr(tmp_path / "phone.yaml").cameras[0].rotation_known


@pytest.mark.slow
def test_a_phone_with_nothing_but_a_focal_length_runs(tmp_path: Path) -> None:
    sequence = simulate(SimulationConfig(duration_s=14.0, rate_hz=20.0, flight=FlightConfig()))
    sequence.save(tmp_path / "flight")
    true = sequence.rig.cameras[0]
    camera = true.camera
    phone = {
        "cam0": {
            "camera_model": "pinhole",
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": "radtan",
            "distortion_coeffs": list(camera.coefficients),
            "resolution": [camera.width, camera.height],
            "T_cam_imu": "unknown",
        }
    }
    (tmp_path / "phone.yaml").write_text(yaml.safe_dump(phone))
    arguments = ["run", str(tmp_path / "flight"), "--calibration", str(tmp_path / "phone.yaml")]
    arguments += ["--cameras", "mono", "--set", "backend.initialization.mode=auto"]
    arguments += ["--output", str(tmp_path / "out"), "--no-progress", "--json"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert summary["status"] == "ok"
