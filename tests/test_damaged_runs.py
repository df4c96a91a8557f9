# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Short runs with damaged calibrations: a result of finite numbers, or one line that says why not.

A calibration that is read (`test_damaged_files`) may be that of other sensors, and then is wrong by
any amount.
"""

import logging
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from damage import tried
from generated_rigs import rigs
from hypothesis import given
from hypothesis import strategies as st
from properties import examples, parsed
from sound import sound_table, sound_trajectory

import slam_graph as sg
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.results import SavedRun
from slam_graph.simulation.simulator import simulate

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

IN_CI = 4
"""Ways in which a calibration is damaged, for each algorithm."""

MOST_S = 20.0
"""CPU that no run of two seconds may take."""

ALGORITHMS = ("msckf", "swf", "okvis", "ekf", "fixed_lag_isam2")


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What runs say of wrong calibrations is not written down for each of them."""
    caplog.set_level(logging.CRITICAL, logger="slam_graph")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tracks of two cameras over two seconds, with a start that is given."""
    path = tmp_path_factory.mktemp("flight") / "flight"
    settings = {"tracks": {"features": 40}, "cameras": 2}
    simulate(trajectory="figure8", duration_s=2.0, rate_hz=10.0, seed=1, **settings).save(path)
    return path


def run_all(output: Path, sequence: RecordedSequence, algorithm: str) -> None:
    """Run, and write the results: all numbers are finite, and nothing is beside them."""
    shutil.rmtree(output, ignore_errors=True)
    result = sg.run(sequence, algorithm=algorithm)
    for path in (result.trajectory, result.smoothed):
        if path is not None and len(path):
            sound_trajectory(path)
    assert np.isfinite(result.points**2).all()
    sound_table(result.metrics)
    assert "\n" not in result.message
    result.save(output / "run")
    assert [path.name for path in output.iterdir()] == ["run"]
    sound_table(SavedRun(output / "run").metrics)


def without_start(flight: Path, folder: Path) -> Path:
    """A copy that has to find its start by itself."""
    shutil.copytree(flight, folder)
    (folder / "initial_state.npz").unlink()
    return folder


@pytest.mark.parametrize("start", ["given", "sought"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_calibrations(flight: Path, tmp_path: Path, algorithm: str, start: str) -> None:
    copied = tmp_path / "flight"
    folder = shutil.copytree(flight, copied) if start == "given" else without_start(flight, copied)
    output = tmp_path / "results"
    read = lambda: run_all(output, open_dataset(folder), algorithm)  # noqa: E731
    tried(folder / "calibration.yaml", read, IN_CI, MOST_S)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@examples(5)
@given(data=st.data())
def test_calibrations_of_any_sensors(
    flight: Path, tmp_path_factory: pytest.TempPathFactory, algorithm: str, data: st.DataObject
) -> None:
    """Lenses, mountings, clocks and noise of any values that a file may have."""
    base = tmp_path_factory.getbasetemp() / f"sensors_{algorithm}"
    if not base.exists():
        base.mkdir()
        without_start(flight, base / "sought")
    write_kalibr(data.draw(rigs(2)), base / "chain.yaml")
    folder = data.draw(st.sampled_from([flight, base / "sought"]))
    begin_s = time.process_time()
    parsed(
        lambda: run_all(
            base / "results", open_dataset(folder, calibration=base / "chain.yaml"), algorithm
        )
    )
    assert time.process_time() - begin_s < MOST_S
