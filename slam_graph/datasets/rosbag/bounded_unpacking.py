# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bags are unpacked up to a bound: 10 kB of bzip2 can hold gigabytes of zeros.

So can ten lines of YAML whose aliases repeat aliases.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
from functools import cache, lru_cache, partial
from os import fstat
from types import SimpleNamespace
from typing import Any, BinaryIO, Self

import lz4.frame
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import reader as ros2
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2 import storage_sqlite3 as sqlite

from slam_graph.settings import ConfigTree

_RATIO = 50
_LEAST = 2**26
"""A chunk may unpack to so many times its size, and so many bytes more. Chunks have 1 to 10 MB.
So may a whole file of ROS 2 (`.db3.zstd`), which is unpacked to the disk."""

zstd: Any = ros2.zstd  # type: ignore[attr-defined]


@cache
def bound_unpacking() -> None:
    """Let `rosbags` unpack chunks by functions that know a bound; it has none itself."""
    ros1.decompressors["bz2"] = partial(_unpacked, bz2.BZ2Decompressor)
    ros1.decompressors["lz4"] = partial(_unpacked, lz4.frame.LZ4FrameDecompressor)
    mcap.DECOMPRESSORS["lz4"] = _of_size(lz4.frame.LZ4FrameDecompressor)
    mcap.DECOMPRESSORS["zstd"] = _of_size(zstd.ZstdDecompressor)
    bounded = SimpleNamespace(
        open=_BoundedFile, decompress=partial(_unpacked, zstd.ZstdDecompressor)
    )
    setattr(ros2, "zstd", bounded)  # noqa: B010 - mypy takes it for a module
    setattr(ros2, "YAML", _BoundedYaml)  # noqa: B010
    for module in (ros2, mcap, sqlite):  # how messages were sent is YAML too, and not used
        setattr(module, "parse_qos", lambda _: [])  # noqa: B010


class _BoundedYaml:
    """The YAML of ``metadata.yaml``; `typ` is there because the reader of bags gives it."""

    def __init__(self, typ: str) -> None: ...

    def load(self, text: str) -> Any:
        """The value of a text.

        Raises:
            YamlTextError: if it is not YAML, or nested or repeated beyond all bounds.
        """
        return _yaml_value(text)


@lru_cache(maxsize=4)
def _yaml_value(text: str) -> Any:
    """The value of a text; a bag is opened several times, and nobody changes what it holds."""
    return ConfigTree.value(text)


class _BoundedFile:
    """A compressed file that is read up to the bound; a context manager.

    Args:
        file: with the compressed content.
        mode: to read bytes.
    """

    def __init__(self, file: BinaryIO, mode: str) -> None:
        self._packed = fstat(file.fileno()).st_size
        self._left = _RATIO * self._packed + _LEAST
        self._file = zstd.open(file, mode)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        """The next bytes.

        Raises:
            ValueError: if they are more than the bound.
        """
        part = bytes(self._file.read(size))
        self._left -= len(part)
        if self._left < 0:
            raise ValueError(f"a file of {self._packed} bytes unpacks to more than its bound")
        return part


def _of_size(unpacker: Callable[[], Any]) -> Callable[[bytes, int], bytes]:
    """As MCAP's reader calls it: with the size that the file promises, which is checked later."""
    return lambda data, _: _unpacked(unpacker, data)


def _unpacked(unpacker: Callable[[], Any], data: bytes) -> bytes:
    """Unpack the data of a chunk.

    Raises:
        ValueError: if it is cut short, or unpacks to more than the bound.
    """
    most = _RATIO * len(data) + _LEAST
    parts, size = [], 0
    while data:  # a chunk may be several streams
        stream = unpacker()
        part = bytes(stream.decompress(data, max_length=most - size + 1))
        parts.append(part)
        size += len(part)
        if size > most:
            raise ValueError(f"a chunk of {len(data)} bytes unpacks to more than {most} bytes")
        if not stream.eof:
            raise ValueError("a chunk is cut short")
        data = stream.unused_data or b""
    return b"".join(parts)
