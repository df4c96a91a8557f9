# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The tasks of a batch: which recordings are meant, what each is called, and its settings."""

from __future__ import annotations

import glob
import itertools
import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from slam_graph.config import load_config
from slam_graph.datasets import DATASETS
from slam_graph.errors import ConfigError, DataError
from slam_graph.experiment.batch_task import BatchTask
from slam_graph.experiment.file_state import is_image, state_of
from slam_graph.results import ResultFolder
from slam_graph.settings import ConfigTree, Settings

logger = logging.getLogger(__name__)

FOLDER_OF_MASKS = "masks"
"""The source that is a folder."""

_DEMO = "demo"
_LISTS = (".yaml", ".yml")


class Entry(Settings):
    """A recording in the list of a batch."""

    data: str
    """Path, relative to the list."""
    name: str | None = Field(default=None, pattern=r"^\w[\w.-]*$", max_length=100)
    """Name of the folder of results; that of the recording if it is left out."""
    format: str | None = None
    calibration: str | None = None
    groundtruth: str | None = None
    sources: dict[str, str] = Field(default_factory=dict)
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of this recording, as in a configuration."""


class BatchList(Settings):
    """The file that lists the recordings of a batch."""

    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of all recordings, as in a configuration."""
    recordings: list[Entry | str] = Field(min_length=1)
    """Recordings, or paths of recordings."""


@dataclass(frozen=True)
class _Found:
    """A recording that is to be run.

    Attributes:
        entry: with absolute paths.
        origin: where a list names it; empty if it was searched.
        settings: of the whole list.
    """

    entry: Entry
    origin: str
    settings: dict[str, Any]


def plan(
    what: Sequence[str],
    output: Path,
    config: str | Path | None,
    overrides: Sequence[str],
    options: Mapping[str, Any],
    common: Mapping[str, Any],
    extras: Mapping[str, Any],
) -> list[BatchTask]:
    """A task for each recording.

    Args:
        what: recordings, folders and patterns that are searched for recordings, and lists.
        output: folder of the batch, which is not searched.
        config: YAML file of settings for all, which come before those of a list.
        overrides: `a.b=value` for all; they come last.
        options: top-level settings for all, which replace those of a list; None changes nothing.
        common: `format`, `calibration` and `sources` of recordings that no list names.
        extras: fields of all tasks that say what is written besides the results.

    Raises:
        ConfigError: if a setting is wrong, or two recordings of lists have one name.
        DataError: if no recording is found.
    """
    recordings: list[_Found] = []
    for text in what:
        more = list(_read(text, common) if _is_list(text) else _searched(text, output, common))
        known = {one.entry.data for one in recordings if not one.origin}
        recordings += [one for one in more if one.origin or one.entry.data not in known]
        if not more:
            logger.warning("%s: no recording of a known format here", text)
    if not recordings:
        formats = ", ".join(name for name, _ in DATASETS.working())
        raise DataError(f"{', '.join(what)}: no recording found; known formats: {formats}")
    given = {name: value for name, value in options.items() if value is not None}
    tasks = []
    for one, name in zip(recordings, _names([one.entry for one in recordings]), strict=True):
        tree = ConfigTree()
        for layer in (one.settings, one.entry.settings, given):
            tree.merge(ConfigTree(dict(layer)))
        try:
            settings = load_config(config, overrides, **tree.values)
        except ConfigError as error:
            raise ConfigError(f"{one.origin}: {error}" if one.origin else str(error)) from error
        entry = one.entry
        files = [path for path in (entry.calibration, entry.groundtruth) if path is not None]
        files += [
            path
            for sensor, path in entry.sources.items()
            if sensor == FOLDER_OF_MASKS or Path(path).is_file()
        ]
        tasks.append(
            BatchTask(
                name=name,
                state=state_of([entry.data, *files], output),
                config=settings,
                output=output,
                **extras,
                **entry.model_dump(exclude={"name", "settings"}),
            )
        )
    return tasks


def _is_list(text: str) -> bool:
    return Path(text).suffix in _LISTS


# --- lists -------------------------------------------------------------------------------------


def _read(text: str, common: Mapping[str, Any]) -> Iterator[_Found]:
    """The recordings of a list; they need not exist."""
    path = Path(text)
    listed = ConfigTree.read(path).validated(BatchList)
    folder = path.resolve().parent
    shared = _with_paths(listed.settings, folder)
    for number, item in enumerate(listed.recordings, start=1):
        entry = Entry(data=item) if isinstance(item, str) else item
        changes: dict[str, Any] = {
            name: _absolute(value, folder)
            for name in ("data", "calibration", "groundtruth")
            if (value := getattr(entry, name)) is not None
        }
        changes["settings"] = _with_paths(entry.settings, folder)
        changes["sources"] = absolute_sources(entry.sources, folder)
        for name in ("format", "calibration", "sources"):
            changes[name] = changes.get(name) or getattr(entry, name) or common.get(name)
        known = {name: value for name, value in changes.items() if value is not None}
        yield _Found(entry.model_copy(update=known), f"{path}: recording {number}", shared)


def _absolute(text: str, folder: Path) -> str:
    """A path of a list; `demo` is a name if nothing is called so there."""
    path = folder / text
    return text if text == _DEMO and not path.exists() else str(path)


