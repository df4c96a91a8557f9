# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and ROS 2 (SQLite and MCAP), read by the package `rosbags` without ROS."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam_graph.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

ROS1_SUFFIX, ROS2_SUFFIXES = ".bag", (".mcap", ".db3")

METADATA = "metadata.yaml"

_HEADER_BYTES = 12
"""Length of the beginning of a message that ends with its stamp."""

REINDEX = (
    "if its recording was cut short, rebuild its index first (rosbag reindex, ros2 bag reindex)"
)


def is_bag(path: Path) -> bool:
    """Whether this is a bag: a file, or the folder of a ROS 2 bag."""
    if path.is_file():
        return path.suffix in (ROS1_SUFFIX, *ROS2_SUFFIXES)
    return (path / METADATA).is_file() and any(
        file.suffix in ROS2_SUFFIXES or file.name.endswith(".db3.zstd") for file in path.iterdir()
    )


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it is stored in the bag.

    Attributes:
        topic: where it was published.
        received_ns: time at which it was recorded.
        raw: its bytes.
        decode: turns the bytes into a message object.
    """

    topic: str
    received_ns: int
    raw: bytes
    decode: Callable[[], Any] = field(repr=False)


class Bag:
    """A bag: its topics, and their messages in the order in which they were recorded.

    Attributes:
        path: file or folder.
        topics: type of the messages of each topic, e.g. ``sensor_msgs/msg/Imu``.

    Raises:
        DataError: if the bag cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kept: AnyReader | None = None
        with self._open() as reader:
            self.topics = {
                connection.topic: connection.msgtype
                for connection in reader.connections
                if connection.msgcount
            }
            self._is_ros2 = reader.is2

    def listed(self) -> str:
        """The topics with their types in one line, for messages."""
        short = (f"{topic} ({name.rpartition('/')[2]})" for topic, name in self.topics.items())
        return ", ".join(sorted(short)) or "none"

    def of_type(self, *types: str) -> list[str]:
        """Topics of these types, sorted by name."""
        return sorted(topic for topic, msgtype in self.topics.items() if msgtype in types)

    def messages(
        self, topics: Sequence[str], since_ns: int | None = None, until_ns: int | None = None
    ) -> Generator[Message, None, None]:
        """Messages of some topics that were recorded within [since_ns, until_ns].

        Raises:
            DataError: where the bag is damaged; the messages before that have been delivered.
        """
        stop_ns = None if until_ns is None else until_ns + 1
        with self._open() as reader:
            wanted = [c for c in reader.connections if c.topic in topics]
            stream = reader.messages(wanted, since_ns, stop_ns)
            while True:
                with self._translated():
                    found = next(stream, None)
                if found is None:
                    return
                connection, received_ns, raw = found
                decode = self._decoder(reader.typestore, raw, connection.msgtype)
                yield Message(connection.topic, received_ns, raw, decode)

    @contextmanager
    def kept_open(self) -> Iterator[None]:
        """Open the bag once for several streams of messages, used one after the other."""
        with self._open() as reader:
            self._kept = reader
            try:
                yield
            finally:
                self._kept = None

    def header_stamp_ns(self, message: Message) -> int:
        """The stamp in the header that a message begins with; 0 if it is not set."""
        if len(message.raw) < _HEADER_BYTES:
            return 0
        if self._is_ros2:  # four bytes with the byte order, and the stamp
            order = "<" if message.raw[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", message.raw, 4)
        else:  # a sequence number, and the stamp
            seconds, nanoseconds = struct.unpack_from("<II", message.raw, 4)
        return int(seconds) * 10**9 + int(nanoseconds)  # at most 2106

    def _decoder(self, types: Typestore, raw: bytes, msgtype: str) -> Callable[[], Any]:
        """A function that decodes a message, even after the bag is closed."""
        parse = types.deserialize_cdr if self._is_ros2 else types.deserialize_ros1

        def decode() -> Any:
            with self._translated():
                return parse(raw, msgtype)

        return decode

    @contextmanager
    def _open(self) -> Iterator[AnyReader]:
        if self._kept is not None:
            yield self._kept
            return
        from rosbags.highlevel import AnyReader  # not on import: most runs read no bag

        from slam_graph.datasets.rosbag.bounded_unpacking import bound_unpacking

        bound_unpacking()
        with self._translated():
            reader = AnyReader([self.path], default_typestore=_usual_types())
            reader.open()
        try:
            yield reader
        finally:
            reader.close()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn any exception of the reader of a damaged bag into one line."""
        try:
            yield
        except DataError:
            raise
        except Exception as error:  # its parsers raise anything from struct.error to KeyError
            what = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                f"{self.path}: this bag cannot be read ({what[:150]}); {REINDEX}"
            ) from None


@cache
def _usual_types() -> Typestore:
    """The message types of ROS 2, for bags without definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST)
