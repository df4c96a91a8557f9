# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Simulations end to end: as sequences, as files, on the command line, and under the estimator."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimating import BELIEVED
from test_datasets_contract import check_contract, same_frame, same_imu
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.data_checks import check_sequence
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulation_config import (
    SimulatedGnssConfig,
    SimulationConfig,
    load_simulation_config,
)
from slam_graph.simulation.simulator import euroc_rig, simulate

IMAGES: dict[str, Any] = {"kind": "images", "images": {"texel_m": 0.02}}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Settings for images of a quarter of the usual width."""
    cameras = []
    for mounted in euroc_rig().cameras:
        model = mounted.camera
        focal, middle = (model.fx / 4, model.fy / 4), (model.cx / 4, model.cy / 4)
        tiny = Camera(*focal, *middle, model.distortion, model.coefficients, 188, 120)
        cameras.append(replace(mounted, camera=tiny))
    path = tmp_path_factory.mktemp("rig") / "small.yaml"
    write_kalibr(Rig(tuple(cameras)), path)
    return {**IMAGES, "calibration": path}


def simulated(**options: Any) -> SimulatedSequence:
    return simulate(SimulationConfig(**{"duration_s": 2.0, **options}))


def digest(folder: Path) -> dict[str, str]:
    """Hash of every file in a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("kind", ["tracks", "images"])
def test_a_simulation_is_a_sequence(kind: str, small: dict[str, Any]) -> None:
    options = small if kind == "images" else {}
    sequence = simulated(**options)
    packets = list(sequence.packets())
    check_contract(sequence, packets)
    first, last = len(packets) // 3, 2 * len(packets) // 3
    part = list(sequence.packets(packets[first].frame.stamp_ns, packets[last].frame.stamp_ns))
    assert len(part) == last - first + 1
    for a, b in zip(packets[first : last + 1], part, strict=True):
        assert same_frame(a.frame, b.frame)
    assert all(same_imu(a.imu, b.imu) for a, b in zip(packets[first + 1 :], part[1:], strict=False))
    assert [f for f in check_sequence(simulated(**options)) if f.severity != "info"] == []


@pytest.mark.parametrize("kind", ["tracks", "images"])
def test_the_same_seed_writes_the_same_bytes(
    kind: str, small: dict[str, Any], tmp_path: Path
) -> None:
    options = {"tracks": {"loss": 0.02, "outliers": 0.02}} if kind == "tracks" else small
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulated(**options, seed=seed).save(tmp_path / name)
    first, second, other = (digest(tmp_path / name) for name in "abc")
    assert first == second
    assert first.keys() == other.keys()
    same = {name for name in first.keys() & other.keys() if first[name] == other[name]}
    assert all(name.endswith((".yaml", "data.csv")) or name == "frames.bin" for name in same)
    assert not {"features.bin", "imu.bin", "mav0/imu0/data.csv", "groundtruth.npz"} & same


def test_written_tracks_are_those_of_the_sequence(tmp_path: Path) -> None:
    sequence = simulated()
    sequence.save(tmp_path / "tracks")
    recording = open_dataset(tmp_path / "tracks")
    assert [f for f in check_sequence(recording) if f.severity != "info"] == []
    for a, b in zip(sequence.packets(), recording.packets(), strict=True):
        assert same_frame(a.frame, b.frame)
        assert same_imu(a.imu, b.imu)
    truth, start = recording.groundtruth(), recording.initial_state()
    assert truth is not None
    assert start is not None
    np.testing.assert_array_equal(truth.positions, sequence.groundtruth().positions)
    np.testing.assert_array_equal(truth.accel_biases, sequence.groundtruth().accel_biases)
    np.testing.assert_array_equal(start.velocity, sequence.initial_state().velocity)


def test_a_written_euroc_folder_is_the_sequence_and_sound(
    small: dict[str, Any], tmp_path: Path
) -> None:
    sequence = simulated(**small)
    sequence.save(tmp_path / "images")
    recording = open_dataset(tmp_path / "images")
    assert recording.info().format == "euroc"
    found = check_sequence(recording, read_images=True)
    assert [f for f in found if f.severity != "info"] == []
    for a, b in zip(sequence.packets(), recording.packets(), strict=True):
        assert same_frame(a.frame, b.frame)
        assert same_imu(a.imu, b.imu)
    truth, exact = recording.groundtruth(), sequence.groundtruth()
    assert truth is not None
    assert truth.velocities is not None
    assert truth.gyro_biases is not None
    np.testing.assert_allclose(truth.quaternions, exact.quaternions, atol=1e-15)
    np.testing.assert_array_equal(truth.velocities, exact.velocities)
    np.testing.assert_array_equal(truth.gyro_biases, exact.gyro_biases)
    for mounted, read in zip(sequence.rig.cameras, recording.rig.cameras, strict=True):
        assert mounted.camera == read.camera
        assert mounted.body_T_camera.equals(read.body_T_camera, 1e-9)


