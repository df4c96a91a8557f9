# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and ROS 2 (SQLite and MCAP), read by the package `rosbags` without ROS."""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Hashable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from slam_graph.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

_Taken = TypeVar("_Taken")

ROS1_SUFFIX, ROS2_SUFFIXES = ".bag", (".mcap", ".db3")

METADATA = "metadata.yaml"

_HEADER_BYTES = 12
"""Length of the beginning of a message that ends with its stamp."""

_OF_FIELDS = (AttributeError, TypeError, ValueError, OverflowError)
"""What taking a field raises if the bag defines it in another way, or not at all."""
_OF_DEFINITIONS = (KeyError, ValueError, RecursionError)
"""What looking through the definition of a type raises, if that cannot be used."""

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
        parse: turns the bytes into a message object, or raises a DataError; `decode` calls it.
        bag: where it is from.
    """

    topic: str
    received_ns: int
    raw: bytes
    parse: Callable[[], Any] = field(repr=False)
    bag: Bag = field(repr=False)

    def decode(self, take: Callable[[Any], _Taken]) -> _Taken:
        """What a function takes from the message object; also after the bag is closed.

        Args:
            take: gives fields of the message as numbers, texts and arrays, and does nothing else:
                here its errors count as damage, in what follows they are our own.

        Raises:
            DataError: if the message is damaged, or its fields are not those of its type: a bag
                carries the definitions of its types itself.
        """
        found = self.parse()
        with self.bag.translated(_OF_FIELDS):
            return take(found)

    def decode_or(self, take: Callable[[Any], _Taken], otherwise: _Taken) -> _Taken:
        """As `decode`, but something else where the message is damaged."""
        try:
            return self.decode(take)
        except DataError:
            return otherwise


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
        self._kept: Reader1 | Reader2 | None = None
        self._is_ros2 = path.suffix != ROS1_SUFFIX
        with self._open() as reader, self.translated():
            self.topics = _topics_of(reader)
            self._types = _types_of(path, reader)
        self._checked: set[str] = set()

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
            if not wanted:  # none would mean all
                return
            stream = reader.messages(wanted, since_ns, stop_ns)
            while True:
                with self.translated():
                    found = next(stream, None)
                if found is None:
                    return
                connection, received_ns, raw = found
                parse = partial(self._parse, raw, connection.msgtype)
                yield Message(connection.topic, received_ns, raw, parse, self)

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

    def _parse(self, raw: bytes, msgtype: str) -> Any:
        if msgtype not in self._checked:
            with self.translated(_OF_DEFINITIONS):
                _check_arrays(self._types, msgtype)
            self._checked.add(msgtype)
        deserialize = self._types.deserialize_cdr if self._is_ros2 else self._types.deserialize_ros1
        with self.translated():
            return deserialize(raw, msgtype)

    @contextmanager
    def _open(self) -> Iterator[Reader1 | Reader2]:
        if self._kept is not None:
            yield self._kept
            return
        from rosbags import rosbag1, rosbag2  # not on import: most runs read no bag

        from slam_graph.datasets.rosbag.bounded_unpacking import bound_unpacking

        bound_unpacking()
        with self.translated():
            kind = rosbag2.Reader if self._is_ros2 else rosbag1.Reader
            reader = kind(self.path)
            reader.open()
        try:
            yield reader
        finally:
            with self.translated():  # it may be as damaged as the file says
                reader.close()

    @contextmanager
    def translated(self, errors: tuple[type[Exception], ...] = (Exception,)) -> Iterator[None]:
        """Turn exceptions that a damaged bag causes into one line.

        Args:
            errors: which; any of the package's, whose parsers raise anything from struct.error to
                KeyError.
        """
        try:
            yield
        except DataError:
            raise
        except errors as error:
            what = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                f"{self.path}: this bag cannot be read ({what[:150]}); {REINDEX}"
            ) from None


def _topics_of(reader: Reader1 | Reader2) -> dict[str, str]:
    """The type of the messages of each topic that has some."""
    names = [(c.topic, c.msgtype) for c in reader.connections if c.msgcount]
    if not all(isinstance(text, str) for name in names for text in name):
        raise ValueError("a topic or its type is not a text")
    return dict(names)


_KNOWN_TYPES: dict[Hashable, Typestore] = {}
"""Compiled message types by their definitions: most bags have the same ones."""
_MOST_KNOWN = 16


def _types_of(path: Path, reader: Reader1 | Reader2) -> Typestore:
    """The message types of an open bag, by the definitions that it carries."""
    from rosbags.highlevel import AnyReader

    key = frozenset((c.msgtype, c.msgdef, c.digest) for c in reader.connections)
    known = _KNOWN_TYPES.get(key)
    if known is None:
        with AnyReader([path], default_typestore=_usual_types()) as compiler:
            known = compiler.typestore
        while len(_KNOWN_TYPES) >= _MOST_KNOWN:
            del _KNOWN_TYPES[next(iter(_KNOWN_TYPES))]
        _KNOWN_TYPES[key] = known
    return known


_LONGEST_ARRAY = 1000
"""Of strings or messages, in a message type. For each element there are lines of compiled code."""
_MOST_MEMBERS = 20_000
"""Of a message type and all that it is made of."""


def _check_arrays(types: Typestore, msgtype: str) -> None:
    """Refuse a type that costs far more than its definition or its messages are long.

    `Header[1000000000]` is 20 bytes in a bag and as many lines of compiled code; so are types that
    hold two of the next type each. A sequence of what takes no bytes may be of any length.

    Raises:
        ValueError: if it has such a member, itself or in a type that it is made of.
    """
    _size_of_type(types, msgtype, {})


def _size_of_type(
    types: Typestore, msgtype: str, known: dict[str, tuple[int, int] | None]
) -> tuple[int, int]:
    """How many members a type has, in all types that it is made of, and its least bytes."""
    from rosbags.interfaces import Nodetype

    found = known.get(msgtype, (0, 0))
    if found is None:
        raise ValueError(f"messages of type {msgtype} contain themselves")
    if msgtype in known:
        return found
    known[msgtype] = None
    members, least = 0, 0
    for name, (kind, what) in types.fielddefs[msgtype][1]:
        listed = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        length: Any = what[1] if kind == Nodetype.ARRAY else 1
        inner: Any = what[0] if listed else (kind, what)
        is_text = inner[0] == Nodetype.BASE and inner[1][0] == "string"
        size = (1, 4 if is_text else 1)
        if inner[0] == Nodetype.NAME:
            size = _size_of_type(types, inner[1], known)
        if length > _LONGEST_ARRAY and (is_text or inner[0] == Nodetype.NAME):
            raise ValueError(f"{name} in messages of type {msgtype} is an array of {length}")
        if kind == Nodetype.SEQUENCE and size[1] == 0:
            raise ValueError(f"{name} in messages of type {msgtype} is a sequence of nothing")
        members += 1 + (length if inner[0] == Nodetype.NAME else 1) * size[0]
        least += 4 if kind == Nodetype.SEQUENCE else length * size[1]
        if members > _MOST_MEMBERS:
            raise ValueError(f"messages of type {msgtype} have more than {_MOST_MEMBERS} members")
    known[msgtype] = members, least
    return members, least


@cache
def _usual_types() -> Typestore:
    """The message types of ROS 2, for bags without definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST)
