# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The speed of the whole pipeline on one core, and the memory that it takes.

Three runs for each algorithm with two cameras, each in a fresh process (`speed_worker`). Two are of
the causal part, start-up included, the final bundle adjustment not: one as it ships, with images
decoded in a thread on the same core, for the real-time factor and the peak of memory; and one that
decodes in turn and is interleaved with a reference computation (one Lucas-Kanade flow of 200 points
on the same images), whose median time is the unit in which all else is told. That unit and the
costs of frames are CPU times, so that other programs lengthen neither. The third run is the first
one with the final bundle adjustment at its end. The second one alone tells the costs with one
camera, and those of a short part of the recording, by which every change is judged.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.suite import CORE, UNBOUNDED, Benchmark, Outcome
from slam_graph.arrays import FloatArray
from slam_graph.errors import EstimationError

RECORDING = "euroc/MH_01_easy_17s"

COST_BARS = {
    ("msckf", 2): 3.6,
    ("swf", 2): 4.0,
    ("okvis", 2): 5.5,
    ("msckf", 1): 2.8,
}
"""Of `cost_mean`, by algorithm and number of cameras; 2.8 is that of OpenVINS with two."""
PROFILED = "msckf"
"""Whose longest functions are listed."""
OVERLAPPED, OVERLAP_BAR = "msckf", 2.8
"""What is run with front and back end in two processes, and the bar of the time of a frame."""

MEMORY_BAR_MB = 250.0

QUICK_S, QUICK_TOLERANCE, QUICK_RUNS = 8.0, 0.5, 2
"""Length, tolerance and repetitions of the run by which every change is judged."""

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
PART_TOLERANCE = 1.0
"""Of the parts of a frame, some of which are small."""

UNIT = "× LK"

ATTEMPTS = 3
"""How often a run is repeated that had to share its core with other programs."""

ENOUGH_SHARE = 0.95
"""Part of the time that a run must have had its core to count as undisturbed."""


def stereo(data: Path) -> Outcome:
    """Real-time factor, peak memory, and where the time of a frame goes, with two cameras."""
    outcome = Outcome()
    for name in (*CORE, *UNBOUNDED):
        shipped = undisturbed("shipped", data / RECORDING, name)
        timed = undisturbed("interleaved", data / RECORDING, name)
        complete = undisturbed("complete", data / RECORDING, name)
        figures = (
            *whole(shipped),
            *parts(timed, COST_BARS.get((name, 2))),
            *with_adjustment(complete),
        )
        outcome.metrics += [m.under(name) for m in figures]
        outcome.notes += [
            f"{name}: {shipped['recorded_s']:.1f} s recorded took {shipped['wall_s']:.1f} s; the "
            f"runs had their core for {share(shipped):.0%} and {share(timed):.0%} of the time "
            "(below 95%: other programs were running, and the real-time factor is too low)"
        ]
    for place, row in enumerate(profile(data / RECORDING), 1):
        name, calls, part = row
        key = f"{PROFILED}.profile_{place}"
        outcome.add(key, [info("calls", calls, "a frame"), info("share", 100.0 * part, "%")])
        outcome.texts[f"{key}.name"] = name
    outcome.notes += [
        "bars apply to `cost_mean`: mean over all frames, start-up included, without decoding of "
        "PNG files, as the figure known of OpenVINS (2.8) is; nor is the final bundle adjustment "
        "in it",
        "`part_*` are means over all frames and add up to `cost_mean_decoding`",
    ]
    return outcome


def profile(recording: Path) -> list[tuple[str, float, float]]:
    """The functions with the most time of their own: name, calls a frame, share of the time."""
    found: list[tuple[str, float, float]] = worker(
        "benchmarks.speed_worker", "profiled", str(recording), PROFILED
    )["functions"]
    return found


