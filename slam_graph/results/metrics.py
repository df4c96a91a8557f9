# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The content of `metrics.json`: what was measured in a run, under a versioned schema."""

from __future__ import annotations

import math
import platform
import resource
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from slam_graph.errors import DataError
from slam_graph.evaluation.evaluation_report import (
    accuracy_report,
    consistency_report,
    innovation_report,
)
from slam_graph.version import __version__

if TYPE_CHECKING:
    from slam_graph.results.run_result import RunResult

SCHEMA_VERSION = 1
"""Counts up whenever a key changes its name or meaning."""

RECORDED_PACKAGES = ("gtsam", "numpy", "opencv-python-headless", "scipy")

Table = dict[str, Any]


def metrics_table(result: RunResult) -> Table:
    """All metrics of a run; JSON can hold every value of it."""
    table: Table = finite(
        {
            "schema_version": SCHEMA_VERSION,
            "status": result.status,
            "message": result.message,
            "dataset": asdict(result.info),
            "algorithm": result.config.algorithm.name,
            "cameras": len(result.rig.cameras),
            "seed": result.config.seed,
            "extent": _extent(result),
            "accuracy": _accuracy(result),
            "final_ba": _final_ba(result),
            "loop_closure": _loop_closure(result),
            "slam_map": None if result.slam_map is None else result.slam_map.summary(),
            "localization": _localization(result),
            "nees": _nees(result),
            "nis": innovation_report(result.innovations.columns()),
            "calibration": result.calibration.table(),
            "timing": _timing(result),
            "features_per_frame": _per_frame(result),
            "map_points": len(result.points),
            "warnings": dict(sorted(result.warnings.items())),
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            "versions": versions(),
        }
    )
    return table


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    table = {"slam_graph": __version__, "python": platform.python_version()}
    for package in RECORDED_PACKAGES:
        try:
            table[package] = version(package)
        except PackageNotFoundError:
            table[package] = "unknown"
    return table


def finite(value: Any) -> Any:
    """The same tables and lists with None for numbers that are not finite, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _extent(result: RunResult) -> Table:
    """How much was asked for, read and estimated."""
    stamps = result.trajectory.stamps_ns
    started = len(stamps) > 0
    return {
        "start_ns": result.start_ns,
        "end_ns": result.end_ns,
        "recorded_s": result.recorded_s,
        "frames": result.frames,
        "estimated_frames": len(stamps),
        "estimated_s": float(stamps[-1] - stamps[0]) * 1e-9 if started else 0.0,
        "coverage": result.coverage,
        "initialization_s": float(stamps[0] - result.start_ns) * 1e-9 if started else None,
        "start_was_given": result.start_was_given,
    }


def _accuracy(result: RunResult) -> Table | None:
    """Errors against ground truth, or None where there is nothing to compare."""
    truth = result.truth_of_run()
    if truth is None or len(result.history) == 0:
        return None
    return accuracy_report(truth, result.trajectory)


def _final_ba(result: RunResult) -> Table | None:
    """What the bundle adjustment over the whole recording took and reached, if there was one."""
    if result.final_ba is None:
        return None
    trajectory, truth = result.final_ba.trajectory, result.truth_of_run()
    accuracy = None if truth is None else accuracy_report(truth, trajectory)
    return {**asdict(result.final_ba.summary), "accuracy": accuracy}


def _loop_closure(result: RunResult) -> Table | None:
    """What loop closure found and reached, if loops were to be closed."""
    loops, truth = result.loops, result.truth_of_run()
    if loops is None:
        return None
    corrected = loops.correct(result.best_trajectory)
    return {
        "keyframes": len(loops.keyframes),
        "verified": len(loops.loops),
        "accepted": int(loops.accepted.sum()),
        "accuracy": None if truth is None else accuracy_report(truth, corrected),
    }


def _localization(result: RunResult) -> Table | None:
    """Where the run was in a known map, if it was to be located in one."""
    if result.localization is None:
        return None
    return result.localization.table(result.start_ns, result.frames, result.truth)


def _nees(result: RunResult) -> Table | None:
    """Consistency with ground truth, or None where there is nothing to compare."""
    truth = result.truth_of_run()
    if truth is None or len(result.history) == 0:
        return None
    try:
        return consistency_report(truth, result.history, aligned=result.start_was_given)
    except DataError as error:
        return {"unavailable": str(error)}


def _timing(result: RunResult) -> Table:
    """Speed as a whole and by stage.

    `real_time_factor` is the recorded time that was worked through in a second: above 1 is faster
    than real time.
    """
    last_ns = result.start_ns if result.last_frame_ns is None else result.last_frame_ns
    wall_s = result.wall_s
    return {
        "wall_s": wall_s,
        "frames_per_s": result.frames / wall_s if wall_s > 0 else None,
        "real_time_factor": (last_ns - result.start_ns) * 1e-9 / wall_s if wall_s > 0 else None,
        "stages": {stage: asdict(times) for stage, times in result.timing.summary().items()},
    }


def _per_frame(result: RunResult) -> Table:
    """Mean counts a frame of the front end."""
    frames = max(result.frames, 1)
    return {name: total / frames for name, total in sorted(result.features.items())}
