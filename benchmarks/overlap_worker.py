# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Runs with the front end in turn and in a process of its own, after each other; prints JSON.

python -m benchmarks.overlap_worker RECORDING ALGORITHM

All images are decoded before, so that reading takes no time, and every process has one thread.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from benchmarks.speed_worker import Reference
from slam_graph.config import RunConfig, load_config
from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.sequence import FrameStream, ReaderOptions
from slam_graph.pipeline.run_recording import run

REPETITIONS = 3
"""Of each kind of run, in turn; the least time counts."""


class DecodedBefore(EurocSequence):
    """An EuRoC folder whose images are decoded when it is opened."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, ReaderOptions())
        self._decoded = [self._read_frame(k) for k in range(len(self._groups.stamps_ns))]

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """All frames."""
        for index, images in enumerate(self._decoded):
            yield self._report(index, *images)


def timed(sequence: DecodedBefore, config: RunConfig) -> dict[str, float]:
    """One run: milliseconds a frame by the wall clock, and of the processors of both processes."""
    began_s, children_s = time.process_time(), _children_s()
    result = run(sequence, config)
    result.check()
    frames = result.logs.frames
    return {
        "wall": 1e3 * result.ending.wall_s / frames,
        "cpu": 1e3 * (time.process_time() - began_s) / frames,
        "cpu_front_end": 1e3 * (_children_s() - children_s) / frames,
    }


def _children_s() -> float:
    """Processor time of all processes that this one has waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(recording: str, algorithm: str) -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    sequence = DecodedBefore(Path(recording))
    configs = {
        name: load_config(
            algorithm=algorithm, overrides={"final_ba.enabled": False, "overlap": overlap}
        )
        for name, overlap in (("in_turn", False), ("overlapped", True))
    }
    with threadpool_limits(limits=1):
        reference = Reference()
        run(sequence, configs["in_turn"], viewer=reference).check()
        table: dict[str, Any] = {"reference": reference.flows.cpu.tolist(), "cores": os.cpu_count()}
        for _ in range(REPETITIONS):
            for name, config in configs.items():
                table.setdefault(name, []).append(timed(sequence, config))
    print(json.dumps(table))


if __name__ == "__main__":
    main(*sys.argv[1:])