def mono(data: Path) -> Outcome:
    """Where the time of a frame goes with one camera."""
    outcome = Outcome()
    for name in (*CORE, *UNBOUNDED):
        timed = undisturbed("interleaved", data / RECORDING, name, "1")
        outcome.add(name, parts(timed, COST_BARS.get((name, 1))))
    return outcome


def quick(data: Path) -> Outcome:
    """The cost of a frame on a short part of the recording: the least of a few runs."""
    arguments = (str(data / RECORDING), "msckf", "2", f"{QUICK_S:g}")
    costs = []
    for _ in range(QUICK_RUNS):
        timed = worker("benchmarks.speed_worker", "interleaved", *arguments)
        costs.append(next(m.value for m in parts(timed) if m.key == "cost_mean"))
    return Outcome([Metric("cost_mean", min(costs), UNIT, "lower", None, QUICK_TOLERANCE)])


def overlap(data: Path) -> Outcome:
    """Time of a frame by the wall clock, with the front end in a process of its own and without."""
    outcome = Outcome()
    table = worker("benchmarks.overlap_worker", str(data / RECORDING), OVERLAPPED)
    outcome.add(OVERLAPPED, overlap_figures(table))
    busy = max(run["cpu"] / run["wall"] for run in table["in_turn"])
    outcome.notes += [
        f"images are decoded before; {table['cores']} cores; runs in turn had theirs for at most "
        f"{busy:.0%} of the time (below 95%: other programs were running, and all times by the "
        "wall clock are too long)"
    ]
    return outcome


def overlap_figures(table: dict[str, Any]) -> list[Metric]:
    """The figures of runs with and without overlap, as multiples of the reference.

    Args:
        table: milliseconds of `reference` (M,); and for each run `in_turn` and `overlapped`
            milliseconds a frame, `wall`, `cpu` and `cpu_front_end`.
    """
    unit_ms = float(np.median(table["reference"]))

    def least(kind: str, key: str) -> float:
        return min(float(run[key]) for run in table[kind]) / unit_ms

    wall, before = least("overlapped", "wall"), least("in_turn", "wall")
    return [
        Metric("wall_overlapped", wall, UNIT, "lower", OVERLAP_BAR, TIMING_TOLERANCE),
        info("wall_in_turn", before, UNIT),
        info("wall_ratio", wall / before, "overlapped / in turn"),
        info("cpu_in_turn", least("in_turn", "cpu"), UNIT),
        info("cpu_back_end", least("overlapped", "cpu"), UNIT),
        info("cpu_front_end", least("overlapped", "cpu_front_end"), UNIT),
    ]


def whole(shipped: dict[str, Any]) -> list[Metric]:
    """The figures of the run as it ships."""
    speed = shipped["recorded_s"] / shipped["wall_s"]
    by_cpu = shipped["recorded_s"] / shipped["cpu_s"]
    return [
        info("real_time_factor", speed, "× real time"),
        info("real_time_factor_cpu", by_cpu, "× real time"),
        info("seconds", shipped["wall_s"], "s wall"),
        Metric("peak_memory", shipped["peak_mb"], "MB", "lower", MEMORY_BAR_MB),
    ]


def with_adjustment(complete: dict[str, Any]) -> list[Metric]:
    """The same figures of the run that ends with the bundle adjustment."""
    return [
        info("seconds_with_adjustment", complete["wall_s"], "s wall"),
        info("peak_memory_with_adjustment", complete["peak_mb"], "MB"),
    ]


