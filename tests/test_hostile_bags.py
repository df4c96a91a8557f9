# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Untrusted bags: what is wrong is one line of ours, and nothing unpacks beyond a bound."""

import bz2
import time
from contextlib import suppress
from pathlib import Path

import pytest
from hostile import ALIASES, read_all
from recordings import edit_text
from recordings_ros import bag_writer, write_bag
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam_graph.datasets import open_dataset
from slam_graph.datasets.rosbag import bounded_unpacking, ros_sequence
from slam_graph.datasets.rosbag.bag import Bag
from slam_graph.datasets.rosbag.messages import IMU
from slam_graph.errors import DataError, SlamGraphError


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_without_images_is_refused(tmp_path: Path, kind: str) -> None:
    """The index names a topic of images, but all messages are cut off."""
    path = write_bag(tmp_path, kind, frames=2)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    content = file.read_bytes()
    for size in (len(content) // 3, len(content) // 2, len(content) - 40):
        file.write_bytes(content[:size])
        with pytest.raises(SlamGraphError):
            read_all(path)


def test_chunks_of_bags_unpack_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_unpacking, "_LEAST", 10**6)
    bounded_unpacking.bound_unpacking()
    zeros = bytes(10**5)
    unpack = bounded_unpacking.ros1.decompressors["bz2"]
    assert unpack(bz2.compress(zeros) + bz2.compress(b"1")) == zeros + b"1"
    with pytest.raises(ValueError, match="unpacks to more than"):
        unpack(bz2.compress(bytes(10**7)))
    with pytest.raises(ValueError, match="cut short"):
        unpack(bz2.compress(zeros)[:-4])


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_a_bag_compressed_by_zstd_is_read_within_a_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    path = write_bag(tmp_path, "sqlite", frames=3, packed=mode)
    assert open_dataset(path).info().frames == 3
    monkeypatch.setattr(bounded_unpacking, "_LEAST", 100)
    monkeypatch.setattr(bounded_unpacking, "_RATIO", 0)
    bounded_unpacking.bound_unpacking.cache_clear()
    with pytest.raises(DataError, match="unpacks to more than"):
        read_all(path)


@pytest.mark.parametrize("name", ["bz2", "lz4"])
def test_a_compressed_bag_is_read(tmp_path: Path, name: str) -> None:
    path = write_bag(tmp_path, "ros1", frames=3, packed=name)
    assert name.encode() in path.read_bytes()
    assert open_dataset(path).info().frames == 3


def bag_of_type(path: Path, definition: str) -> Path:
    """A bag with one IMU message, of a type that the bag defines in its own way."""
    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg(definition, IMU))
    text, digest = types.generate_msgdef(IMU)
    with Writer(path) as writer:
        connection = writer.add_connection("/imu0", IMU, msgdef=text, md5sum=digest)
        writer.write(connection, 1, bytes(40))
    return path


def doubling(levels: int) -> str:
    """A message type of two of the next type each."""
    types = [f"a/T{k} one\na/T{k} two" for k in range(levels)]
    heads = [f"{'=' * 80}\nMSG: a/T{k}\n" for k in range(levels)]
    bodies = [*types[1:], "uint8 end"]
    return "\n".join([types[0], *(head + body for head, body in zip(heads, bodies, strict=True))])


@pytest.mark.parametrize(
    "definition",
    [
        "string[300000] names",
        f"std_msgs/Header[300000] headers\n{'=' * 80}\nMSG: std_msgs/Header\nuint8 sequence",
        "sensor_msgs/Imu itself",
        "uint8[4000000000] numbers",
        f"std_msgs/Empty[] many\n{'=' * 80}\nMSG: std_msgs/Empty\n",
        pytest.param(doubling(22), id="doubling"),
    ],
)
def test_a_type_that_claims_long_arrays_is_refused(tmp_path: Path, definition: str) -> None:
    """Lines of code would be made and compiled for each element, for minutes."""
    bag = Bag(bag_of_type(tmp_path / "a.bag", definition))
    begin_s = time.process_time()
    with pytest.raises(DataError, match="cannot be read"):
        next(bag.messages(["/imu0"])).decode(str)
    assert time.process_time() - begin_s < 2.0


@pytest.mark.parametrize("field", [b"angular_velocity", b"encoding", b"frame_id", b"transforms"])
def test_a_type_with_other_fields_is_damage(tmp_path: Path, field: bytes) -> None:
    """A bag carries the definitions of its types, and may say anything there."""
    path = write_bag(tmp_path, "mcap_file", frames=2)
    content = path.read_bytes()
    assert field in content
    path.write_bytes(content.replace(field, field[:-1] + b"x"))
    with suppress(SlamGraphError):
        read_all(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"float64 x", b"byte[8] x"),  # of the same length in definition and message
        (b"float64[9] k", b"float64[3] k"),
    ],
)
def test_a_type_with_fields_of_another_kind_is_damage(
    tmp_path: Path, old: bytes, new: bytes
) -> None:
    path = write_bag(tmp_path, "mcap_file", frames=2)
    content = path.read_bytes()
    assert old in content
    assert len(old) == len(new)
    path.write_bytes(content.replace(old, new))
    with pytest.raises(DataError):
        read_all(path)


@pytest.mark.parametrize("mistake", [AttributeError, TypeError, IndexError])
def test_a_mistake_of_ours_is_not_called_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mistake: type[Exception]
) -> None:
    """What is made of the fields of a message fails with our own error."""

    def broken(*_: object) -> None:
        raise mistake("a mistake")

    path = write_bag(tmp_path, "mcap_file", frames=2)
    monkeypatch.setattr(ros_sequence, "image_of", broken)
    with pytest.raises(mistake, match="a mistake"):
        read_all(path)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("rosbag2_bag", ALIASES + "rosbag2_bag", "aliases repeat"),
        ("name: /imu0", "name: [/imu0]", "hash|not a text"),
        ("version: 8", "version: " + "1" * 5000, "not of type int"),
        ("starting_time:", "starting_time: " + "[" * 1000, "nested deeper"),
    ],
)
def test_metadata_of_a_bag_is_read_within_the_bounds(
    tmp_path: Path, old: str, new: str, reason: str
) -> None:
    path = write_bag(tmp_path, "mcap", frames=2)
    edit_text(path / "metadata.yaml", old, new)
    with pytest.raises(DataError, match=reason):
        read_all(path)


def test_an_empty_bag_is_refused(tmp_path: Path) -> None:
    with bag_writer(tmp_path / "empty.bag", "ros1"):
        pass
    with pytest.raises(DataError):
        read_all(tmp_path / "empty.bag")
