# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of a long run beside that of a shorter one: what is kept of a frame must be little.

A monocular flight is simulated while it is read, at 10 Hz with 40 features so that half an hour is
done in minutes; each run is in a process of its own (`memory_worker`) and writes all its files.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.metric import Metric, info
from benchmarks.speed import worker
from benchmarks.suite import Benchmark, Outcome

SHORT_S, LONG_S = 300.0, 1800.0

RATIO_BAR = 1.2

ALGORITHMS = ("msckf", "swf", "okvis")


def measure(data: Path, short_s: float = SHORT_S, long_s: float = LONG_S) -> Outcome:
    """Peak of resident memory of the long run over that of the short one.

    Args:
        data: folder of recordings; not needed.
        short_s: length of the short flight.
        long_s: length of the long flight.
    """
    outcome = Outcome()
    for name in ALGORITHMS:
        short, long = (
            worker("benchmarks.memory_worker", name, f"{length_s:g}")
            for length_s in (short_s, long_s)
        )
        frames, grown_mb = long["frames"] - short["frames"], long["peak_mb"] - short["peak_mb"]
        figures = [
            Metric("growth", long["peak_mb"] / short["peak_mb"], "×", "lower", RATIO_BAR),
            info("peak_short", short["peak_mb"], "MB"),
            info("peak_long", long["peak_mb"], "MB"),
            info("per_frame", 1024.0 * grown_mb / frames, "kB"),
            info("frame", 1e3 * long["wall_s"] / long["frames"], "ms"),
        ]
        outcome.add(name, figures)
    outcome.notes.append(f"flights of {short_s:g} and {long_s:g} s")
    return outcome


BENCHMARKS = {
    "memory": Benchmark(
        f"simulated flights of {SHORT_S / 60:g} and {LONG_S / 60:g} min: peak of memory of both",
        (),
        measure,
    )
}
