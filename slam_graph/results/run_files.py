# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a run.

Until all of them are there `metrics.json` has the status `unfinished`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slam_graph.datasets import kalibr_text
from slam_graph.files import Files
from slam_graph.kernels.free_memory import give_back
from slam_graph.results import result_files as names
from slam_graph.results.map_output import save_map, write_ply
from slam_graph.results.object_files import save_objects
from slam_graph.results.result_files import MAP_NAME, ResultFolder

if TYPE_CHECKING:
    from slam_graph.results.run_result import RunResult


def save_run(result: RunResult, folder: Path) -> list[Path]:
    """Write all files of a run, in the place of those of another one (`earlier_result.py`).

    What the run itself wrote there stays, such as its log and its recording for the viewer.

    Args:
        result: of a run that ended.
        folder: made if it is missing.

    Returns:
        The files, in the order in which they were written.

    Raises:
        DataError: if the folder has a result of another kind, or a file cannot be written or
            removed.
    """
    with result.folders_written.complete(folder, "run", result.metrics) as files:
        _save_estimate(result, files)
        give_back()  # what the run and the files took: Matplotlib takes 25 MB more
        with files.appearing("trajectory.png") as partial:
            result.plot().write(partial)
        if result.slam_map is not None:  # last: it is the file that a full disk is too small for
            save_map(result.slam_map, files.path(MAP_NAME), force=True)
    return files.files


def _save_estimate(result: RunResult, files: ResultFolder) -> None:
    """All files but the metrics, the picture and the map."""
    _save_trajectories(result, files)
    if result.localization is not None:
        files.text(names.IN_MAP, result.localization.trajectory().tum_lines())
        files.text("localization.csv", result.localization.csv_lines())
    if result.objects is not None:
        save_objects(files, result.objects)
    save_frames(result, files)
    files.text(names.CONFIG, [result.config.as_yaml()])
    save_rigs(result, files)
    if result.final_ba is not None and result.final_ba.fitting is not None:
        files.text(names.ADJUSTED_RIG, [kalibr_text(result.final_ba.fitting)])
    if result.logs.calibration.latest is not None:
        files.text("calibration.csv", result.logs.calibration.csv_lines())
    for stamp_ns, graph in result.graphs.items():
        for name, text in graph.texts().items():
            files.text(f"graph_{stamp_ns}_{name}", [text])


def _save_trajectories(result: RunResult, files: ResultFolder) -> None:
    """The causal, the smoothed and the loop-closed trajectory, with states and points."""
    save_causal(result, files)
    if len(result.segments) > 1:
        for number, segment in enumerate(result.segments):
            part = segment.part_of(result.trajectory)
            files.text(f"trajectory_segment_{number}.tum", part.tum_lines())
    if result.final_ba is not None:
        files.text(names.SMOOTHED, result.final_ba.trajectory.tum_lines())
        files.text(names.SMOOTHED_STATES, names.state_lines(result.final_ba.history))
    if result.loops is not None and result.loop_closed is not None:
        files.text(names.LOOP_CLOSED, result.loop_closed.tum_lines())
        files.text(names.LOOPS, result.loops.csv_lines())
        write_ply(files.path(names.LOOP_POINTS), result.loops.points())


def save_causal(result: RunResult, files: ResultFolder) -> None:
    """The causal trajectory, its states, and where it was lost and started again."""
    files.text(names.TRAJECTORY, result.trajectory.tum_lines())
    files.text(names.STATES, names.state_lines(result.history))
    files.text(names.SEGMENTS, result.segments.csv_lines(result.trajectory))


def save_frames(result: RunResult, files: ResultFolder) -> None:
    """Ground truth and points, times, and what the back end did in each frame."""
    if result.groundtruth is not None:
        files.text(names.GROUNDTRUTH, result.groundtruth.tum_lines())
    write_ply(files.path(names.POINTS), result.points)
    files.text(names.TIMING, result.logs.timing.csv_lines())
    rows = result.logs.by_frame.csv_lines(result.keyframes_ns, result.nees_series)
    files.text(names.FRAMES, rows)


def save_rigs(result: RunResult, files: ResultFolder) -> None:
    """The calibration from before the run, and that at its end if it is another one."""
    files.text(names.RIG, [kalibr_text(result.rig)])
    if result.estimated_rig is not result.rig:
        files.text(names.ESTIMATED_RIG, [kalibr_text(result.estimated_rig)])
        return
    with Files.writing(files.folder / names.ESTIMATED_RIG):  # of a start that was given up
        (files.folder / names.ESTIMATED_RIG).unlink(missing_ok=True)
