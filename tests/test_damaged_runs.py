# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Short runs with damaged calibrations: a result of finite numbers, or one line that says why not.

A calibration that is read (`test_damaged_files`) may be that of other sensors, and then is wrong by
any amount.
"""

import shutil
import time
from dataclasses import astuple, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from damage import tried
from generated_rigs import rigs
from groups import slow, slow_but
from hypothesis import given
from hypothesis import strategies as st
from properties import examples, parsed, poses
from sound import sound_table, sound_trajectory

import slam_graph as sg
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.results import SavedRun
from slam_graph.sensors import ImuNoise, Rig
from slam_graph.simulation.simulator import simulate

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet", "rendered"),
]

IN_CI = 3
"""Ways in which a calibration is damaged, for each algorithm."""

MOST_S = 20.0
"""CPU that no run of two seconds may take."""

ALGORITHMS = ("msckf", "swf", "okvis", "ekf", "fixed_lag_isam2")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tracks of two cameras over two seconds, with a start that is given."""
    path = tmp_path_factory.mktemp("flight") / "flight"
    settings = {"tracks": {"features": 40}, "cameras": 2}
    simulate(trajectory="figure8", duration_s=2.0, rate_hz=10.0, seed=1, **settings).save(path)
    return path


def run_all(output: Path, sequence: RecordedSequence, algorithm: str) -> None:
    """Run, and write the results: all numbers are finite, and nothing is beside them.

    Pictures take most of the time, so the files of one algorithm stand for those of all.
    """
    shutil.rmtree(output, ignore_errors=True)
    result = sg.run(sequence, algorithm=algorithm)
    for path in (result.trajectory, result.smoothed):
        if path is not None and len(path):
            sound_trajectory(path)
    assert np.isfinite(result.points**2).all()
    sound_table(result.metrics)
    assert "\n" not in result.message
    if algorithm != "msckf":
        return
    result.save(output / "run")
    assert [path.name for path in output.iterdir()] == ["run"]
    sound_table(SavedRun(output / "run").metrics)


def without_start(flight: Path, folder: Path) -> Path:
    """A copy that has to find its start by itself."""
    shutil.copytree(flight, folder)
    (folder / "initial_state.npz").unlink()
    return folder


@pytest.mark.parametrize("start", [slow("given"), "sought"])
@pytest.mark.parametrize("algorithm", slow_but({"msckf"}, ALGORITHMS))
def test_calibrations(flight: Path, tmp_path: Path, algorithm: str, start: str) -> None:
    copied = tmp_path / "flight"
    folder = shutil.copytree(flight, copied) if start == "given" else without_start(flight, copied)
    output = tmp_path / "results"
    read = lambda: run_all(output, open_dataset(folder), algorithm)  # noqa: E731
    tried(folder / "calibration.yaml", read, IN_CI, MOST_S)


@st.composite
def wrong(draw: st.DrawFn, rig: Rig) -> Rig:
    """A rig like another: lenses, mountings, clocks and noise off by factors, some of them much."""

    def factor(most: float) -> float:
        return 10.0 ** (most * draw(st.sampled_from([0.0, 0.0, draw(st.floats(-1.0, 1.0))])))

    mounted = []
    for one in rig.cameras:
        camera, place = one.camera, one.body_T_camera
        turn = draw(st.sampled_from([gtsam.Pose3(), draw(poses(1.0))])).rotation()
        camera = replace(
            camera,
            fx=camera.fx * factor(1.0),
            fy=camera.fy * factor(0.3),
            cx=camera.cx * factor(0.3),
            coefficients=tuple(value * factor(1.0) for value in camera.coefficients),
        )
        moved = gtsam.Pose3(place.rotation().compose(turn), place.translation() * factor(4.0))
        offset_s = draw(st.sampled_from([0.0, 0.0, draw(st.floats(-3.0, 3.0))]))
        mounted.append(replace(one, camera=camera, body_T_camera=moved, time_offset_s=offset_s))
    noise = ImuNoise(*(value * factor(5.0) for value in astuple(rig.imu)))
    return Rig(tuple(mounted), noise)


@pytest.mark.parametrize("algorithm", slow_but({"msckf", "swf"}, ALGORITHMS))
@examples(4)
@given(data=st.data())
def test_calibrations_of_any_sensors(
    flight: Path, tmp_path_factory: pytest.TempPathFactory, algorithm: str, data: st.DataObject
) -> None:
    """Lenses, mountings, clocks and noise of any values that a file may have."""
    base = tmp_path_factory.getbasetemp() / f"sensors_{algorithm}"
    if not base.exists():
        base.mkdir()
        without_start(flight, base / "sought")
    rig = open_dataset(flight).rig
    write_kalibr(data.draw(wrong(rig) | wrong(rig) | rigs(2)), base / "chain.yaml")
    folder = data.draw(st.sampled_from([flight, base / "sought"]))
    begin_s = time.process_time()
    parsed(
        lambda: run_all(
            base / "results", open_dataset(folder, calibration=base / "chain.yaml"), algorithm
        )
    )
    assert time.process_time() - begin_s < MOST_S
