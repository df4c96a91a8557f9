# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Two hours of simulated stereo: memory and cost of a frame at their end beside the beginning.

The flight is that of `growth`, in a process of its own that ends with the final bundle adjustment
and writes all its files. As a run from the command line does, it saves the estimate so far on the
way. A tenth of it is flown apart, for the peak of its memory and the cost of its adjustment.

An algorithm takes some 40 minutes, so `msckf` is measured by itself: its figures alone can be a
baseline. `long_run_others` has the other two.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import growth
from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.speed import worker
from benchmarks.suite import CORE, Benchmark, Outcome

DURATION_S = 7200.0
MEMORY_BAR, TIME_BAR = 1.15, 1.1


ALONE, OTHERS = CORE[:1], CORE[1:]
"""The algorithms of the two benchmarks."""


def measure(
    data: Path, algorithms: Sequence[str] = ALONE, duration_s: float = DURATION_S
) -> Outcome:
    """Growth of memory and of the cost of a frame.

    Args:
        data: folder of recordings; not needed.
        algorithms: those to fly with, one after the other.
        duration_s: length of the flight.
    """
    outcome = Outcome()
    for name in algorithms:
        short, long = (
            worker("benchmarks.growth_worker", name, f"{length_s:g}", "complete")
            for length_s in (duration_s / growth.PARTS, duration_s)
        )
        outcome.add(name, [*growth.figures(long), *_memory(short, long), *_adjustment(short, long)])
    outcome.notes.append(
        f"a flight of {duration_s:g} s in {growth.PARTS} parts; `memory` is what is resident in "
        "the last part over that in the second, `peak` the largest of the whole run, adjustment "
        "and files included, over that of a run of one part"
    )
    return outcome


def _memory(short: dict[str, Any], long: dict[str, Any]) -> list[Metric]:
    parts = [float(np.median(part)) for part in np.array_split(long["memory"], growth.PARTS)]
    frames = len(long["frame"]) - len(short["frame"])
    kept_kb = 1024.0 * (parts[-1] - parts[1]) / (0.8 * len(long["frame"]))
    return [
        Metric("memory", parts[-1] / parts[1], "×", "lower", MEMORY_BAR),
        Metric("peak", long["peak_mb"] / short["peak_mb"], "×", "lower", MEMORY_BAR),
        info("peak_short", short["peak_mb"], "MB"),
        info("peak_long", long["peak_mb"], "MB"),
        info("kept_per_frame", kept_kb, "kB"),
        info("peak_per_frame", 1024.0 * (long["peak_mb"] - short["peak_mb"]) / frames, "kB"),
    ]


def _adjustment(short: dict[str, Any], long: dict[str, Any]) -> list[Metric]:
    """The final bundle adjustment and the verdict: CPU time for each frame.

    As the cost of a frame, it is compared in flows that are timed between its steps, so that a
    machine that others slow down in one of the two runs does not look like growth.
    """
    a_frame = [1e3 * table["after_s"] / len(table["frame"]) for table in (short, long)]
    flow = [float(np.median(table["late_reference"])) for table in (short, long)]
    ratio = (a_frame[1] / flow[1]) / (a_frame[0] / flow[0])
    return [
        Metric("adjustment", ratio, "×", "lower", TIME_BAR, TIMING_TOLERANCE),
        info("adjustment_short", a_frame[0], "ms a frame"),
        info("adjustment_long", a_frame[1], "ms a frame"),
        info("flow_short", flow[0], "ms"),
        info("flow_long", flow[1], "ms"),
    ]


BENCHMARKS = {
    f"long_run{suffix}": Benchmark(
        f"simulated stereo flight of {DURATION_S / 3600:g} h under {' and '.join(algorithms)}: "
        "memory and cost of a frame",
        (),
        partial(measure, algorithms=algorithms),
    )
    for suffix, algorithms in (("", ALONE), ("_others", OTHERS))
}
