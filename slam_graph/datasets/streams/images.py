# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Grey images from files: damaged ones are refused, the next ones are decoded in a thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.errors import DataError
from slam_graph.image_files import ImageFile

T = TypeVar("T")

_LONGEST_NAME = 250
"""Most characters of the name of an image, with its folders."""

Image = NDArray[np.uint8]
"""(height, width), grey."""

_FRAMES_AHEAD = 3
"""Frames decoded ahead: enough to hide the time of decoding, few enough to save memory."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a file, as `Diagnostics.warn` takes it."""

    kind: str
    message: str


@dataclass(eq=False)
class FileImages:
    """The images of one camera, each in a file of its own.

    Attributes:
        name: of the camera.
        stamps_ns: (N,) int64, strictly increasing.
        paths: N files.
        process: applied to each decoded image, e.g. rectification.
    """

    name: str
    stamps_ns: IntArray
    paths: Sequence[Path]
    process: Callable[[Image], Image] | None = None

    def read(self, index: int) -> Image | Fault:
        """One image as 8 bit grey."""
        path = self.paths[index]
        try:
            if path.exists() and not path.is_file():  # a device or a pipe need not end
                return Fault("image_unreadable", f"{path}: not a file")
            data = path.read_bytes()
        except OSError as error:
            return Fault("image_unreadable", f"{path}: {error.strerror}")
        image = decode_grey(data, str(path))
        return image if self.process is None or isinstance(image, Fault) else self.process(image)

    def missing(self, index: int) -> Fault | None:
        """Whether the file is there."""
        path = self.paths[index]
        return None if path.is_file() else Fault("image_unreadable", f"{path}: no such file")

    def where(self, index: int) -> str:
        """The file."""
        return str(self.paths[index])


def file_within(folder: Path, name: str, where: str) -> Path:
    """The file that a table of a recording names, which must lie in the folder of the recording.

    Args:
        folder: that names are relative to.
        name: as the table has it; it may begin with the names of folders.
        where: file and line, for the message.

    Raises:
        DataError: if the name leads out of the folder, or cannot be one.
    """
    path = Path(name)
    if "\0" in name or path.is_absolute() or ".." in path.parts or len(name) > _LONGEST_NAME:
        raise DataError(
            f"{where}: '{name[:100]}' is not a file in {folder}; a recording may name its own only"
        )
    return folder / path


def decode_grey(data: bytes, where: str) -> Image | Fault:
    """Decode an image file as 8 bit grey; of 16 bits the upper 8 are kept.

    A damaged file is recognised before decoding: decoders fill rows that they cannot read with
    arbitrary values, and write to stderr.

    Args:
        data: bytes of the file.
        where: its place, for the message.

    Returns:
        (height, width) uint8, or a fault of kind `image_unreadable`.
    """
    image = ImageFile.decode(data, cv2.IMREAD_GRAYSCALE)
    if isinstance(image, str):
        return Fault("image_unreadable", f"{where}: {image}")
    return image.astype(np.uint8, copy=False)


def prefetch(
    jobs: Iterable[Callable[[], T]], ahead: int = _FRAMES_AHEAD
) -> Generator[T, None, None]:
    """Results of jobs in their order, the next ones computed in a thread.

    Closing the generator cancels the jobs that have not begun, and waits for the one that has.

    Args:
        jobs: iterated as needed, at most `ahead` in advance.
        ahead: most results that are computed in advance.
    """
    pending: deque[Future[T]] = deque()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slam_graph-images")
    try:
        for job in jobs:
            pending.append(pool.submit(job))
            if len(pending) > ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
