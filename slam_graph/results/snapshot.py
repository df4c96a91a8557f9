# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What there is of a run that goes on: a valid result that says that it is unfinished."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slam_graph.kernels.free_memory import give_back
from slam_graph.results import result_files as names
from slam_graph.results.folders_written import GOES_ON
from slam_graph.results.map_output import PointMap
from slam_graph.results.run_files import save_causal, save_frames, save_rigs
from slam_graph.results.run_input import Ending
from slam_graph.results.run_result import RunResult


def save_so_far(result: RunResult, folder: Path, wall_s: float) -> None:
    """Write the causal estimate so far, with the status `unfinished`; the run is not changed.

    The points are left out: to count them would put them into another order.

    Args:
        result: of a run that goes on.
        folder: of its files; each is whole at all times, the metrics first.
        wall_s: time that the run has taken so far, s.

    Raises:
        DataError: if the folder has a result of another kind, or a file cannot be written.
    """
    ending = Ending("unfinished", GOES_ON.format(kind="run"), None, wall_s)
    now = replace(result, ending=ending, point_map=PointMap())
    try:
        _write(now, folder)
    finally:
        del now
        give_back()


def _write(now: RunResult, folder: Path) -> None:
    """The files that there are of an unfinished run."""
    files = now.folders_written.begin(folder, "run")
    now.folders_written.write_metrics(files, now.metrics)
    files.text(names.CONFIG, [now.config.as_yaml()])
    save_rigs(now, files)
    save_causal(now, files)
    save_frames(now, files)
