# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One long simulated flight in a process of its own; prints its peak of memory as JSON.

python -m benchmarks.memory_worker ALGORITHM DURATION_S
"""

from __future__ import annotations

import json
import sys
import tempfile

from threadpoolctl import threadpool_limits

from benchmarks.speed_worker import peak_memory_mb
from slam_graph.config import load_config
from slam_graph.pipeline.run_recording import run
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    LandmarkConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

SIMULATION = SimulationConfig(
    trajectory="figure8",
    cameras=1,
    rate_hz=10.0,
    flight=FlightConfig(hover_s=0.0),
    landmarks=LandmarkConfig(density=10.0),
    tracks=TrackConfig(features=40),
)
"""Tracks and IMU samples are simulated while they are read, and never held."""


def main(algorithm: str, duration_s: str) -> None:
    """Run, write all files, and print."""
    config = load_config(algorithm=algorithm, cameras=SIMULATION.cameras)
    sequence = simulate(SIMULATION.model_copy(update={"duration_s": float(duration_s)}))
    with threadpool_limits(limits=1), tempfile.TemporaryDirectory() as folder:
        result = run(sequence, config)
        result.check()
        result.save(folder)
    table = {
        "peak_mb": peak_memory_mb(),
        "frames": result.logs.frames,
        "wall_s": result.ending.wall_s,
    }
    print(json.dumps(table))


if __name__ == "__main__":
    main(*sys.argv[1:])
