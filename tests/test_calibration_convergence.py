# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Online calibration from a wrong start: 2 cm, 1°, 10 ms, 1 % of the focal length."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from flight import Flight, packets, rig, room
from groups import slow_but
from scipy.stats import chi2
from typer.testing import CliRunner

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig, InitializationConfig
from slam_graph.backend.estimator import Estimator
from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import read_kalibr, write_kalibr
from slam_graph.errors import ConfigError
from slam_graph.evaluation import ape
from slam_graph.geometry.trajectory import NavState
from slam_graph.pipeline import run
from slam_graph.sensors.measurements import (
    FeatureFrame,
    FeatureObservations,
    ImuData,
    Packet,
)
from slam_graph.sensors.rig import CalibrationEstimate, Rig
from slam_graph.simulation.simulation_config import FlightConfig, SimulationConfig
from slam_graph.simulation.simulator import simulate

KINDS = ("extrinsics", "time_offset", "intrinsics")
SIGMAS = np.array([2e-3, 1e-3, 0.02, 0.02, 2e-3])
POINTS = 150


def wrong(true: Rig, what: tuple[str, ...], sign: int = 1) -> Rig:
    """The rig with errors in some of its parameters."""
    cameras = []
    for mounted in true.cameras:
        if "extrinsics" in what:
            turn = np.deg2rad(1.0) * np.array([0.6, -0.48, 0.64])
            move = 0.02 * np.array([-0.48, 0.6, 0.64])
            pose = mounted.body_T_camera.retract(sign * np.concatenate([turn, move]))
            mounted = replace(mounted, body_T_camera=pose)
        if "intrinsics" in what:
            scale = 1.0 + 0.01 * sign
            camera = mounted.camera
            camera = replace(camera, fx=camera.fx * scale, fy=camera.fy * scale, cx=camera.cx + 3)
            mounted = replace(mounted, camera=camera)
        if "time_offset" in what:
            mounted = replace(mounted, time_offset_s=mounted.time_offset_s + 0.01 * sign)
        cameras.append(mounted)
    return Rig(tuple(cameras), true.imu)


def errors(estimate: CalibrationEstimate, true: Rig) -> tuple[FloatArray, FloatArray]:
    """Squared errors under the covariance, one for each variable, and their dimensions."""
    squares, dims = [], []
    for name, covariance in estimate.covariances.items():
        ours, theirs = (r.cameras[int(name[1:])] for r in (estimate.rig, true))
        if name[0] == "e":
            error = gtsam.Pose3.Logmap(ours.body_T_camera.between(theirs.body_T_camera))
        elif name[0] == "k":
            error = ours.camera.intrinsics - theirs.camera.intrinsics
        else:
            error = np.array([ours.time_offset_s - theirs.time_offset_s])
        squares.append(error @ np.linalg.solve(covariance, error))
        dims.append(len(error))
    return np.array(squares), np.array(dims)


def left(estimate: CalibrationEstimate, nominal: Rig, true: Rig) -> dict[str, float]:
    """What is left of the largest error of each kind, as a share of it."""
    sizes = []
    for some in (nominal, estimate.rig):
        table: dict[str, list[float]] = {}
        for ours, theirs in zip(some.cameras, true.cameras, strict=True):
            away = theirs.body_T_camera.localCoordinates(ours.body_T_camera)
            focal = ours.camera.intrinsics[:2] / theirs.camera.intrinsics[:2] - 1.0
            table.setdefault("rotation", []).append(float(np.linalg.norm(away[:3])))
            table.setdefault("position", []).append(float(np.linalg.norm(away[3:])))
            table.setdefault("focal", []).append(float(np.abs(focal).max()))
            table.setdefault("offset", []).append(abs(ours.time_offset_s - theirs.time_offset_s))
        sizes.append({kind: max(values) for kind, values in table.items()})
    return {kind: sizes[1][kind] / size for kind, size in sizes[0].items() if size > 1e-12}