def test_an_interrupted_simulation_leaves_nothing_behind(
    small: dict[str, Any], tmp_path: Path
) -> None:
    def stop(stamp_ns: int) -> None:
        raise KeyboardInterrupt

    for options in ({}, small):
        with pytest.raises(KeyboardInterrupt):
            simulated(**options).save(tmp_path / "out", stop)
        assert list(tmp_path.iterdir()) == []


def ate(sequence: SimulatedSequence) -> float:
    given = ["backend.initialization.mode=given", "final_ba.enabled=false", BELIEVED]
    result = run(sequence, load_config(algorithm="msckf", overrides=given))
    result.check()
    assert result.start_was_given
    rmse: float = result.metrics["accuracy"]["none"]["ate"]["translation_m"]["rmse"]
    return rmse


@pytest.mark.slow
def test_the_estimator_follows_a_simulated_flight() -> None:
    assert ate(simulated(duration_s=15.0)) < 0.0115


@pytest.mark.slow
@pytest.mark.data
def test_the_estimator_follows_a_real_flight_with_its_real_imu(data_dir: Path) -> None:
    path = data_dir / "euroc_inertial" / "V2_01_easy"
    sequence = simulated(trajectory=str(path), real_imu=True, duration_s=20.0)
    recorded = open_dataset(path)
    truth = recorded.groundtruth()
    assert truth is not None
    assert ate(sequence) < 0.0215
    samples = sequence.imu()
    where = np.searchsorted(truth.stamps_ns, samples.stamps_ns[100])
    assert truth.stamps_ns[where] - samples.stamps_ns[100] < 5_000_000
    assert sequence.rig.cameras[1].camera == recorded.rig.cameras[1].camera


@pytest.mark.data
def test_a_simulated_imu_flies_along_a_recorded_trajectory(data_dir: Path) -> None:
    path = data_dir / "euroc_inertial" / "V1_02_medium" / "mav0" / "state_groundtruth_estimate0"
    sequence = simulated(trajectory=str(path), start_s=20.0, duration_s=5.0)
    assert sequence.name == "V1_02_medium_tracks_0"
    packets = list(sequence.packets())
    check_contract(sequence, packets)
    assert len(packets) == 101
    assert ate(sequence) < 0.0095


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["simulate", *map(str, arguments), "--no-progress"])


def test_the_command_writes_a_recording(tmp_path: Path) -> None:
    options = ["--duration", 1, "--features", 40, "--pixel-sigma", 0.5, "--loss", 0.1, "--seed", 7]
    done = invoke(tmp_path / "out", *options, "--cameras", 1, "--rate", 10, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["frames"] == 11
    info = open_dataset(tmp_path / "out").info()
    assert (info.content, info.cameras, info.frames) == ("tracks", 1, 11)
    again = invoke(tmp_path / "again", "--config", tmp_path / "out" / "simulation.yaml")
    assert again.exit_code == 0, again.output
    assert "11 frames of tracks, 1 cameras" in again.stdout
    assert digest(tmp_path / "out")["features.bin"] == digest(tmp_path / "again")["features.bin"]


@pytest.mark.parametrize(
    ("option", "changed"), [("--gnss", {"sigma_m": 0.25}), ("--multipath", {"multipath": 0.25})]
)
def test_an_option_of_fixes_leaves_their_other_settings(
    option: str, changed: dict[str, float], tmp_path: Path
) -> None:
    given = {"sigma_m": 0.5, "rate_hz": 5.0, "multipath": 0.75, "multipath_m": 50.0}
    (tmp_path / "sim.yaml").write_text(json.dumps({"duration_s": 1.0, "gnss": given}))
    done = invoke(tmp_path / "out", "--config", tmp_path / "sim.yaml", option, 0.25)
    assert done.exit_code == 0, done.output
    written = load_simulation_config(tmp_path / "out" / "simulation.yaml").gnss
    assert written == SimulatedGnssConfig(**(given | changed))
    assert (tmp_path / "out" / "gnss.csv").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--real-imu"], 2, "'figure8' is a generated one"),
        (["--trajectory", "nowhere"], 1, "nowhere: no such trajectory"),
        (["--loss", "2"], 2, "tracks.loss: input should be less than 1"),
        (["--gnss", "0"], 2, "gnss.sigma_m: input should be greater than 0"),
        (["--multipath", "0.2"], 2, "there are none: give their sigma, gnss.sigma_m (--gnss)"),
        (["--set", "imu.noise=2"], 2, "unknown key 'imu.noise'"),
        (["--set", "tracks.features=0"], 2, "tracks.features"),
    ],
)
def test_the_command_says_what_is_wrong(
    arguments: list[str], code: int, message: str, tmp_path: Path
) -> None:
    done = invoke(tmp_path / "out", *arguments)
    assert message in str(done.exception)
    assert getattr(done.exception, "exit_code", None) == code
    assert not (tmp_path / "out").exists()
