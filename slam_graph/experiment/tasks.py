# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The two kinds of tasks of a comparison: record tracks once, run an algorithm on them.

A task is a JSON object and is done in a process of its own
(`python -m slam_graph.experiment.tasks TASK`). So peak memory is that of one run, a crash does not
affect other runs, and a cluster needs no more than a shared folder.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from slam_graph.config import RunConfig
from slam_graph.datasets import TrackRecorder, TrackRecordingSequence
from slam_graph.experiment.comparison_results import read_result, write_result
from slam_graph.experiment.sources import Source
from slam_graph.frontend import build_frontend
from slam_graph.pipeline import run
from slam_graph.settings import Settings
from slam_graph.version import __version__

HASH_LENGTH = 12


class RecordTask(Settings):
    """Runs the front end on a sequence and writes the tracks."""

    kind: Literal["record"] = "record"
    source: Source
    seed: int
    config: RunConfig
    """Only front end, cameras, start and duration matter."""
    root: Path
    """Folder of all tracks."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"tracks of {self.source.name}, seed {self.seed}"

    @property
    def folder(self) -> Path:
        """Folder of the recording; its name depends on the settings."""
        config = self.config.model_dump(
            mode="json", include={"frontend", "cameras", "start_s", "duration_s"}
        )
        source = self.source.model_dump(mode="json")
        key = _settings_hash(source, config, self.seed, __version__)
        return self.root / f"{self.source.name}_seed{self.seed}_{key}"

    def is_done(self) -> bool:
        """Whether the recording exists; it appears only when it is complete."""
        return self.folder.is_dir()

    def do(self) -> None:
        """Record the tracks."""
        config = self.config
        sequence = self.source.open(self.seed, config.cameras)
        info = sequence.info()
        start_ns = info.start_ns + round(config.start_s * 1e9)
        length_s = config.duration_s
        end_ns = None if length_s is None else start_ns + round(length_s * 1e9)
        frontend = build_frontend(
            sequence.rig,
            config.frontend,
            self.seed,
            sequence.diagnostics,
            info.content,
            config.backend.noise.gravity,
        )
        truth, start = sequence.groundtruth(), sequence.initial_state()
        with TrackRecorder(self.folder, sequence.rig, self.source.name, truth, start) as recorder:
            for packet in sequence.packets(start_ns if config.start_s > 0 else None, end_ns):
                recorder.write(packet.imu, frontend.track(packet.frame, packet.imu))


class RunTask(Settings):
    """Runs one algorithm on recorded tracks and writes its results."""

    kind: Literal["run"] = "run"
    data: str
    algorithm: str
    seed: int
    config: RunConfig
    tracks: Path
    """Folder of the recording."""
    result: Path
    """JSON file to write; the series are written beside it."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"{self.algorithm} on {self.data}, seed {self.seed}"

    @property
    def key(self) -> str:
        """Hash of everything that determines the result, except for the code."""
        return _settings_hash(self.config.model_dump(mode="json"), self.tracks.name, __version__)

    def is_done(self) -> bool:
        """Whether a result with exactly these settings exists."""
        result = read_result(self.result)
        return result is not None and result["settings_hash"] == self.key

    def do(self) -> None:
        """Run the algorithm; every outcome except an interruption is a result."""
        result = run(TrackRecordingSequence(self.tracks), self.config)
        if result.status == "interrupted":
            result.check()
        about = {"data": self.data, "algorithm": self.algorithm, "seed": self.seed}
        write_result(self.result, result, {**about, "settings_hash": self.key})


Task = RecordTask | RunTask

_ANY_TASK: TypeAdapter[Task] = TypeAdapter(Annotated[Task, Field(discriminator="kind")])


def _settings_hash(*values: object) -> str:
    """A short hash of values that JSON can hold."""
    text = json.dumps(values, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_LENGTH]


def main() -> None:
    """Do the task given as JSON in the first argument."""
    _ANY_TASK.validate_json(sys.argv[1]).do()


if __name__ == "__main__":
    main()
