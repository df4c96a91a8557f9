# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What there is of a run that goes on: a valid result that says that it is unfinished."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slam_graph.datasets import kalibr_text
from slam_graph.results import result_files as names
from slam_graph.results.free_memory import give_back
from slam_graph.results.map_output import PointMap, write_ply
from slam_graph.results.result_files import ResultFolder
from slam_graph.results.run_input import Ending
from slam_graph.results.run_result import RunResult

_MESSAGE = "the run goes on, or was ended before its files were complete"


def save_so_far(result: RunResult, folder: Path, wall_s: float) -> None:
    """Write the causal estimate so far, with the status `unfinished`; the run is not changed.

    The points are left out: to count them would put them into another order.

    Args:
        result: of a run that goes on.
        folder: of its files; each is whole at all times, the metrics first.
        wall_s: time that the run has taken so far, s.

    Raises:
        DataError: if a file cannot be written.
    """
    now = replace(result, ending=Ending("unfinished", _MESSAGE, None, wall_s), point_map=PointMap())
    try:
        _write(now, ResultFolder(folder))
    finally:
        del now
        give_back()


def _write(now: RunResult, files: ResultFolder) -> None:
    """The files that there are of an unfinished run."""
    files.json(names.METRICS, now.metrics)
    files.text(names.CONFIG, [now.config.as_yaml()])
    files.text(names.RIG, [kalibr_text(now.rig)])
    files.text(names.TRAJECTORY, now.trajectory.tum_lines())
    files.text(names.STATES, names.state_lines(now.history))
    files.text(names.SEGMENTS, now.segments.csv_lines(now.trajectory))
    if now.groundtruth is not None:
        files.text(names.GROUNDTRUTH, now.groundtruth.tum_lines())
    write_ply(files.path(names.POINTS), now.points)
    files.text(names.TIMING, now.logs.timing.csv_lines())
    files.text(names.FRAMES, now.logs.by_frame.csv_lines(now.keyframes_ns, now.nees_series))
