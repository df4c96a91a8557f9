# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""One timed run on one core, in a process of its own; prints what it measured as JSON.

python -m benchmarks.speed_worker MODE RECORDING ALGORITHM [CAMERAS [SECONDS]]
"""

from __future__ import annotations

import json
import re
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from cProfile import Profile
from pathlib import Path
from pstats import Stats
from typing import Any

from threadpoolctl import threadpool_limits

import slam_graph
from benchmarks.clocks import Image, Watch, hold_to_one_core, time_flow
from slam_graph.config import RunConfig, load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.sequence import FrameStream, ReaderOptions
from slam_graph.pipeline.observers import NullProgress, NullViewer
from slam_graph.pipeline.run_recording import run
from slam_graph.pipeline.stage import EstimatedFrame

Table = dict[str, Any]


def shipped(recording: Path, config: RunConfig) -> Table:
    """The run as it ships, with all files written at the end: its time and its peak of memory."""
    sequence = open_dataset(recording, cameras=config.cameras)
    began_s = time.process_time()
    result = run(sequence, config)
    cpu_s = time.process_time() - began_s
    result.check()
    with tempfile.TemporaryDirectory() as folder:
        result.save(folder)
    return {
        "recorded_s": result.input.recorded_s,
        "wall_s": result.ending.wall_s,
        "cpu_s": cpu_s,
        "peak_mb": peak_memory_mb(),
    }


def interleaved(recording: Path, config: RunConfig) -> Table:
    """The run with every frame followed by the reference: milliseconds of both.

    Front end and back end take turns here, so that one thread's time is that of both.
    """
    config = config.model_copy(update={"overlap": False})
    sequence = DecodedInTurn(recording, cameras=config.cameras)
    reference = Reference()
    began_s = time.process_time()
    result = run(sequence, config, viewer=reference, progress=reference)
    cpu_s = time.process_time() - began_s
    result.check()
    stages = {
        name: result.logs.timing.column(name).tolist() for name in result.logs.timing.stages()
    }
    stages["frame"] = reference.frames.wall.tolist()
    stages["decoding"] = sequence.decoding.wall.tolist()
    return {
        "reference": reference.flows.cpu.tolist(),
        "frame": reference.frames.cpu.tolist(),
        "decoding": sequence.decoding.cpu.tolist(),
        "stages": stages,
        "wall_s": result.ending.wall_s,
        "cpu_s": cpu_s,
    }


def profiled(recording: Path, config: RunConfig) -> Table:
    """The functions that take the most time of their own, decoding apart.

    By the wall clock: a timer of CPU time takes longer than most of the calls that it would time.

    Returns:
        `functions`: name, calls a frame and share of the time, the largest first.
    """
    sequence = DecodedInTurn(recording, cameras=config.cameras)
    profile = Profile()
    result = profile.runcall(run, sequence, config.model_copy(update={"overlap": False}))
    result.check()
    rows = [
        (name_of(*function), calls, own_s)
        for function, (_, calls, own_s, _, _) in Stats(profile).stats.items()  # type: ignore[attr-defined]
    ]
    rows = [row for row in rows if row[0] != DECODING]
    total_s, frames = sum(own_s for *_, own_s in rows), result.logs.frames
    longest = sorted(rows, key=lambda row: -row[2])[:LONGEST]
    return {"functions": [[name, calls / frames, own / total_s] for name, calls, own in longest]}


LONGEST = 10
"""How many functions of a profile are listed."""

DECODING = "imdecode"

PACKAGE = Path(slam_graph.__file__).parent


def name_of(file: str, line: int, function: str) -> str:
    """A function of a profile as a reader finds it: its file in the package, or what made it."""
    if file == "~":  # compiled: <imdecode>, <built-in method numpy.zeros>
        words = function.strip("<>").removeprefix("built-in method ")
        return re.sub(r"^slam_graph_kernels_\d+\.", "kernel ", words)
    inside = Path(file).is_relative_to(PACKAGE)
    return f"{Path(file).relative_to(PACKAGE) if inside else Path(file).name}: {function}"


class DecodedInTurn(EurocSequence):
    """An EuRoC folder whose images are decoded when their turn comes, not ahead in a thread.

    On one core the thread only takes the time of whatever else runs; in turn it can be told apart.

    Attributes:
        decoding: the time that it took for each frame.
    """

    def __init__(self, path: Path, cameras: int | None = None) -> None:
        super().__init__(path, ReaderOptions(cameras=cameras))
        self.decoding = Watch()

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """All frames."""
        for index in range(len(self._groups.stamps_ns)):
            self.decoding.start()
            images = self._read_frame(index)
            self.decoding.stop()
            yield self._report(index, *images)


class Reference(NullViewer, NullProgress):
    """Times frames, and between them a Lucas-Kanade flow from the last left image to this one.

    Attributes:
        flows: the time of the reference, for each frame with an image before it.
        frames: the time of each frame: reading, front end, back end and what lies between.
    """

    def __init__(self) -> None:
        self.flows = Watch()
        self.frames = Watch()
        self._last: Image | None = None

    def open(self, rig: object, truth: object) -> None:
        """The first frame begins."""
        self.frames.start()

    def show(self, frame: EstimatedFrame, estimator: object) -> None:
        """A frame is done: time the reference; then the next frame begins."""
        self.frames.stop()
        image = frame.image
        if image is not None:
            if self._last is not None:
                time_flow(self._last, image, self.flows)
            self._last = image
        self.frames.start()


def memory_mb() -> float:
    """Resident memory of this program."""
    return _status_mb("VmRSS:")


def peak_memory_mb() -> float:
    """High-water mark of resident memory of this program."""
    return _status_mb("VmHWM:")


def _status_mb(field: str) -> float:
    """What the system says of the memory of this program.

    `getrusage` would also count what the parent process took before this program replaced its copy;
    it is what remains where there is no /proc.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith(field):
                return int(line.split()[1]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


MODES: dict[str, Callable[[Path, RunConfig], Table]] = {
    "shipped": shipped,
    "interleaved": interleaved,
    "complete": shipped,
    "profiled": profiled,
}


def main(mode: str, recording: str, algorithm: str, cameras: str = "2", seconds: str = "") -> None:
    """Measure and print."""
    hold_to_one_core()
    # `complete` has the bundle adjustment at its end; the others are of the causal part alone
    config = load_config(
        overrides=[f"final_ba.enabled={str(mode == 'complete').lower()}"],
        algorithm=algorithm,
        cameras=int(cameras),
        duration_s=float(seconds) if seconds else None,
    )
    with threadpool_limits(limits=1):
        print(json.dumps(MODES[mode](Path(recording), config)))


if __name__ == "__main__":
    main(*sys.argv[1:])