def as_recorded(nominal: Rig, true: Rig, duration_s: float, seed: int) -> Iterator[Packet]:
    """A flight as it is recorded by a rig of which only a wrong calibration is known.

    Frames are stamped by the clock of the cameras, and come with no later IMU sample than that.
    """
    rng = np.random.default_rng(seed)
    ahead_ns = round(true.cameras[0].time_offset_s * 1e9)
    waiting = ImuData.empty()
    for packet in packets(Flight(), true, 0.5 * room(POINTS, rng), duration_s, rng):
        assert isinstance(packet.frame, FeatureFrame)
        stamp_ns = packet.frame.stamp_ns - ahead_ns
        waiting = ImuData.concatenate([waiting, packet.imu])
        until = int(np.searchsorted(waiting.stamps_ns, stamp_ns)) + 1
        seen = zip(packet.frame.cameras, nominal.cameras, strict=True)
        cameras = tuple(
            FeatureObservations(c.ids, c.pixels, mounted.camera.undistort(c.pixels))
            for c, mounted in seen
        )
        yield Packet(waiting[:until], FeatureFrame(stamp_ns, cameras))
        waiting = waiting[until:]


def calibrate(
    name: str, nominal: Rig, true: Rig, what: tuple[str, ...], duration_s: float, seed: int = 1
) -> tuple[CalibrationEstimate, NavState]:
    """The calibration and the state at the end of a flight."""
    config = BackendConfig(
        calibration=CalibrationConfig(**dict.fromkeys(what, True)),
        initialization=InitializationConfig(mode="given"),
    )
    estimator = Estimator(nominal, load_config(algorithm=name).algorithm, config)
    estimator.start(Flight().nav_state(0.0, SIGMAS))
    state = None
    for packet in as_recorded(nominal, true, duration_s, seed):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        state = estimator.add_frame(packet.frame) or state
    assert estimator.calibration is not None
    assert state is not None
    return estimator.calibration, state


def late(true: Rig, offset_s: float) -> Rig:
    """The rig with a true time offset."""
    cameras = (replace(mounted, time_offset_s=offset_s) for mounted in true.cameras)
    return Rig(tuple(cameras), true.imu)


def check_consistent(estimate: CalibrationEstimate, true: Rig) -> None:
    """The error of each variable is as large as its covariance says."""
    squares, dims = errors(estimate, true)
    assert np.all(squares < chi2.ppf(0.999, dims))


@pytest.mark.parametrize("kind", slow_but({"extrinsics"}, KINDS))
def test_each_kind_is_found_alone(kind: str) -> None:
    true = rig(1)
    nominal = wrong(true, (kind,))
    estimate, _ = calibrate("msckf", nominal, true, (kind,), 12.0)
    remaining = left(estimate, nominal, true)
    assert max(remaining.values()) < 0.085, remaining
    check_consistent(estimate, true)


def test_all_are_found_together() -> None:
    """With a true offset that is larger than the nominal one: the IMU lags behind the frames."""
    true = late(rig(1), 0.01)
    nominal = wrong(true, KINDS, -1)
    estimate, state = calibrate("msckf", nominal, true, KINDS, 12.0)
    remaining = left(estimate, nominal, true)
    assert max(remaining.values()) < 0.25, remaining
    check_consistent(estimate, true)
    assert error_m(state) < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("name", ["swf", "okvis", "ekf", "iekf"])
def test_every_algorithm_calibrates(name: str) -> None:
    true = rig(1)
    nominal = wrong(true, KINDS, -1)
    estimate, state = calibrate(name, nominal, true, KINDS, 5.0)
    remaining = left(estimate, nominal, true)
    assert max(remaining[kind] for kind in ("rotation", "focal", "offset")) < 0.5, remaining
    check_consistent(estimate, true)
    assert error_m(state) < 0.016


def error_m(state: NavState) -> float:
    """Distance from the true position."""
    truth = Flight().nav_state(state.stamp_ns * 1e-9).world_T_body
    return float(np.linalg.norm(truth.localCoordinates(state.world_T_body)[3:]))


