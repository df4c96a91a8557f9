# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The same recording, settings and seed write the same bytes, with any number of threads."""

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from groups import slow_but

from slam_graph.simulation.simulator import simulate

HANG_S = 600

ALGORITHMS = sorted(
    path.stem for path in (Path(__file__).parent.parent / "configs" / "algorithms").glob("*.yaml")
)

OF_THE_CLOCK = {"timing.csv", "config.yaml"}
"""Files that tell times, or with how many threads a run was done."""

TIMES = {"timing", "seconds", "cpu_seconds", "peak_memory_mb", "ms_per_frame"}

RUNS = """
import sys
from pathlib import Path
import cv2
import slam_graph as sg
cv2.setNumThreads(int(sys.argv[3]))
for algorithm in sys.argv[5:]:
    result = sg.run(sys.argv[1], algorithm=algorithm, overrides=["overlap=" + sys.argv[4]])
    result.save(Path(sys.argv[2]) / algorithm)
"""


BRIEF = ("fixed_lag_isam2", "msckf")
"""Algorithms that `make test` runs: one of our engine, one of GTSAM's smoothers."""


def run_all(
    algorithms: Iterable[str], recording: Path, output: Path, threads: int, overlap: bool
) -> None:
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    arguments = [str(recording), str(output), str(threads), str(overlap).lower(), *algorithms]
    done = subprocess.run(
        [sys.executable, "-c", RUNS, *arguments],
        env={**os.environ, **dict.fromkeys(names, str(threads)), "PYTHONHASHSEED": str(threads)},
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recording."""
    folder = tmp_path_factory.mktemp("repeats")
    simulate(kind="images", duration_s=2.0, rate_hz=10.0).save(folder / "flight")
    return folder


def both(root: Path, algorithm: str) -> tuple[Path, Path]:
    """The results of an algorithm, made twice together with those of its group."""
    group = {name for name in ALGORITHMS if (name in BRIEF) == (algorithm in BRIEF)}
    folder = root / ("brief" if algorithm in BRIEF else "others")
    first, second = folder / "first", folder / "second"
    if not first.exists():
        run_all(sorted(group), root / "flight", first, 1, False)
        run_all(sorted(group), root / "flight", second, 2, True)
    return first / algorithm, second / algorithm


def timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: timeless(one) for key, one in value.items() if key not in TIMES}
    return value


@pytest.mark.parametrize("algorithm", slow_but(BRIEF, ALGORITHMS))
def test_repeats_are_the_same_to_the_byte(root: Path, algorithm: str) -> None:
    first, second = both(root, algorithm)
    names = {path.name for path in first.iterdir()}
    assert names == {path.name for path in second.iterdir()}
    assert len((first / "trajectory.tum").read_text().splitlines()) > 10
    for name in names - OF_THE_CLOCK - {"metrics.json"}:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    one, other = (json.loads((folder / "metrics.json").read_text()) for folder in (first, second))
    assert timeless(one) == timeless(other)
