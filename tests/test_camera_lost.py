# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Two cameras of which one is lost for good: the other one carries the run alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam_graph.config import load_config
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.faults.injection import inject
from slam_graph.pipeline.run_recording import run
from slam_graph.results.run_result import RunResult
from slam_graph.simulation import simulate

AT_S = 3.0


@pytest.fixture(scope="module")
def tracks() -> RecordedSequence:
    return simulate(trajectory="figure8", cameras=2, duration_s=8.0, seed=1)


def ate_m(result: RunResult) -> float:
    assert result.status == "ok", result.message
    result.check()
    return float(result.metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"])


@pytest.mark.data
@pytest.mark.parametrize("algorithm", ["msckf", "okvis"])
def test_no_matter_which_camera_of_real_images_is_lost(data_dir: Path, algorithm: str) -> None:
    folder = data_dir / "euroc" / "MH_01_easy_17s"
    config = load_config(algorithm=algorithm, duration_s=9.0, overrides=["final_ba.enabled=false"])
    errors = []
    for camera in (0, 1):
        fault = f"camera_lost:at_s={AT_S},duration_s=60,camera={camera}"
        errors.append(ate_m(run(open_dataset(folder, faults=[fault]), config)))
    assert errors[0] < 2.0 * errors[1]
