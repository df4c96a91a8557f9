# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The task of a batch: run one recording and write its results into a folder of its own.

The folder appears when it is complete. Until then files are written into a hidden folder beside it,
whose name holds host and process: what a killed process leaves is found and removed.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from slam_graph.config import RunConfig
from slam_graph.datasets import SequenceInfo, open_dataset
from slam_graph.errors import DataError
from slam_graph.experiment.settings_hash import settings_hash
from slam_graph.files import Files
from slam_graph.pipeline import run
from slam_graph.results import ResultFolder
from slam_graph.settings import Settings
from slam_graph.version import __version__

SCHEMA_VERSION = 3
MARK = "batch.json"
"""The file that says which settings a folder of results is of; it is written last."""

_PROGRESS = "progress"
_PERIOD_S = 0.3
_CAUSAL_PART = 0.85
"""Part of a run that the causal estimate usually takes; the rest is the final adjustment."""


class BatchTask(Settings):
    """Runs one recording and writes its results."""

    kind: Literal["batch"] = "batch"
    name: str
    """Of the recording in the batch; its results lie in a folder of this name."""
    data: str
    """Path of the recording, or `demo`."""
    format: str | None = None
    """Name of its format; None to find it by the path."""
    calibration: str | None = None
    """Kalibr file to use instead of the calibration of the recording."""
    groundtruth: str | None = None
    """True trajectory to use instead of that of the recording."""
    sources: dict[str, str] = Field(default_factory=dict)
    """Where each sensor is, in formats that leave it open."""
    state: str = ""
    """Hash of names, sizes and times of the files of the recording: it reveals a change."""
    config: RunConfig
    """All settings of the run."""
    rerun: bool = False
    """Whether `recording.rrd` is written for Rerun."""
    rerun_images: Literal["none", "keyframes", "all"] = "all"
    """Of which frames it has images."""
    graph_times: list[int | float] = Field(default_factory=list)
    """When the factor graph of the back end is kept, as for `run`."""
    output: Path
    """Folder of the batch."""

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.output / self.name

    @property
    def key(self) -> str:
        """Hash of everything that determines the result, except for the code."""
        return settings_hash(self.model_dump(mode="json", exclude={"output"}), __version__)

    def outcome(self) -> str | None:
        """How the run with exactly these settings ended, in one word; None if it is not done."""
        mark = _read_mark(self.folder)
        return mark["status"] if mark is not None and mark["settings_hash"] == self.key else None

    def is_done(self) -> bool:
        """Whether a result with exactly these settings exists; one that failed is done again."""
        return self.outcome() not in (None, "failed")

    def do(self) -> None:
        """Run; every outcome except an interruption is a result.

        Raises:
            DataError: if the recording cannot be opened, or the folder holds something else.
            KeyboardInterrupt: if it was interrupted; nothing is left then.
        """
        with _appearing_folder(self.folder) as folder, _logged(folder / "run.log"):
            sequence = open_dataset(
                self.data,
                self.format,
                self.config.cameras,
                self.calibration,
                self.groundtruth,
                sources=self.sources,
            )
            progress = _ProgressFile(folder / _PROGRESS, sequence.info(), self.config)
            viewer = self._viewer(folder)
            result = run(
                sequence,
                self.config,
                viewer=viewer,
                progress=progress,
                graph_times=self.graph_times,
            )
            if result.status == "interrupted":
                result.check()
            result.save(folder)
            progress.end()
            ResultFolder(folder).json(
                MARK,
                {
                    "schema_version": SCHEMA_VERSION,
                    "name": self.name,
                    "data": self.data,
                    "status": result.status,
                    "settings_hash": self.key,
                },
            )

    def _viewer(self, folder: Path) -> Any:
        """What writes the recording for Rerun, if one is wanted."""
        if not self.rerun:
            return None
        from slam_graph.visualization import RerunRecording

        path = folder / "recording.rrd"
        return RerunRecording("save", self.name, path, None).viewer(self.rerun_images, "normal")


def running(output: Path) -> dict[str, float]:
    """What part of each recording that is being run now is done, from 0 to 1, by its name."""
    parts: dict[str, float] = {}
    for folder in sorted(output.glob(".*.partial")):
        name = Files.partial_name(folder)
        with suppress(OSError, ValueError):
            if name is not None:
                parts[name] = float((folder / _PROGRESS).read_text(encoding="ascii"))
    return parts


def _read_mark(folder: Path) -> dict[str, Any] | None:
    """The mark of a folder of results; None if it has none of this version."""
    try:
        mark = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    valid = isinstance(mark, dict) and mark.get("schema_version") == SCHEMA_VERSION
    return mark if valid and {"status", "settings_hash"} <= mark.keys() else None


@contextmanager
def _appearing_folder(path: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `path` when the block ends well and vanishes otherwise.

    An older result of a batch at `path` is replaced.

    Raises:
        DataError: if something else is there, or the folder cannot be made.
    """
    if path.exists() and not (path / MARK).is_file():
        raise DataError(f"{path}: is no result of a batch; move it away or choose another --output")
    partial = Files.partial_folder(path)
    try:
        yield partial
        shutil.rmtree(path, ignore_errors=True)
        with Files.writing(path):
            partial.chmod(0o755)
            partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Write what the package logs into a file."""
    logger = logging.getLogger("slam_graph")
    handler = logging.FileHandler(path, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


class _ProgressFile:
    """Notes in a file how far a run is, where another process or machine can read it.

    Args:
        path: of the file.
        info: of the recording.
        config: of the run.
    """

    def __init__(self, path: Path, info: SequenceInfo, config: RunConfig) -> None:
        self._path = path
        self._start_ns = info.start_ns + round(config.start_s * 1e9)
        self._length_ns = max(info.end_ns - self._start_ns, 1)
        if config.duration_s is not None:
            self._length_ns = min(self._length_ns, round(config.duration_s * 1e9))
        self._causal = _CAUSAL_PART if config.final_ba.enabled else 1.0
        self._noted = -_PERIOD_S
        self._note(0.0)

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Note a frame."""
        self._note(self._causal * min((stamp_ns - self._start_ns) / self._length_ns, 1.0))

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Note a step of the final bundle adjustment."""
        self._note(self._causal + (1.0 - self._causal) * done / keyframes)

    def end(self) -> None:
        """Remove the file: it is no result."""
        self._path.unlink(missing_ok=True)

    def _note(self, part: float) -> None:
        if time.monotonic() - self._noted < _PERIOD_S:
            return
        self._noted = time.monotonic()
        with suppress(OSError):  # progress is not worth a run
            self._path.write_text(f"{part:.4f}", encoding="ascii")
