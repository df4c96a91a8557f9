# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Runs with loop closure, from the command line to the files."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from slam_graph.backend.world_gauge import in_moved_world
from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState, interpolate
from slam_graph.pipeline.mapping import Keyframes, MapBuilding
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.results.run_input import RunInput
from slam_graph.results.run_result import RunResult
from slam_graph.results.saved_run import SavedRun, load_result
from slam_graph.sensors import CalibrationEstimate, FeatureFrame, Rig
from slam_graph.simulation.simulation_config import LandmarkConfig, SimulationConfig, TrackConfig
from slam_graph.simulation.simulator import simulate

SETTINGS = ("--set", "loop_closure.places.words=300")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a tour that comes back into the first room."""
    config = SimulationConfig(
        trajectory="rooms",
        duration_s=60.0,
        rate_hz=4.0,
        seed=3,
        cameras=1,
        landmarks=LandmarkConfig(density=4.0),
        tracks=TrackConfig(features=70, descriptors=True),
    )
    folder = tmp_path_factory.mktemp("loops") / "tour"
    simulate(config).save(folder)
    return folder


def results(flight: Path, output: Path, *options: str) -> tuple[Path, dict]:
    arguments = ["run", str(flight), "--output", str(output), "--no-progress", "--json", *options]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    table = json.loads(done.stdout)
    return Path(table["folder"]), table


@pytest.mark.slow
def test_loops_are_closed_if_asked_for(flight: Path, tmp_path: Path) -> None:
    folder, table = results(flight, tmp_path / "with", "--loop-closure", *SETTINGS)
    loops = table["loop_closure"]
    assert 0 < loops["accepted"] <= loops["verified"]
    rmse = [
        accuracy["yaw"]["ate"]["translation_m"]["rmse"]
        for accuracy in (table["accuracy"], loops["accuracy"])
    ]
    assert rmse[1] < 0.57 * rmse[0]
    causal = np.loadtxt(folder / "trajectory.tum")
    corrected = np.loadtxt(folder / "trajectory_loop.tum")
    np.testing.assert_array_equal(causal[:, 0], corrected[:, 0])
    assert len((folder / "loops.csv").read_text().splitlines()) == loops["verified"] + 1
    assert (folder / "map_loop.ply").read_bytes().startswith(b"ply")

    without, table = results(flight, tmp_path / "without")
    assert table["loop_closure"] is None
    assert not (without / "trajectory_loop.tum").exists()
    # the causal trajectory is the same with loop closure and without
    assert (without / "trajectory.tum").read_text() == (folder / "trajectory.tum").read_text()


@pytest.mark.slow
def test_a_result_of_all_stages_reads_back_as_it_was(flight: Path, tmp_path: Path) -> None:
    overrides = {"loop_closure.enabled": True, "loop_closure.places.words": 300}
    result = run(flight, overrides={**overrides, "map.enabled": True})
    result.check()
    located = run(flight, known_map=result.slam_map, duration_s=10.0, overrides={"min_coverage": 0})
    for name, found in (("all", result), ("located", located)):
        found.save(tmp_path / name)
        assert_reads_back(found, load_result(str(tmp_path / name)))
    assert result.loop_closed is not None
    assert result.slam_map is not None
    assert located.in_map is not None


def assert_reads_back(result: RunResult, saved: SavedRun) -> None:
    """Every accessor of a saved run says what the result says."""
    names = {name for name in dir(SavedRun) if not name.startswith("_")}
    # files for the viewer, which a result has in its logs; and what checks a file
    names -= {"timing", "by_frame", "fault_of_metrics"}
    assert names <= set(dir(RunResult))
    names |= {"metrics"}
    trajectories = {"trajectory", "best_trajectory", "smoothed", "loop_closed", "in_map"}
    for name in trajectories | {"groundtruth"}:
        true, found = getattr(result, name), getattr(saved, name)
        assert (true is None) == (found is None), name
        if true is not None:
            np.testing.assert_array_equal(found.stamps_ns, true.stamps_ns)
            np.testing.assert_allclose(found.positions, true.positions, atol=1e-9)
            np.testing.assert_allclose(found.quaternions, true.quaternions, atol=1e-9)
    for name in ("velocities", "accel_biases", "gyro_biases"):
        true, found = getattr(result.trajectory, name), getattr(saved.trajectory, name)
        np.testing.assert_allclose(found, true, rtol=1e-8)
    np.testing.assert_allclose(saved.sigmas, result.sigmas, rtol=1e-8)
    if result.smoothed_sigmas is not None:
        assert saved.smoothed_sigmas is not None
        np.testing.assert_allclose(saved.smoothed_sigmas, result.smoothed_sigmas, rtol=1e-8)
    np.testing.assert_array_equal(saved.points, result.points)
    assert (saved.slam_map is None) == (result.slam_map is None)
    if saved.slam_map is not None and result.slam_map is not None:
        np.testing.assert_array_equal(saved.slam_map.points, result.slam_map.points)
    for true_rig, rig in ((result.rig, saved.rig), (result.estimated_rig, saved.estimated_rig)):
        for one, other in zip(true_rig.cameras, rig.cameras, strict=True):
            assert one.body_T_camera.equals(other.body_T_camera, 1e-6)
            assert one.time_offset_s == pytest.approx(other.time_offset_s, abs=1e-9)
    np.testing.assert_array_equal(saved.loop_ends_ns, result.loop_ends_ns)
    np.testing.assert_array_equal(saved.keyframes_ns, result.keyframes_ns)
    assert (saved.nees_series is None) == (result.nees_series is None)
    if saved.nees_series is not None and result.nees_series is not None:
        for true, found in zip(result.nees_series, saved.nees_series, strict=True):
            np.testing.assert_allclose(found, true, rtol=1e-3)
    assert saved.unmeasured == result.unmeasured
    assert saved.scaled_camera is None
    assert result.scaled_camera is None
    tested = trajectories | {
        "scaled_camera",
        "unmeasured",
        "loop_ends_ns",
        "keyframes_ns",
        "nees_series",
        "groundtruth",
        "sigmas",
        "smoothed_sigmas",
        "points",
        "slam_map",
        "rig",
        "estimated_rig",
    }
    for name in ("metrics", "config", "status", "message", "coverage", "start_was_given"):
        assert getattr(saved, name) == getattr(result, name), name
        tested.add(name)
    shown = {"plot", "show", "export", "exported_poses"}  # which show and write what is above
    assert tested == names - shown


def test_tracks_without_descriptors_are_said_to_have_no_loops() -> None:
    tracks = TrackConfig(features=30)
    sequence = simulate(SimulationConfig(duration_s=2.0, rate_hz=10.0, tracks=tracks))
    result = run(sequence, load_config(None, ["loop_closure.enabled=true"]))
    assert result.status == "ok"
    assert result.loops is None
    assert result.warnings["loop_closure_impossible"] == 1


def test_what_goes_wrong_leaves_the_causal_result(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = TrackConfig(features=30, descriptors=True)
    sequence = simulate(SimulationConfig(duration_s=2.0, rate_hz=10.0, tracks=tracks))
    for error in (cv2.error("bad points"), KeyboardInterrupt()):

        def fail(*_: object, error: BaseException = error) -> None:
            raise error

        monkeypatch.setattr("slam_graph.pipeline.mapping.close_loops", fail)
        result = run(sequence, load_config(None, ["loop_closure.enabled=true"]))
        interrupted = isinstance(error, KeyboardInterrupt)
        assert result.status == ("interrupted" if interrupted else "ok")
        assert len(result.trajectory) > 10
        assert result.loops is None
        assert result.warnings["loop_closure_failed"] >= 1


# --- keyframes of a run that begins anew, or whose calibration is estimated ----------------------


def begun(rig: Rig | None = None) -> tuple[RunResult, Keyframes, list[EstimatedFrame]]:
    """A short run with another calibration, and its frames with the true states."""
    tracks = TrackConfig(features=40, descriptors=True)
    sequence = simulate(SimulationConfig(duration_s=2.0, rate_hz=10.0, cameras=2, tracks=tracks))
    rig, info = rig or sequence.rig, sequence.info()
    config = load_config(None, ["loop_closure.keyframes.distance_m=0.1"])
    result = RunResult(RunInput(info, config, rig, info.start_ns, info.end_ns))
    offset_ns, frames = round(sequence.rig.pose_offset_s * 1e9), []
    none, zero = np.zeros(0, np.int64), np.zeros(3)
    for packet in sequence.packets():
        seen = packet.frame
        assert isinstance(seen, FeatureFrame)
        stamp_ns = seen.stamp_ns + offset_ns
        near, valid = interpolate(sequence.groundtruth(), np.array([stamp_ns]))
        if valid[0]:
            state = NavState(stamp_ns, near.pose(0), zero, accel_bias=zero, gyro_bias=zero)
            told = none, np.zeros((0, 3)), none, (1.0, 1.0), True
            frames.append(EstimatedFrame(packet, seen, state, *told))
    return result, Keyframes(result), frames


@pytest.mark.parametrize("rigid", [True, False])
def test_keyframes_move_with_the_states_to_another_world(rigid: bool) -> None:
    """As to that of position fixes; where the states are others, keyframes begin anew."""
    motion = gtsam.Pose3(gtsam.Rot3.Rz(1.0), np.array([100.0, -50.0, 2.0]))
    (_, never, frames), (_, stage, _) = begun(), begun()
    for k, frame in enumerate(frames):
        never.frame(frame)
        assert frame.state is not None
        if k >= 10:
            frame = replace(
                frame,
                state=in_moved_world([frame.state], motion)[0],
                restarted=k == 10,
                world_motion=motion if rigid and k == 10 else None,
            )
        stage.frame(frame)
    if not rigid:
        assert frames[10].state is not None
        assert stage.found[0].stamp_ns == frames[10].state.stamp_ns
        return
    assert len(stage.found) == len(never.found) > 2
    for here, there in zip(never.found, stage.found, strict=True):
        assert there.stamp_ns == here.stamp_ns
        assert there.world_T_body.equals(motion.compose(here.world_T_body), 1e-9)
        np.testing.assert_allclose(there.points, here.points, atol=1e-6)


def test_keyframes_and_map_have_the_calibration_that_is_estimated() -> None:
    result, right, frames = begun()
    true = result.rig
    turned = true.cameras[1].body_T_camera.compose(gtsam.Pose3(gtsam.Rot3.Ry(0.03), np.zeros(3)))
    second = replace(true.cameras[1], body_T_camera=turned)
    wrong = replace(true, cameras=(true.cameras[0], second))
    result, stage, _ = begun(wrong)
    result.logs.calibration.append(CalibrationEstimate(0, wrong, true, {}))
    for frame in frames:
        right.frame(frame)
        stage.frame(frame)
    for ours, expected in zip(stage.found, right.found, strict=True):
        np.testing.assert_array_equal(ours.points, expected.points)
    MapBuilding(result, stage, Diagnostics()).finish()
    assert result.slam_map is not None
    assert result.slam_map.recordings[0].rig.cameras is true.cameras
