# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One long simulated stereo flight in a process of its own; prints what it costs as JSON.

python -m benchmarks.growth_worker ALGORITHM DURATION_S [complete]

A complete run is as one from the command line: it saves the estimate so far on the way, has the
final bundle adjustment at its end, and writes all its files.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.clocks import Watch, hold_to_one_core, time_flow
from benchmarks.speed_worker import memory_mb, peak_memory_mb
from slam_graph.backend import Estimator
from slam_graph.config import load_config
from slam_graph.pipeline.observers import NullProgress, NullViewer
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.stage import EstimatedFrame
from slam_graph.simulation.simulation_config import (
    FlightConfig,
    LandmarkConfig,
    SimulationConfig,
    TrackConfig,
)
from slam_graph.simulation.simulator import simulate

SIMULATION = SimulationConfig(
    trajectory="figure8",
    cameras=2,
    rate_hz=10.0,
    flight=FlightConfig(hover_s=0.0),
    landmarks=LandmarkConfig(density=10.0),
    tracks=TrackConfig(features=40),
)
"""Tracks and IMU samples are simulated while they are read; their cost does not depend on time."""

FLOW_EVERY = 10
"""So many frames share one time of the reference."""

IMAGE_SIZE = (480, 752)


class Clock(NullViewer, NullProgress):
    """Times frames, and now and then between them a Lucas-Kanade flow of an image that is noise.

    Attributes:
        flows: time of the reference, for each `FLOW_EVERY` frames.
        frames: time of each frame: simulation, back end, and what is noted of it and saved.
        memory: resident memory at the times of the reference, MB.
        poses, features: in the state after each frame.
        causal_s: CPU time of the process at the last frame.
        late_flows: time of the reference after each step of the final bundle adjustment.
        late_s: CPU time that these took, with the search for corners.
    """

    def __init__(self) -> None:
        self.flows = Watch()
        self.frames = Watch()
        self.memory: list[float] = []
        self.poses: list[int] = []
        self.features: list[int] = []
        self.causal_s = self.late_s = 0.0
        self.late_flows = Watch()
        noise = np.random.default_rng(0).integers(0, 255, IMAGE_SIZE, np.uint8)
        self._before, self._after = noise, np.ascontiguousarray(np.roll(noise, 2, axis=1))

    def open(self, rig: object, truth: object) -> None:
        """The first frame begins."""
        self.frames.start()

    def show(self, frame: EstimatedFrame, estimator: Estimator) -> None:
        """A frame is done; then the next one begins."""
        self.frames.stop()
        window = estimator.window
        self.poses.append(0 if window is None else len(window.past))
        self.features.append(0 if window is None else len(window.state_features))
        if len(self.frames.cpu) % FLOW_EVERY == 0:
            time_flow(self._before, self._after, self.flows)
            self.memory.append(memory_mb())
        self.causal_s = time.process_time()
        self.frames.start()

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """A step of the final bundle adjustment is done: time the reference beside it."""
        began_s = time.process_time()
        time_flow(self._before, self._after, self.late_flows)
        self.late_s += time.process_time() - began_s


def main(algorithm: str, duration_s: str, complete: str = "") -> None:
    """Run, and print CPU milliseconds of frames and of the reference, and memory."""
    hold_to_one_core()
    config = load_config(
        overrides=[f"final_ba.enabled={str(bool(complete)).lower()}", "overlap=false"],
        algorithm=algorithm,
        cameras=SIMULATION.cameras,
    )
    sequence = simulate(SIMULATION.model_copy(update={"duration_s": float(duration_s)}))
    clock = Clock()
    with threadpool_limits(limits=1), tempfile.TemporaryDirectory() as folder:
        so_far = folder if complete else None
        result = run(sequence, config, viewer=clock, progress=clock, so_far=so_far)
        result.check()
        after_s = time.process_time() - clock.causal_s - clock.late_s
        if complete:
            result.save(folder)
    table = {
        "frame": clock.frames.cpu.tolist(),
        "reference": clock.flows.cpu.tolist(),
        "memory": clock.memory,
        "poses": clock.poses,
        "features": clock.features,
        "peak_mb": peak_memory_mb(),
        "after_s": after_s,
        "late_reference": clock.late_flows.cpu.tolist(),
    }
    print(json.dumps(table))


if __name__ == "__main__":
    main(*sys.argv[1:])
