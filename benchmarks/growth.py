# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a frame costs in the last minutes of ten, over what it costs in the third to fifth.

Stereo tracks are simulated while they are read, and each algorithm flies in a process of its own
(`growth_worker`). Frames are timed in CPU time, and in the unit of a flow that is timed between
them, so that neither other programs nor a processor that gets slower look like growth. The first
two minutes are shown but not compared with: the check of the calibration runs in them and costs
more than the filter (`StartCalibration` gives up after 1200 rotations).
`cost_over_time` looks at a minute of all algorithms, those that grow among them; `memory` at the
memory of half an hour.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.speed import worker
from benchmarks.suite import CORE, Benchmark, Outcome
from slam_graph.arrays import FloatArray

DURATION_S = 600.0
PARTS = 10
"""The flight is looked at in so many parts of equal length: minutes."""

EARLY, LATE = slice(2, 5), slice(7, 10)
"""The parts that are compared, by the median of each three: one may be disturbed."""

FLAT_BAR = 1.1


def measure(data: Path, duration_s: float = DURATION_S) -> Outcome:
    """Growth of the cost of a frame for each algorithm whose state is bounded.

    Args:
        data: folder of recordings; not needed.
        duration_s: length of the flight.
    """
    outcome = Outcome()
    for name in CORE:
        table = worker("benchmarks.growth_worker", name, f"{duration_s:g}")
        outcome.add(name, figures(table))
    outcome.notes.append(
        f"a flight of {duration_s:g} s in {PARTS} parts; `growth`: the last three over the third "
        "to fifth, medians over frames and parts; the simulation of tracks is in the costs; other "
        "programs on the machine take the caches, which shows in CPU times too"
    )
    return outcome


def figures(table: dict[str, Any]) -> list[Metric]:
    """The growth of one algorithm.

    Args:
        table: CPU milliseconds of each `frame` (N,), and of the `reference` (M,) at equal
            distances between them.
    """
    costs = costs_of_parts(np.array(table["frame"]), np.array(table["reference"]))
    growth = float(np.median(costs[LATE]) / np.median(costs[EARLY]))
    return [
        Metric("growth", growth, "×", "lower", FLAT_BAR, TIMING_TOLERANCE),
        *(
            info(f"cost_{part}", float(cost), "flows of noise")
            for part, cost in enumerate(costs, 1)
        ),
        info("frames", len(table["frame"]), ""),
    ]


def costs_of_parts(frames_ms: FloatArray, reference_ms: FloatArray) -> FloatArray:
    """(PARTS,) median cost of a frame in each part of a flight, in flows of the same part.

    Args:
        frames_ms: (N,) of frames.
        reference_ms: (M,) of flows at equal distances between them.
    """
    frames, flows = np.array_split(frames_ms, PARTS), np.array_split(reference_ms, PARTS)
    return np.array(
        [np.median(part) / np.median(unit) for part, unit in zip(frames, flows, strict=True)]
    )


BENCHMARKS = {
    "growth": Benchmark(
        f"simulated stereo flight of {DURATION_S / 60:g} min: cost of a frame in its last minutes "
        "over that in the third to fifth",
        (),
        measure,
    )
}
