# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rolling shutters: rows at their own times, in files, simulation, projection and estimates."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np
import pytest
from flight import FISHEYE, RADTAN, Flight, features, rig, room
from groups import slow
from gtsam.symbol_shorthand import L, X
from recordings import edit_text
from test_backend_reprojection import native_factor
from test_window_graph import check

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig
from slam_graph.backend.cost.calibrated_projection import CalibratedProjection
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.row_unrolling import unrolled
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.motion_test import judge_tracks
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.backend.online_calibration import CalibrationVariables, rolling_motion
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.state import FrameMotion, State, dims_of
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.errors import DataError
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.prediction import ImuMotion, PointPredictor
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import simulate

READOUT_S = 0.03
FAST = Flight(angle_rate=np.array([3.8, 2.6, 3.0]))
"""Turns at up to 2.6 rad/s."""

TIMES = np.linspace(0.0, 3.0, 8)
ROLLING = {"seed": 5, "rate_hz": 10.0, "trajectory": "random"}


def rolling(cameras: int = 2, camera: Camera = RADTAN, readout_s: float = READOUT_S) -> Rig:
    plain = rig(cameras, camera)
    mounted = (replace(c, readout_s=readout_s, rolling_shutter=True) for c in plain.cameras)
    return replace(plain, cameras=tuple(mounted))


def ignored(mounted: Rig) -> Rig:
    """The rig with global shutters, and with the time offset of the middle row."""
    cameras = (
        replace(c, readout_s=0.0, time_offset_s=c.time_offset_s + c.middle_s)
        for c in mounted.cameras
    )
    return replace(mounted, cameras=tuple(cameras))


def rows_of(flight: Flight, mounted: Rig, points: FloatArray, t_s: float) -> FeatureFrame:
    """What rolling shutters see, exactly; `t_s` is the time of the middle row."""
    middle_s, cameras = mounted.cameras[0].middle_s, []
    for c in mounted.cameras:
        matrix = c.body_T_camera.matrix()
        seconds = np.zeros(len(points))
        for _ in range(10):
            at = t_s + seconds
            in_body = flight.rotation(at).inv().apply(points - flight.positions(at))
            local = (in_body - matrix[:3, 3]) @ matrix[:3, :3]
            plane = local[:, :2] / np.where(local[:, 2:] > 0.3, local[:, 2:], np.inf)
            pixels = c.camera.distort(plane)[0]
            rows = np.clip(pixels[:, 1], 0.0, c.camera.height)
            seconds = c.row_times_s(rows) - middle_s
        inside = np.all((pixels > 5) & (pixels < (c.camera.width - 5, c.camera.height - 5)), axis=1)
        ids = np.flatnonzero(inside & (local[:, 2] > 0.3) & (np.hypot(*plane.T) < 1.0))
        seen = FeatureObservations(ids, pixels[ids], c.camera.undistort(pixels[ids]))
        cameras.append(seen)
    return FeatureFrame(round((t_s - mounted.pose_offset_s) * 1e9), tuple(cameras))


def seen_by(mounted: Rig, points: FloatArray) -> tuple[Observations, Geometry, State]:
    """Observations without noise, the truth at the poses, and a state that has it."""
    window, state, imu = FeatureTracks(), State(), ImuBuffer()
    imu.add(FAST.imu(-0.1, TIMES[-1] + 0.1))
    for k, t_s in enumerate(TIMES.tolist()):
        frame, nav = rows_of(FAST, mounted, points, t_s), FAST.nav_state(t_s)
        window.add(k, frame)
        state.insert_imu_state(k, nav)
        state.motions[k] = rolling_motion(nav, frame.stamp_ns, imu, mounted)
    ids, lengths = window.lengths()
    obs = window.observations(ids[lengths > 2])
    at = Geometry(FAST.rotation(TIMES).as_matrix(), FAST.positions(TIMES), points[obs.ids])
    return obs, at, state


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda c: c.distortion)
@pytest.mark.parametrize("readout_s", [READOUT_S, -0.02])
def test_rows_are_seen_from_where_the_body_was_then(camera: Camera, readout_s: float) -> None:
    mounted = rolling(2, camera, readout_s)
    obs, at, state = seen_by(mounted, room(400, np.random.default_rng(0)))
    projection = RigProjection(mounted).at(state)
    residuals, depths = projection.residuals(obs, at)
    flat, _ = RigProjection(ignored(mounted)).residuals(obs, at)
    assert len(obs) > 500
    assert depths.min() > 0.2
    # rates are nearly linear over a readout; without rows up to 10 px are wrong
    assert np.max(np.abs(residuals)) < 0.1
    assert np.sqrt(np.mean(residuals**2)) < 0.02 * np.sqrt(np.mean(flat**2))
    found = triangulate(obs, projection, at.rotations, at.positions, BackendConfig().triangulation)
    errors = np.linalg.norm(found.points - at.points, axis=1)
    assert np.median(errors[found.good]) < 0.005


