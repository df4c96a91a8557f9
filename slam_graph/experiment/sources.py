# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What an experiment runs on: recordings by their path, simulated set-ups as `sim:NAME`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import ConfigError, DataError
from slam_graph.settings.base import Settings
from slam_graph.settings.tree import ConfigTree, override, validate
from slam_graph.simulation.simulation_config import SHAPES, SimulationConfig, StartConfig
from slam_graph.simulation.simulator import simulate

PREFIX = "sim:"


class Source(Settings):
    """A recording or a simulated set-up; each task of an experiment opens it anew."""

    name: str
    """Short name, for files and tables."""
    recording: str | None = None
    """Path of a recording."""
    groundtruth: str | None = None
    """True trajectory to use instead of that of the recording."""
    simulation: SimulationConfig | None = None
    """Settings of a simulation, whose seed is replaced."""
    random: bool = True
    """Whether a seed changes anything."""
    extent: tuple[int, int, int] | None = None
    """Frames, first and last time of a recording, by which a changed one is noticed."""

    def open(self, seed: int, cameras: int | None) -> Sequence:
        """The sequence; a seed changes what is simulated.

        Raises:
            DataError: if it cannot be read.
        """
        if self.simulation is not None:
            return simulate(self.simulation.model_copy(update={"seed": seed, "cameras": cameras}))
        assert self.recording is not None
        truth = None if self.groundtruth is None else Path(self.groundtruth)
        return open_dataset(self.recording, cameras=cameras, groundtruth=truth)


def find_sources(
    names: Iterable[str],
    duration_s: float | None,
    overrides: Iterable[str] = (),
    groundtruths: Mapping[str, str] | None = None,
) -> list[Source]:
    """The sources that a user names.

    Args:
        names: paths of recordings, `demo`, `sim:figure8`, `sim:rooms`, `sim:random`, or
            `sim:PATH` of a recorded ground truth with its IMU.
        duration_s: length of what is simulated.
        overrides: `key=value` of `SimulationConfig`, for all that is simulated.
        groundtruths: for a recording, by its path as in `names`, the path of its true trajectory.

    Raises:
        DataError: if a recording cannot be opened.
        ConfigError: if an override does not fit, or a source is named twice.
    """
    changes, truths = list(overrides), dict(groundtruths or {})
    sources: dict[str, Source] = {}
    for name in names:
        if name.startswith(PREFIX):
            source = _simulated(name.removeprefix(PREFIX), duration_s, changes)
        else:
            source = _recorded(name, truths.pop(name, None))
        if source.name in sources:
            raise ConfigError(f"{name}: another source is called '{source.name}' too; rename one")
        sources[source.name] = source
    if truths:
        raise ConfigError(f"--groundtruth: no recording in DATA is called '{next(iter(truths))}'")
    return list(sources.values())


def _recorded(path: str, groundtruth: str | None) -> Source:
    truth = None if groundtruth is None else Path(groundtruth)
    info = open_dataset(path, groundtruth=truth).info()
    where = str(Path(path).resolve()) if Path(path).exists() else path
    return Source(
        name=_plain(info.name),
        recording=where,
        groundtruth=None if truth is None else str(truth.resolve()),
        random=info.content == "images",
        extent=(info.frames, info.start_ns, info.end_ns),
    )


def _simulated(what: str, duration_s: float | None, overrides: list[str]) -> Source:
    tree = ConfigTree({"trajectory": what, "duration_s": duration_s})
    if what in SHAPES:
        # drawn from its covariance, so that a NEES over seeds means something
        tree.merge(ConfigTree({"start": StartConfig(error=True).model_dump()}))
        name = what
    else:
        path = Path(what).resolve()
        if not path.exists():
            raise DataError(f"{what}: no such file or folder, and not one of {', '.join(SHAPES)}")
        tree.merge(ConfigTree({"trajectory": str(path), "real_imu": True}))
        name = path.name
    for text in overrides:
        tree.merge(override(text))
    return Source(name=f"sim_{_plain(name)}", simulation=validate(SimulationConfig, tree))


def _plain(name: str) -> str:
    """The name with nothing in it that a file name should not have."""
    return re.sub(r"[^\w.-]+", "_", name)
