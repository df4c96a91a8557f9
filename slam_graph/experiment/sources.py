# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The data of a comparison: recordings by path, simulations as `sim:NAME`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from slam_graph.datasets import Sequence, open_dataset
from slam_graph.errors import ConfigError, DataError, closest
from slam_graph.settings import ConfigTree, Settings, override, validate
from slam_graph.simulation import TRAJECTORIES, SimulationConfig, StartConfig, simulate

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

    def open(self, seed: int, cameras: int | None) -> Sequence:
        """The sequence; of a simulation, that with the given seed.

        Raises:
            DataError: if it cannot be read.
        """
        if self.simulation is not None:
            return simulate(self.simulation, seed=seed, cameras=cameras)
        assert self.recording is not None
        truth = None if self.groundtruth is None else Path(self.groundtruth)
        return open_dataset(self.recording, cameras=cameras, groundtruth=truth)


def find_sources(
    names: Iterable[str | Path],
    duration_s: float | None,
    overrides: Iterable[str] = (),
    groundtruths: Mapping[str, str | Path] | None = None,
) -> list[Source]:
    """The sources with the names that a user gives.

    Args:
        names: paths of recordings, `demo`, `sim:figure8`, `sim:rooms`, `sim:random`, or
            `sim:PATH` of a recorded ground truth with its IMU.
        duration_s: length of the simulations.
        overrides: `key=value` of `SimulationConfig`, for all simulations.
        groundtruths: paths of ground truth, by the path of the recording as in `names`.

    Raises:
        DataError: if a recording cannot be opened.
        ConfigError: if an override does not fit, or a source is named twice.
    """
    changes = list(overrides)
    truths = {name: str(path) for name, path in (groundtruths or {}).items()}
    sources: dict[str, Source] = {}
    for name in map(str, names):
        if name.startswith(_PREFIX):
            source = _simulated(name.removeprefix(_PREFIX), duration_s, changes)
        else:
            source = _recorded(name, truths.pop(name, None))
        if source.name in sources:
            raise ConfigError(f"{name}: another source is also called '{source.name}'; rename one")
        sources[source.name] = source
    if truths:
        raise ConfigError(
            f"groundtruth: no recording called '{next(iter(truths))}' is in the comparison"
        )
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


def _simulated(trajectory: str, duration_s: float | None, overrides: list[str]) -> Source:
    tree = ConfigTree({"trajectory": trajectory, "duration_s": duration_s})
    if trajectory in TRAJECTORIES:
        # the error of the start is drawn from its covariance: without it the NEES is too small
        tree.merge(ConfigTree({"start": StartConfig(error=True).model_dump()}))
        name = trajectory
    else:
        path = Path(trajectory).resolve()
        if not path.exists():
            raise DataError(
                f"{_PREFIX}{trajectory}: no such file or folder; "
                f"{closest(trajectory, TRAJECTORIES)}"
            )
        tree.merge(ConfigTree({"trajectory": str(path), "real_imu": True}))
        name = path.name
    for text in overrides:
        tree.merge(override(text))
    return Source(name=f"sim_{_plain(name)}", simulation=validate(SimulationConfig, tree))


def _plain(name: str) -> str:
    """The name with characters that file names should not have replaced."""
    return re.sub(r"[^\w.-]+", "_", name)