def test_derivatives_are_the_numerical_ones_and_factors_are_gtsams() -> None:
    mounted, step = rolling(), 1e-6
    obs, at, state = seen_by(mounted, room(60, np.random.default_rng(1)))
    variables = CalibrationVariables(mounted, CalibrationConfig(time_offset=True, readout=True))
    prior = variables.enter(state, SquareRootInformation.empty())
    projection = CalibratedProjection(variables, state)
    assert projection.rolling
    by_pose, by_point, by_calibration = projection.all_jacobians(obs, at)
    layout = prior.layout.extended(dims_of(X(k) for k in range(len(TIMES))))

    def moved(column: int, sign: float) -> FloatArray:
        other = state.copy()
        other.update(layout, sign * step * np.eye(layout.size)[column])
        there = CalibratedProjection(variables, other)
        poses = there.poses(other.estimate, obs.frames)
        return obs.pixels - there.residuals(obs, Geometry(*poses, at.points))[0]

    for column in range(layout.size):
        numerical = (moved(column, 1.0) - moved(column, -1.0)) / (2 * step)
        if column < prior.layout.size:
            ours = by_calibration[:, :, column]
        else:
            frame, axis = divmod(column - prior.layout.size, 6)
            ours = np.where((obs.frame == frame)[:, None], by_pose[:, :, axis], 0.0)
        np.testing.assert_allclose(ours, numerical, rtol=2e-6, atol=2e-3)
    residuals, _ = projection.residuals(obs, at)
    plain = RigProjection(mounted).at(state)
    for row in range(0, len(obs), 9):
        i, j, c = int(obs.frame[row]), int(obs.feature[row]), int(obs.camera[row])
        calibration, factor_type = native_factor(mounted.cameras[c].camera)
        mount = plain.mount_poses(obs.rows(np.array([row])))[0]
        unit = gtsam.noiseModel.Unit.Create(2)
        factor = factor_type(obs.pixels[row], unit, X(i), L(j), calibration, True, False, mount)
        values = gtsam.Values()
        values.insert(X(i), state.estimate.atPose3(X(i)))
        values.insert(L(j), at.points[j])
        A, b = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
        np.testing.assert_allclose(residuals[row], b, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(np.hstack([by_pose[row], by_point[row]]), A, atol=1e-6)


def test_a_motion_bends_as_its_rates_change() -> None:
    rng = np.random.default_rng(2)
    motion, seconds, step = FrameMotion(rng.normal(size=6), 0.0, rng.normal(size=6)), 0.02, 1e-6
    at = np.array([seconds - step, seconds, seconds + step])
    turn, move = motion.after(at)
    velocity = turn[1].T @ (move[2] - move[0]) / (2 * step)
    np.testing.assert_allclose(motion.rates_after(at)[1, 3:], velocity, atol=1e-8)
    skewed = turn[1].T @ (turn[2] - turn[0]) / (2 * step)
    rate = np.array([skewed[2, 1], skewed[0, 2], skewed[1, 0]])
    np.testing.assert_allclose(motion.rates_after(at)[1, :3], rate, atol=1e-3)


def test_the_front_end_turns_rows_to_one_time_and_back() -> None:
    """Seen from afar only rotation counts, which the gyroscope knows."""
    (mounted,) = rolling(1).cameras
    far = 1e4 * room(300, np.random.default_rng(3))
    motion = ImuMotion(rig().imu, 9.81)
    motion.add(FAST.imu(0.0, 2.0))
    predictor = PointPredictor(mounted, motion, FrontendConfig())
    seen = rows_of(FAST, rolling(1), far, 1.0)
    at_once = features(FAST, rig(1), far, 1.0).cameras[0]
    rows = seen.cameras[0]
    _, a, b = np.intersect1d(rows.ids, at_once.ids, return_indices=True)
    assert len(a) > 20
    found = predictor.unrolled(rows.pixels, rows.normalized, seen.stamp_ns)
    assert np.max(np.abs(rows.normalized[a] - at_once.normalized[b])) > 5e-3
    np.testing.assert_allclose(found[a], at_once.normalized[b], atol=2e-4)
    back = predictor._rolled(found, seen.stamp_ns)
    np.testing.assert_allclose(back, rows.pixels, atol=0.05)


# --- moving objects -------------------------------------------------------------------------------


def test_rows_are_unrolled_to_one_time() -> None:
    """Where depths are known, up to how the rates of a fast flight change."""
    mounted, points = rolling(), room(300, np.random.default_rng(3))
    nav, imu = FAST.nav_state(1.0), ImuBuffer()
    imu.add(FAST.imu(0.9, 1.1))
    frame = rows_of(FAST, mounted, points, 1.0)
    rows, at_once = frame.cameras[0], features(FAST, rig(), points, 1.0).cameras[0]
    _, a, b = np.intersect1d(rows.ids, at_once.ids, return_indices=True)
    camera = nav.world_T_body.compose(mounted.cameras[0].body_T_camera)
    depths = camera.transformTo(points[rows.ids[a]].T)[2]
    found = unrolled(rows, a, mounted, rolling_motion(nav, frame.stamp_ns, imu, mounted), depths)
    assert len(a) > 20
    assert np.max(np.abs(rows.normalized[a] - at_once.normalized[b])) > 5e-3
    np.testing.assert_allclose(found, at_once.normalized[b], atol=3e-4)


@pytest.mark.parametrize("speed", [0.0, 2.0])
def test_rows_are_no_motion_of_what_is_rigid(speed: float) -> None:
    """Neither of a static world, nor of an object, in whose frame the flight is `FAST`."""
    mounted, points, imu = rolling(), room(300, np.random.default_rng(3)), ImuBuffer()
    imu.add(FAST.imu(0.9, 1.6))
    object_motion = speed * np.array([0.2, -0.1, 0.3, 1.0, 0.5, -0.2])

    def in_world(t_s: float) -> gtsam.Pose3:
        return gtsam.Pose3.Expmap(object_motion * t_s).compose(FAST.nav_state(t_s).world_T_body)

    window, times = TrackWindow(mounted, BackendConfig()), 1.0 + 0.1 * np.arange(6)
    in_object, motions = dict[int, gtsam.Pose3](), dict[int, FrameMotion]()
    for t in times.tolist():
        frame, nav = rows_of(FAST, mounted, points, t), FAST.nav_state(t)
        step = in_world(t - 1e-4).between(in_world(t + 1e-4))
        motion = rolling_motion(nav, frame.stamp_ns, imu, mounted)
        motions[frame.stamp_ns] = replace(motion, rate=gtsam.Pose3.Logmap(step) / 2e-4)
        in_object[frame.stamp_ns] = nav.world_T_body
        poses = tuple(in_world(t) for t in times[: len(motions)])
        still, none = np.zeros((len(poses), 3)), np.zeros((6, 6))
        small = 1e-10 * np.eye(3)
        ego = EgoMotion(tuple(motions), poses, still, nav, small, small, none, motions)
        window.add(frame, 0, ego)
    ids, squares, dof = window.misfit(window.seen, in_object, 0.5)
    assert len(ids) > 50
    assert np.max(squares / dof) < 0.5
    if speed == 0.0:
        obs = window.observations(ids, 3, window.stamps_ns)
        rig_now = window.projection(window.stamps_ns, poses)
        test = judge_tracks(obs, rig_now, ego, 0.5, BackendConfig(), ObjectsConfig())
        assert not test.moves.any()
    window.add(frame, 0)
    _, ignored_rows, _ = window.misfit(ids, in_object, 0.5)
    assert np.median(ignored_rows / dof) > 2.0


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", ["first", "middle", "last"])
def test_a_shutter_comes_back_from_a_file(
    tmp_path: Path, row: Literal["first", "middle", "last"]
) -> None:
    cameras = tuple(replace(c, stamped_row=row) for c in rolling().cameras)
    write_kalibr(replace(rig(2), cameras=cameras), tmp_path / "chain.yaml")
    again = read_kalibr(tmp_path / "chain.yaml")
    for one, other in zip(cameras, again.cameras, strict=True):
        assert (one.readout_s, one.stamped_row) == (other.readout_s, other.stamped_row)
        ends = other.row_times_s(np.array([0.0, 480.0]))
        assert ends[1] - ends[0] == pytest.approx(READOUT_S)
        assert other.end_s == pytest.approx(ends[1])
        assert other.middle_s == pytest.approx(np.mean(ends))
    assert again.pose_offset_s == pytest.approx(
        {"first": 0.015, "middle": 0.0, "last": -0.015}[row]
    )


def test_kalibrs_line_delay_is_the_readout_of_a_row(tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    write_kalibr(rig(1), path)
    edit_text(path, "camera_model", "line_delay: 5.0e-05\n  camera_model")
    (mounted,) = read_kalibr(path).cameras
    assert mounted.rolling_shutter
    assert mounted.readout_s == pytest.approx(480 * 5e-5)
    for line, message in (
        ("readout_time: 0.5", "at most 0.1 s"),
        ("line_delay: 1e-5\n  readout_time: 0.02", "does not fit line_delay"),
        ("readout_time: 0.02\n  stamped_row: top", "'top' is not first, middle or last"),
    ):
        write_kalibr(rig(1), path)
        edit_text(path, "camera_model", f"{line}\n  camera_model")
        with pytest.raises(DataError, match=rf"chain\.yaml:\d+: .*{message}"):
            read_kalibr(path)


# --- estimates ------------------------------------------------------------------------------------


def flown(readout_s: float, cameras: int = 1) -> SimulatedSequence:
    return simulate(cameras=cameras, shutter_readout_s=readout_s, duration_s=5.0, **ROLLING)


def ate(sequence: SimulatedSequence, result: RunResult, smoothed: bool = False) -> float:
    result.check()
    estimate = result.smoothed if smoothed else result.trajectory
    assert estimate is not None
    return error_of(sequence, estimate)


def error_of(sequence: SimulatedSequence, estimate: Trajectory) -> float:
    return float(ape(sequence.groundtruth(), estimate, "trans_part", "se3").statistics.rmse)


def test_simulated_rows_are_those_of_the_true_motion() -> None:
    settings = {"shutter_readout_s": READOUT_S, "duration_s": 2.0, "tracks": {"pixel_sigma": 0.0}}
    sequence = simulate(cameras=2, **settings, **ROLLING)
    flight, ids = sequence.flight, {}
    for frame, t_ns in zip(sequence.frames(), flight.exposures_ns.tolist(), strict=True):
        assert t_ns - frame.stamp_ns == 15_000_000
        assert isinstance(frame, FeatureFrame)
        for mounted, seen in zip(sequence.rig.cameras, frame.cameras, strict=True):
            rows = mounted.row_times_s(seen.pixels[:, 1]) * 1e9
            at = frame.stamp_ns + np.round(rows).astype(np.int64)
            R, p = flight.motion.rotations(at).as_matrix(), flight.motion.positions(at)
            matrix = mounted.body_T_camera.matrix()
            eye = p + R @ matrix[:3, 3]
            rays = np.einsum(
                "nij,nj->ni",
                R @ matrix[:3, :3],
                np.column_stack([seen.normalized, np.ones(len(seen))]),
            )
            for j, ray, origin in zip(seen.ids.tolist(), rays, eye, strict=True):
                ids.setdefault(j, []).append((origin, ray / np.linalg.norm(ray)))
    long = [np.array(v) for v in ids.values() if len(v) > 20]
    assert len(long) > 50
    for views in long:  # all rays to a landmark meet in one point
        across = np.eye(3) - views[:, 1, :, None] * views[:, 1, None, :]
        point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, views[:, 0]))
        miss = np.einsum("nij,nj->ni", across, point - views[:, 0])
        assert np.max(np.linalg.norm(miss, axis=1)) < 1e-3


