# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Tasks and their data; those of a comparison: record tracks once, run an algorithm on them.

A task is a JSON object and is done in a process of its own
(`slam_graph.experiment.task_process`). So peak memory is that of one run, a crash does not
affect other runs, and a cluster needs no more than a shared folder.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from slam_graph.config import RunConfig
from slam_graph.datasets import (
    RecordedSequence,
    Sequence,
    TrackRecorder,
    kalibr_text,
    open_dataset,
)
from slam_graph.errors import ConfigError, DataError, closest
from slam_graph.experiment.batch_plan import FOLDER_OF_MASKS, absolute_sources
from slam_graph.experiment.batch_task import BatchTask
from slam_graph.experiment.comparison_results import read_result, write_result
from slam_graph.experiment.file_state import size_and_time, state_of
from slam_graph.experiment.settings_hash import settings_hash
from slam_graph.frontend import build_frontend
from slam_graph.interrupts import Interrupts
from slam_graph.pipeline import run
from slam_graph.results import ResultFolder
from slam_graph.sensors import ImuData
from slam_graph.settings import ConfigTree, Settings
from slam_graph.simulation import SimulationConfig, simulate
from slam_graph.version import __version__

_PREFIX = "sim:"


class Source(Settings):
    """A recording or a simulation; each task of a comparison opens it anew."""

    name: str
    """Short name, for files and tables."""
    recording: str | None = None
    """Path of a recording."""
    groundtruth: str | None = None
    """Ground truth to use instead of that of the recording."""
    simulation: SimulationConfig | None = None
    """Settings of a simulation, whose seed is replaced."""
    random: bool = True
    """Whether a seed changes anything."""
    extent: tuple[int, int, int] | None = None
    """Number of frames, first and last time of a recording; they reveal that it has changed."""
    state: str = ""
    """Hash of calibration, truth and files, of what was recorded, for the same reason."""
    sources: dict[str, str] = Field(default_factory=dict)
    """Where sensors of a recording are that are not found by themselves, such as fixes."""
    written: dict[str, tuple[int, int]] = Field(default_factory=dict)
    """Size and time of those of them that are files or folders, for the same reason."""

    def open(self, seed: int, cameras: int | None) -> Sequence:
        """The sequence; of a simulation, that with the given seed.

        Raises:
            DataError: if it cannot be read.
        """
        if self.simulation is not None:
            return simulate(self.simulation, seed=seed, cameras=cameras)
        assert self.recording is not None
        truth = None if self.groundtruth is None else Path(self.groundtruth)
        sources = self.sources or None
        return open_dataset(self.recording, cameras=cameras, groundtruth=truth, sources=sources)

    def identity(self) -> dict[str, Any]:
        """What tells it from others, for a hash: places and states only where there are some."""
        settings = self.model_dump(mode="json")
        return {
            name: value
            for name, value in settings.items()
            if value or name not in ("sources", "written", "state")
        }


def find_sources(
    names: Iterable[str | Path],
    duration_s: float | None,
    overrides: Iterable[str] = (),
    groundtruths: Mapping[str, str | Path] | None = None,
    sensors: Mapping[str, str] | None = None,
    output: Path | None = None,
) -> list[Source]:
    """The sources with the names that a user gives.

    Args:
        names: paths of recordings, `demo`, `sim:figure8`, `sim:rooms`, `sim:random`, or
            `sim:PATH` of a recorded ground truth with its IMU.
        duration_s: length of the simulations.
        overrides: `key=value` of `SimulationConfig`, for all simulations.
        groundtruths: paths of ground truth, by the path of the recording as in `names`.
        sensors: where sensors of all recordings are that are not found by themselves.
        output: folder that is written to; what is in it says nothing of a recording around it.

    Raises:
        DataError: if a recording cannot be opened, or its truth not be read.
        ConfigError: if an override does not fit, or a source is named twice.
    """
    changes = list(overrides)
    truths = {name: str(path) for name, path in (groundtruths or {}).items()}
    sources: dict[str, Source] = {}
    for name in map(str, names):
        if name.startswith(_PREFIX):
            source = _simulated(name.removeprefix(_PREFIX), duration_s, changes, output)
        else:
            source = _recorded(name, truths.pop(name, None), sensors or {}, output)
        if source.name in sources:
            raise ConfigError(f"{name}: another source is also called '{source.name}'; rename one")
        sources[source.name] = source
    if truths:
        raise ConfigError(
            f"groundtruth: no recording called '{next(iter(truths))}' is in the comparison"
        )
    return list(sources.values())


def _recorded(
    path: str, groundtruth: str | None, sensors: Mapping[str, str], output: Path | None
) -> Source:
    truth = None if groundtruth is None else Path(groundtruth)
    places = absolute_sources(sensors, Path.cwd())
    sequence = open_dataset(path, groundtruth=truth, sources=places or None)
    info = sequence.info()
    files = {
        name: size_and_time(Path(where))
        for name, where in places.items()
        if name == FOLDER_OF_MASKS or Path(where).is_file()
    }
    where = str(Path(path).resolve()) if Path(path).exists() else path
    return Source(
        name=_plain(info.name),
        recording=where,
        groundtruth=None if truth is None else str(truth.resolve()),
        random=info.content == "images",
        extent=(info.frames, info.start_ns, info.end_ns),
        state=settings_hash(*_knowledge(sequence), state_of([where], output)),
        sources=places,
        written={name: file for name, file in files.items() if file is not None},
    )


