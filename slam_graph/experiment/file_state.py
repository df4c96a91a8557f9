# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Names, sizes and times of files: they reveal that a recording has changed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from slam_graph.experiment.settings_hash import settings_hash

_IMAGES = {".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff", ".webp"}
"""Files of which the names only are looked at, as there are many."""


def is_image(path: Path) -> bool:
    """Whether the name of a file is that of an image."""
    return path.suffix.lower() in _IMAGES


def state_of(paths: Iterable[str], output: Path | None = None) -> str:
    """A hash of the names, sizes and times of the files at some paths; of images the names only.

    Args:
        paths: of files, and of folders that are searched.
        output: a folder that is left out, as it is written to.
    """
    apart = None if output is None else output.resolve()
    files = sorted(str(file) for path in paths for file in _files(Path(path), apart))
    return settings_hash([(file, *_size_and_time(Path(file))) for file in files])


def size_and_time(path: Path) -> tuple[int, int] | None:
    """Size and time of the last change (ns) of a file or of all below a folder; None without it."""
    if not path.exists():
        return None
    files = [file.stat() for file in _files(path)]
    times = [file.st_mtime_ns for file in (*files, path.stat())]
    return sum(file.st_size for file in files), max(times)


def _files(path: Path, apart: Path | None = None) -> Iterator[Path]:
    """The files at a path or below it."""
    if path.is_file():
        yield path
    for folder, inside, names in os.walk(path):
        if apart is not None:
            inside[:] = [name for name in inside if Path(folder, name).resolve() != apart]
        yield from (Path(folder, name) for name in names)


def _size_and_time(file: Path) -> tuple[int, ...]:
    if is_image(file) or not file.exists():
        return ()
    status = file.stat()
    return status.st_size, status.st_mtime_ns
