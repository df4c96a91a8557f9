# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A camera model from outside the package: files, simulation, a run, and entry points."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from flight import rig
from fov_camera import FOV

from slam_graph.config import load_config
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

HERE = Path(__file__).parent


def test_a_run_on_a_simulated_recording(tmp_path: Path) -> None:
    """Nothing but the model's own file and its registration is needed."""
    chain = tmp_path / "chain.yaml"
    write_kalibr(rig(1, FOV), str(chain))
    assert "distortion_model: atan_fov" in chain.read_text()
    sequence = simulate(SimulationConfig(duration_s=6.0, seed=3, calibration=chain))
    assert sequence.rig.cameras[0].camera == FOV
    result = run(sequence, load_config(algorithm="msckf"))
    ate = result.metrics["accuracy"]["none"]["ate"]
    assert ate["translation_m"]["rmse"] < 0.018
    assert ate["rotation_deg"]["rmse"] < 0.14


def test_an_euroc_folder_of_images(tmp_path: Path) -> None:
    chain = tmp_path / "chain.yaml"
    write_kalibr(rig(1, FOV), chain)
    config = SimulationConfig(kind="images", duration_s=0.2, calibration=chain)
    simulate(config).save(tmp_path / "recording")
    assert open_dataset(tmp_path / "recording").rig.cameras[0].camera == FOV


def with_plugin(folder: Path, target: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line in a Python with a package that names a camera model."""
    info = folder / "fov_plugin-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fov-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[slam_graph.camera_models]\natan_fov = {target}\n")
    (folder / "fov_camera.py").write_text((HERE / "fov_camera.py").read_text())
    paths = [str(folder), str(HERE.parent), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", "slam_graph.cli.main", *arguments]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=600, check=False
    )


@pytest.mark.parametrize(
    ("target", "fault"),
    [("fov_camera:FieldOfView", ""), ("fov_lens:FieldOfView", "cannot load fov_lens:FieldOfView")],
)
def test_an_installed_package_brings_a_model(tmp_path: Path, target: str, fault: str) -> None:
    chain = tmp_path / "chain.yaml"
    write_kalibr(rig(1, FOV), chain)
    options = ["--calibration", str(chain), "--duration", "0.2"]
    done = with_plugin(tmp_path / "site", target, "simulate", str(tmp_path / "recording"), *options)
    if fault:
        assert done.returncode != 0
        assert f"camera model 'atan_fov' of fov-plugin 1.0: {fault}" in done.stderr
        assert len(done.stderr.splitlines()) == 1
    else:
        assert done.returncode == 0, done.stderr
        assert (tmp_path / "recording").is_dir()