def parts(timed: dict[str, Any], bar: float | None = None) -> list[Metric]:
    """The figures of the interleaved run, as multiples of the reference.

    Args:
        timed: CPU milliseconds of `reference` (M,), `frame` (N,) and its part `decoding` (N,); and
            `stages` as `partition` takes them.
        bar: of the mean without decoding.
    """
    unit_ms = float(np.median(timed["reference"]))
    with_decoding = np.array(timed["frame"]) / unit_ms
    without = with_decoding - np.array(timed["decoding"]) / unit_ms
    stages = {name: np.array(values, float) for name, values in timed["stages"].items()}
    scale = with_decoding.mean() / stages["frame"].mean()

    def cost(key: str, value: float, bar: float | None = None) -> Metric:
        return Metric(key, float(value), UNIT, "lower", bar, TIMING_TOLERANCE)

    split = {key: values.mean() * scale for key, values in partition(stages).items()}
    return [
        cost("cost_mean", without.mean(), bar),
        cost("cost_median", np.median(without)),
        cost("cost_mean_decoding", with_decoding.mean()),
        cost("cost_median_decoding", np.median(with_decoding)),
        info("reference", unit_ms, "ms = 1 LK"),
        info("frame_mean", float(with_decoding.mean()) * unit_ms, "ms"),
        *(
            Metric(f"part_{key}", float(value), UNIT, "lower", None, PART_TOLERANCE)
            for key, value in split.items()
        ),
    ]


def share(table: dict[str, Any]) -> float:
    """Which part of the time of a run its process was computing: 1 if nobody disturbed it."""
    return float(table["cpu_s"] / table["wall_s"])


def partition(stages: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The time of each frame divided among what it was spent on: milliseconds (N,) by name.

    Args:
        stages: milliseconds by the wall clock (N,) of `frame`, `read`, its part `decoding`,
            `frontend`, `backend`, and the parts of these two as `frontend.x` and `backend.x`, NaN
            where one did not run.
    """
    rest = {
        "reading_other": stages["read"] - stages["decoding"],
        "frontend_other": stages["frontend"].copy(),
        "backend_other": stages["backend"].copy(),
        "other": stages["frame"] - stages["read"] - stages["frontend"] - stages["backend"],
    }
    named = {"decoding": stages["decoding"]}
    for stage in sorted(stages):
        parent, _, child = stage.partition(".")
        if child:
            named[f"{parent}_{child}"] = np.nan_to_num(stages[stage])
            rest[f"{parent}_other"] -= named[f"{parent}_{child}"]
    return named | rest


def undisturbed(mode: str, recording: Path, *arguments: str) -> dict[str, Any]:
    """The least disturbed of a few runs of `worker`; the first one if it had its core for itself.

    Which run is taken depends on what else the machine did, not on how fast the run was.
    """
    tables: list[dict[str, Any]] = []
    while len(tables) < ATTEMPTS and not (tables and share(tables[-1]) >= ENOUGH_SHARE):
        tables.append(worker("benchmarks.speed_worker", mode, str(recording), *arguments))
    return max(tables, key=share)


def worker(module: str, *arguments: str) -> dict[str, Any]:
    """Run a module in a fresh process, and read what it prints.

    Args:
        module: e.g. ``benchmarks.speed_worker``.
        arguments: of its command line.

    Raises:
        EstimationError: if the run did not end well, with what it said.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=Path(__file__).resolve().parent.parent,
        env=os.environ | ONE_THREAD,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise EstimationError(f"{module} {' '.join(arguments)} could not measure: {last}")
    table: dict[str, Any] = json.loads(done.stdout)
    return table


BENCHMARKS = {
    "speed_mh01_stereo": Benchmark(
        "MH_01 stereo on one core: real-time factor, cost in Lucas-Kanade flows, peak memory",
        (RECORDING,),
        stereo,
    ),
    "speed_mh01_mono": Benchmark(
        "MH_01 with one camera on one core: cost in Lucas-Kanade flows", (RECORDING,), mono
    ),
    "speed_overlap": Benchmark(
        "MH_01 stereo on two cores, front end beside the back end: time in Lucas-Kanade flows",
        (RECORDING,),
        overlap,
    ),
    "speed_quick": Benchmark(
        f"{QUICK_S:g} s of MH_01 stereo on one core: cost in Lucas-Kanade flows",
        (RECORDING,),
        quick,
        quick=True,
    ),
}