def stepped(name: str, cameras: int = 1, frames: int = 30) -> Estimator:
    """An estimator after some frames with rolling shutters."""
    sequence = flown(READOUT_S, cameras)
    config = load_config(algorithm=name)
    estimator = Estimator(sequence.rig, config.algorithm, config.backend)
    estimator.start(sequence.initial_state())
    for number, packet in enumerate(sequence.packets()):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
        if number == frames:
            break
    return estimator


@pytest.mark.parametrize("name", ["msckf", slow("okvis"), "ekf"])
@pytest.mark.parametrize("cameras", [1, slow(2)])
def test_the_window_as_a_factor_graph_has_the_rows(name: str, cameras: int) -> None:
    check(stepped(name, cameras))


@pytest.mark.parametrize("name", ["msckf", slow("okvis"), slow("fixed_lag_isam2")])
def test_estimates_know_the_rows(name: str) -> None:
    errors = []
    for known in (True, False):
        sequence = flown(READOUT_S)
        sequence.rig = sequence.rig if known else ignored(sequence.rig)
        config = load_config(None, ["final_ba.enabled=false"], algorithm=name)
        result = run(sequence, config)
        assert result.status == "ok" or (not known and result.status == "suspect")
        errors.append(error_of(sequence, result.trajectory))
    assert errors[0] < 0.5 * errors[1]


def test_the_bundle_adjustment_knows_the_rows() -> None:
    sequence = flown(READOUT_S)
    result = run(sequence, load_config(algorithm="msckf"))
    assert ate(sequence, result, smoothed=True) < 0.006


def test_the_readout_time_is_found() -> None:
    sequence = flown(READOUT_S)
    cameras = (replace(c, readout_s=READOUT_S - 0.005) for c in sequence.rig.cameras)
    sequence.rig = replace(sequence.rig, cameras=tuple(cameras))
    overrides = ["backend.calibration.readout=true", "final_ba.enabled=false"]
    result = run(sequence, load_config(None, overrides, algorithm="msckf"))
    result.check()
    latest = result.logs.calibration.latest
    assert latest is not None
    (found,) = latest.parameters()
    assert found.name == "readout_s"
    assert found.start == pytest.approx(READOUT_S - 0.005)
    assert found.value == pytest.approx(READOUT_S, abs=max(4 * found.sigma, 2e-4))
    assert found.sigma < 1e-3