def _knowledge(sequence: Sequence) -> tuple[str, str]:
    """What is known of a recording wherever that stands: its calibration, and a hash of its truth.

    Raises:
        DataError: if the truth cannot be read.
    """
    truth = sequence.groundtruth()
    columns = {} if truth is None else truth.as_dict()
    content = hashlib.sha256()
    for name, values in columns.items():
        content.update(name.encode() + values.tobytes())
    return kalibr_text(sequence.rig), content.hexdigest()


def _simulated(
    trajectory: str, duration_s: float | None, overrides: list[str], output: Path | None
) -> Source:
    """A generated flight, or one along a recorded path."""
    state = ""
    tree = ConfigTree({"trajectory": trajectory, "duration_s": duration_s})
    if trajectory in SimulationConfig.TRAJECTORIES:
        # the error of the start is drawn from its covariance: without it the NEES is too small
        tree.merge(ConfigTree({"start": {"error": True}}))
        name = trajectory
    else:
        path = Path(trajectory).resolve()
        if not path.exists():
            raise DataError(
                f"{_PREFIX}{trajectory}: no such file or folder; "
                f"{closest(trajectory, SimulationConfig.TRAJECTORIES)}"
            )
        tree.merge(ConfigTree({"trajectory": str(path), "real_imu": True}))
        state = state_of([str(path)], output)
        name = path.name
    for text in overrides:
        tree.merge(ConfigTree.override(text))
    config = tree.validated(SimulationConfig)
    return Source(name=f"sim_{_plain(name)}", simulation=config, state=state)


def _plain(name: str) -> str:
    """The name with characters that file names should not have replaced."""
    return ResultFolder.name_of(re.sub(r"[^\w.-]+", "_", name))


class RecordTask(Settings):
    """Runs the front end on a sequence and writes the tracks."""

    kind: Literal["record"] = "record"
    source: Source
    seed: int
    config: RunConfig
    """Only front end, cameras, start, duration, `objects.enabled`, gravity, and whether the IMU is
    used matter."""
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
        backend = self.config.backend
        config |= {"gravity": backend.noise.gravity, "dynamics": backend.dynamics.model}
        if self.config.objects.enabled:
            config["objects"] = True
        key = settings_hash(self.source.identity(), config, self.seed, __version__)
        return self.root / f"{self.source.name}_seed{self.seed}_{key}"

    def is_done(self) -> bool:
        """Whether the recording exists, and its files are as long as they should be."""
        try:
            open_dataset(self.folder, "recording").info()
        except DataError:
            return False
        return True

    def do(self) -> None:
        """Record the tracks, in the place of a recording that is damaged.

        Where objects are estimated, what moves and the labels of masks are recorded too.

        Raises:
            DataError: if the source cannot be read, or the recording not be written.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        config = self.config
        sequence = self.source.open(self.seed, config.cameras)
        info = sequence.info()
        start_ns = info.start_ns + round(config.start_s * 1e9)
        length_s = config.duration_s
        end_ns = None if length_s is None else start_ns + round(length_s * 1e9)
        used = config.backend.dynamics.uses_imu(sequence.rig.has_imu and info.imu_samples > 0)
        frontend = build_frontend(
            replace(sequence.rig, has_imu=used),
            config.used_frontend,
            self.seed,
            sequence.diagnostics,
            info.content,
            config.backend.noise.gravity,
        )
        truth, start = sequence.groundtruth(), sequence.initial_state()
        labels, notes = None, {}
        if config.objects.enabled and isinstance(sequence, RecordedSequence):
            labels, notes = sequence.labels_over_time(), sequence.classes_file()
        with TrackRecorder(
            self.folder, sequence.rig, self.source.name, truth, start, notes
        ) as recorder:
            for packet in sequence.packets(start_ns if config.start_s > 0 else None, end_ns):
                features = frontend.track(packet.frame, packet.imu if used else ImuData.empty())
                features = features if labels is None else labels.labelled(features)
                recorder.write(packet.imu, features, packet.aiding)


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
        return settings_hash(self.config.model_dump(mode="json"), self.tracks.name, __version__)

    def is_done(self) -> bool:
        """Whether a result with exactly these settings exists."""
        result = read_result(self.result)
        return result is not None and result["settings_hash"] == self.key

    def do(self) -> None:
        """Run the algorithm; every outcome except an interruption is a result."""
        result = run(open_dataset(self.tracks, "recording"), self.config)
        if result.status == "interrupted":
            result.check()
        about = {"data": self.data, "algorithm": self.algorithm, "seed": self.seed}
        write_result(self.result, result, {**about, "settings_hash": self.key})


Task = RecordTask | RunTask | BatchTask

_ANY_TASK: TypeAdapter[Task] = TypeAdapter(Annotated[Task, Field(discriminator="kind")])


def do_given_task() -> None:
    """Do the task given as JSON in the first argument.

    Standard input may be a pipe: when its other end is closed, the task is given up.
    """
    Interrupts.terminate_like_interrupt()
    if stat.S_ISFIFO(os.fstat(sys.stdin.fileno()).st_mode):
        Interrupts.end_with(sys.stdin.fileno())
    _ANY_TASK.validate_json(sys.argv[1]).do()
