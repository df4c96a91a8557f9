# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The content of `metrics.json`: what was measured, in tables that JSON can hold.

The functions take what they measure, not a result, so that any kind of result can use them.
"""

from __future__ import annotations

import importlib
import math
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam_graph import evaluation
from slam_graph.errors import DataError
from slam_graph.geometry import StateHistory, Trajectory
from slam_graph.results.segments import Segment, Segments
from slam_graph.version import __version__

if TYPE_CHECKING:
    import gtsam

    from slam_graph.backend import FinalBa
    from slam_graph.loop_closure import LoopClosures
    from slam_graph.results.run_input import RunInput
    from slam_graph.results.run_logs import RunLogs

SCHEMA_VERSION = 4
"""Counts up whenever a key changes its name or meaning."""

_RECORDED_PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "scipy")

Table = dict[str, Any]


def finite(value: Any) -> Any:
    """The same tables and lists with None for numbers that are not finite, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    table = {"slam_graph": __version__, "python": platform.python_version()}
    for package in _RECORDED_PACKAGES:
        try:
            table[package] = version(package)
        except PackageNotFoundError:
            table[package] = "unknown"
    return table


def peak_memory_mb() -> float | None:
    """Largest resident size of this process so far, in MB; None where the system does not tell.

    On Linux it is read from /proc: `getrusage` would give the peak of the parent process where
    that was larger. Windows has neither.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("VmHWM:"):
            return float(line.split()[1]) / 1024.0
    try:
        resource = importlib.import_module("resource")
    except ImportError:
        return None
    peak: int = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def accuracy_table(
    truth: Trajectory | None,
    trajectory: Trajectory | None,
    scaled_camera: gtsam.Pose3 | None = None,
    breaks_ns: Sequence[int] = (),
) -> Table | None:
    """Errors against ground truth, or None where there is nothing to compare.

    Args:
        truth: the true trajectory.
        trajectory: the estimate.
        scaled_camera: see `evaluation.accuracy_report`.
        breaks_ns: times between its worlds.
    """
    if truth is None or trajectory is None or len(trajectory) == 0:
        return None
    return evaluation.accuracy_report(truth, trajectory, scaled_camera, breaks_ns)


def consistency_table(
    truth: Trajectory | None,
    history: StateHistory,
    given: bool,
    smoothed: FinalBa | None = None,
    breaks_ns: Sequence[int] = (),
) -> Table | None:
    """NEES against ground truth, or None where there is nothing to compare.

    Args:
        truth: the true trajectory.
        history: the estimate with its covariances.
        given: whether the start was given in the world of the truth.
        smoothed: the smoothed trajectory of the run, by which `nees_of_run` aligns.
        breaks_ns: times between worlds.
    """
    if truth is None or len(history) == 0:
        return None
    try:
        return evaluation.consistency_report(truth, history, given, smoothed, breaks_ns)
    except DataError as error:
        return {"unavailable": str(error)}


def extent_table(
    asked: RunInput, offset_ns: int, frames: int, trajectory: Trajectory, segments: Segments
) -> Table:
    """How much was asked for, read and estimated.

    Args:
        asked: the part of a recording that was asked for.
        offset_ns: time of a state since the stamp of its frame.
        frames: that were read.
        trajectory: that was estimated.
        segments: its stretches.
    """
    stamps = trajectory.stamps_ns
    started = len(stamps) > 0
    return {
        "start_ns": asked.start_ns,
        "end_ns": asked.end_ns,
        "recorded_s": asked.recorded_s,
        "frames": frames,
        "estimated_frames": len(stamps),
        "estimated_s": segments.seconds,
        "coverage": coverage(asked.start_ns, asked.end_ns, segments),
        "initialization_s": float(stamps[0] - asked.start_ns - offset_ns) * 1e-9
        if started
        else None,
    }


def world_table(
    history: StateHistory, given: bool, of_truth: bool, breaks_ns: Sequence[int] = ()
) -> Table:
    """In which world the estimate lives, and the alignment with a truth that follows from it.

    Args:
        history: the causal estimate.
        given: whether the start was given.
        of_truth: whether the estimate lives in the world of the truth.
        breaks_ns: times from which on it lives in another one, of which nothing is known.
    """
    aligned = of_truth and history.has_scale and not breaks_ns
    return {
        "start_was_given": given,
        "world_breaks_ns": list(breaks_ns),
        "alignment": "none" if aligned else history.free,
        "unmeasured": history.free,
        "scale": "metres" if history.has_scale else "unknown",
    }


def coverage(start_ns: int, end_ns: int, segments: Segments) -> float:
    """Estimated time over the time asked for, from 0 to 1; what lies between segments is not."""
    if not len(segments):
        return 0.0
    if end_ns <= start_ns:
        return 1.0
    return min(segments.seconds / ((end_ns - start_ns) * 1e-9), 1.0)


def segments_table(
    segments: Segments,
    trajectory: Trajectory,
    truth: Trajectory | None,
    scaled_camera: gtsam.Pose3 | None = None,
    smoothed: Trajectory | None = None,
) -> list[Table]:
    """What each segment reached, each aligned on its own; empty for a run in one piece.

    Args:
        segments: of the run.
        trajectory: the causal estimate.
        truth: the true trajectory.
        scaled_camera: see `evaluation.accuracy_report`.
        smoothed: the smoothed trajectory.
    """
    if len(segments) < 2:
        return []

    def errors(segment: Segment, path: Trajectory | None) -> Table | None:
        part = None if path is None else segment.part_of(path)
        return accuracy_table(truth, part, scaled_camera)

    return [
        {
            "begin_ns": segment.begin_ns,
            "end_ns": segment.end_ns,
            "joined_by": segment.joined_by,
            "ended_by": segment.ended_by,
            "accuracy": errors(segment, trajectory),
            "smoothed": errors(segment, smoothed),
        }
        for segment in segments
    ]


def final_ba_table(
    final_ba: FinalBa | None,
    truth: Trajectory | None,
    breaks_ns: Sequence[int] = (),
    *,
    of_truth: bool = False,
) -> Table | None:
    """Size, cost, accuracy and consistency of the final bundle adjustment, if there was one.

    Args:
        final_ba: the adjustment.
        truth: the true trajectory.
        breaks_ns: times between worlds.
        of_truth: whether position fixes or known poses tell the world of the truth.
    """
    if final_ba is None:
        return None
    camera = final_ba.history.scaled_camera
    accuracy = accuracy_table(truth, final_ba.trajectory, camera, breaks_ns)
    nees = consistency_table(
        truth, final_ba.history, of_truth and final_ba.absolute, final_ba, breaks_ns
    )
    fixes = {} if final_ba.fixes is None else {"fixes": final_ba.fixes.table()}
    checked = final_ba.calibration
    calibration = {
        "calibration": None if checked is None else checked.table(),
        "calibration_faults": [fault.what for fault in final_ba.calibration_faults],
    }
    of_fit = {"accuracy": accuracy, "nees": nees, **calibration}
    return {**asdict(final_ba.summary), **of_fit, **fixes}


def loop_closure_table(
    loops: LoopClosures | None,
    corrected: Trajectory | None,
    truth: Trajectory | None,
    scaled_camera: gtsam.Pose3 | None = None,
    breaks_ns: Sequence[int] = (),
) -> Table | None:
    """What loop closure found and reached, if loops were to be closed.

    Args:
        loops: what was found.
        corrected: the trajectory after loop closure.
        truth: the true trajectory.
        scaled_camera: see `evaluation.accuracy_report`.
        breaks_ns: times between the worlds that are left.
    """
    if loops is None or corrected is None:
        return None
    return {
        "keyframes": len(loops.keyframes),
        "verified": len(loops.loops),
        "accepted": int(loops.accepted.sum()),
        "world_breaks_ns": list(breaks_ns),
        "accuracy": accuracy_table(truth, corrected, scaled_camera, breaks_ns),
    }


def timing_table(logs: RunLogs, start_ns: int, wall_s: float) -> Table:
    """Speed as a whole and by stage.

    `real_time_factor` is the recorded time that was worked through in a second: above 1 is faster
    than real time.
    """
    last_ns = start_ns if logs.last_frame_ns is None else logs.last_frame_ns
    return {
        "wall_s": wall_s,
        "frames_per_s": logs.frames / wall_s if wall_s > 0 else None,
        "real_time_factor": (last_ns - start_ns) * 1e-9 / wall_s if wall_s > 0 else None,
        "stages": {stage: asdict(times) for stage, times in logs.timing.summary().items()},
    }