def test_a_start_in_motion_calibrates_too() -> None:
    """The states of the start and the calibration are found together."""
    true = rig(1)
    nominal = wrong(true, KINDS)
    config = BackendConfig(
        calibration=CalibrationConfig(**dict.fromkeys(KINDS, True)),
        initialization=InitializationConfig(mode="motion"),
    )
    estimator = Estimator(nominal, load_config(algorithm="msckf").algorithm, config)
    for packet in as_recorded(nominal, true, 6.0, 1):
        assert isinstance(packet.frame, FeatureFrame)
        estimator.add_imu(packet.imu)
        estimator.add_frame(packet.frame)
    assert estimator.calibration is not None
    remaining = left(estimator.calibration, nominal, true)
    assert max(remaining[kind] for kind in ("rotation", "focal", "offset")) < 0.2, remaining
    check_consistent(estimator.calibration, true)


def test_a_run_reports_the_calibration(tmp_path: Path) -> None:
    """From the command line: the table, the history, and a file that goes in again."""
    flight = FlightConfig(hover_s=0.0, speed=1.5)
    config = SimulationConfig(
        duration_s=4.0, cameras=1, rate_hz=10.0, trajectory="random", flight=flight
    )
    sequence = simulate(config)
    sequence.save(tmp_path / "flight")
    write_kalibr(wrong(sequence.rig, ("extrinsics", "time_offset"), -1), tmp_path / "wrong.yaml")
    options = ["run", str(tmp_path / "flight"), "--no-progress"]
    options += ["--calibration", str(tmp_path / "wrong.yaml")]
    for kind in ("extrinsics", "time_offset"):
        options += ["--set", f"backend.calibration.{kind}=true"]
    result = CliRunner().invoke(app, [*options, "--output", str(tmp_path / "results")])
    assert result.exit_code == 0, result.output
    assert "cam0_rotation_x_rad" in result.output
    folder = next((tmp_path / "results").glob("*/latest")).resolve()
    table = json.loads((folder / "metrics.json").read_text())["calibration"]
    assert len(table) == 7
    offset = table["time_offset_s"]
    assert offset["start"] == -0.01
    assert abs(offset["value"]) < min(5e-3, 4 * offset["sigma"])
    rows = np.genfromtxt(folder / "calibration.csv", delimiter=",", names=True)
    assert rows["time_offset_s"][-1] == pytest.approx(offset["value"], abs=1e-8)
    assert rows["sigma_time_offset_s"][-1] < rows["sigma_time_offset_s"][0]
    again = read_kalibr(folder / "calibration_estimated.yaml").cameras[0]
    assert again.time_offset_s == pytest.approx(offset["value"], abs=1e-12)
    place = [table[f"cam0_position_{axis}_m"]["value"] for axis in "xyz"]
    np.testing.assert_allclose(again.body_T_camera.translation(), place, atol=1e-12)


def test_the_smoothers_of_gtsam_refuse_in_one_line() -> None:
    wanted = ["backend.calibration.extrinsics=true"]
    with pytest.raises(ConfigError, match=r"'backend' has parameters .* use msckf") as refusal:
        load_config(algorithm="fixed_lag_isam2", overrides=wanted)
    assert "\n" not in str(refusal.value)
    config = load_config(overrides=wanted).backend
    smoother = load_config(algorithm="fixed_lag_isam2").algorithm
    with pytest.raises(ConfigError, match=r"^backend\.calibration .* use msckf") as refusal:
        Estimator(simulate(SimulationConfig(duration_s=1.0)).rig, smoother, config)
    assert "\n" not in str(refusal.value)


def test_a_right_calibration_that_is_estimated_costs_little() -> None:
    """Depths are as uncertain as the mountings: no feature enters before they are known."""
    flight_ = simulate(trajectory="random", duration_s=4.0, seed=2, cameras=2)
    result = run(
        flight_, overrides=["backend.calibration.extrinsics=true"], final_ba={"enabled": False}
    )
    result.check()
    assert ape(flight_.groundtruth(), result.trajectory, alignment="none").statistics.rmse < 0.02
    assert result.metrics["nees"]["position"]["mean"] < 8.0