def absolute_sources(sources: Mapping[str, str], folder: Path) -> dict[str, str]:
    """Where sensors are, with absolute paths; topics and rates stay as they are.

    Args:
        sources: by the names of sensors.
        folder: that paths are relative to.
    """
    return {
        sensor: str(folder / where) if _is_path(sensor, folder / where) else where
        for sensor, where in sources.items()
    }


def _is_path(sensor: str, path: Path) -> bool:
    """Whether a source is a file or the folder of masks, which may be missing.

    No topic has a suffix.
    """
    return sensor == FOLDER_OF_MASKS or (sensor != "rate" and (path.is_file() or path.suffix != ""))


def _with_paths(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Settings in which the file of an algorithm is named from anywhere."""
    algorithm = settings.get("algorithm")
    if isinstance(algorithm, str) and Path(algorithm).suffix in _LISTS:
        return {**settings, "algorithm": str(folder / algorithm)}
    return settings


# --- search ------------------------------------------------------------------------------------


def _searched(text: str, output: Path, common: Mapping[str, Any]) -> Iterator[_Found]:
    """The recordings at a path, below a folder, or at or below what a pattern matches.

    Raises:
        DataError: if nothing is there.
    """
    if text == _DEMO and not Path(text).exists():
        yield _Found(Entry(data=text), "", {})
        return
    paths = [text] if Path(text).exists() else sorted(glob.glob(text, recursive=True))
    own = {name: value for name, value in common.items() if value}
    if not paths:
        raise DataError(f"{text}: no such file or folder")
    seen: set[Path] = set()  # what a pattern with ** matches again
    found: set[Path] = set()
    for path in paths:
        if found & {*Path(path).resolve().parents, Path(path).resolve()}:
            continue
        if own.get("format") is not None and Path(path).is_file():
            places: Iterable[Path] = [Path(path)]
        else:
            places = _recordings(Path(path), output.resolve(), own.get("format"), seen)
        for place in places:
            found.add(place.resolve())
            yield _Found(Entry(data=str(place.resolve()), **own), "", {})


def _recordings(path: Path, output: Path, format: str | None, seen: set[Path]) -> Iterator[Path]:
    """The recordings at a path or below it, in the order of their names.

    What is inside of a recording is not searched, nor are hidden folders and the output. A folder
    of images counts only where the format is given: pictures are everywhere.
    """
    real = path.resolve()
    if real in seen or real == output:
        return
    seen.add(real)
    if _recognised(path, format):
        yield path
    elif path.is_dir():
        try:
            inside = sorted(path.iterdir())
        except OSError:  # a folder that may not be read holds nothing for us
            return
        for child in inside:
            if not child.name.startswith("."):
                yield from _recordings(child, output, format, seen)


def _recognised(path: Path, format: str | None) -> bool:
    """Whether a path is a recording, of the format if one is given."""
    if path.is_file() and is_image(path):
        return False
    try:
        if format is not None:
            return DATASETS[format].recognises(path)
        return any(known.recognises(path) for _, known in DATASETS.working() if not known.fallback)
    except OSError:
        return False


# --- names --------------------------------------------------------------------------


def _names(entries: Sequence[Entry]) -> list[str]:
    """A name for each recording: its own, with as many folders before it as tell it from others.

    What folders do not tell apart, as one recording that is listed twice, is numbered in the order
    of the paths. The names do not depend on the order of the recordings.

    Raises:
        ConfigError: if two names that were given are the same.
    """
    given = Counter(entry.name for entry in entries if entry.name)
    if given and given.most_common(1)[0][1] > 1:
        raise ConfigError(f"two recordings are called '{given.most_common(1)[0][0]}'; rename one")
    places = [_place(entry.data) for entry in entries]
    unnamed = {place for place, entry in zip(places, entries, strict=True) if entry.name is None}
    endings = Counter(place[-depth:] for place in unnamed for depth in range(1, len(place) + 1))
    named = zip(entries, places, strict=True)
    own = [entry.name or _name(place, endings) for entry, place in named]
    order = sorted(
        range(len(own)), key=lambda k: (entries[k].name is None, len(places[k]), entries[k].data)
    )
    names: dict[int, str] = {}
    for k in order:  # each name is first of all that of the recording that is called so
        if own[k] not in names.values():
            names[k] = own[k]
    for k in order:
        if k not in names:
            taken = set(names.values())
            numbered = (f"{own[k]}_{number}" for number in itertools.count(2))
            names[k] = next(name for name in numbered if name not in taken)
    return [names[k] for k in range(len(own))]


def _place(data: str) -> tuple[str, ...]:
    """The parts of a path, of a file without its suffix."""
    path = Path(data)
    return path.with_suffix("").parts if path.is_file() else path.parts


def _name(place: tuple[str, ...], endings: Mapping[tuple[str, ...], int]) -> str:
    """As many of the last parts of a path as no other has, as the name of a folder."""
    depths = range(1, len(place) + 1)
    depth = next((depth for depth in depths if endings[place[-depth:]] == 1), len(place))
    parts = [part.strip("/") for part in place[-depth:]]
    return ResultFolder.name_of(
        re.sub(r"[^\w.-]+", "_", "_".join(parts)).lstrip(".") or "recording"
    )
