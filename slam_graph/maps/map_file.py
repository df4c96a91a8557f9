# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Map files: a zip archive with `map.json` and arrays in NumPy's format (docs/maps.md).

Files may be untrusted. Nothing in a file is executed, and members are stored uncompressed,
so that no array is larger than the file; type and shape of an array are checked before it is read,
and its values afterwards (`_check_map`).
"""

from __future__ import annotations

import json
import re
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray
from slam_graph.datasets import kalibr_text, rig_from_kalibr
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.loop_closure import Vocabulary
from slam_graph.maps.map_model import NO_FEATURE, Links, MapRecording, PoseSource, SlamMap
from slam_graph.pose_graph import Poses

_MAX_COORDINATE_M = 1e8
_MAX_NORMALIZED = 1e4
"""Largest coordinate on the plane z = 1."""

_FORMAT, _VERSION = "slam_graph map", 1
HEADER = "map.json"
_MAX_HEADER_BYTES = 1_000_000
"""Largest size of the header."""

_Shape = tuple[int | str, ...]

ARRAYS: dict[str, tuple[str, _Shape]] = {
    "recording_of": ("<i8", ("K",)),
    "stamps_ns": ("<i8", ("K",)),
    "positions": ("<f8", ("K", 3)),
    "quaternions": ("<f8", ("K", 4)),
    "points": ("<f8", ("P", 3)),
    "feature_descriptors": ("|u1", ("P", "B")),
    "offsets": ("<i8", ("K+1",)),
    "features": ("<i8", ("N",)),
    "normalized": ("<f8", ("N", 2)),
    "descriptors": ("|u1", ("N", "B")),
    "link_ends": ("<i8", ("L", 2)),
    "link_positions": ("<f8", ("L", 3)),
    "link_quaternions": ("<f8", ("L", 4)),
    "link_covariances": ("<f8", ("L", 6, 6)),
    "words": ("|u1", ("W", "B")),
    "word_weights": ("<f8", ("W",)),
}
"""Type and shape of every array; sizes of one letter are the same everywhere."""

_NOT_YAML = re.compile(
    "[^ -~\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]"
)
"""Characters that cannot stand in a string of YAML as they are."""

_READ_ERRORS = (zipfile.BadZipFile, EOFError, ValueError, struct.error, RuntimeError, OverflowError)
"""Exceptions of damaged archives and arrays."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Recording(_Strict):
    name: str = Field(max_length=1000)
    poses: PoseSource
    calibration: dict[str, Any]


class _Header(_Strict):
    format: Literal["slam_graph map"]
    version: Literal[1]
    created: str = Field(max_length=100)
    slam_graph: str = Field(max_length=100)
    gravity_aligned: bool
    recordings: list[_Recording] = Field(min_length=1)


def write_map(path: str | Path, content: SlamMap) -> None:
    """Write a map file."""
    header = {
        "format": _FORMAT,
        "version": _VERSION,
        "created": content.created,
        "slam_graph": content.version,
        "gravity_aligned": content.gravity_aligned,
        "recordings": [
            {"name": r.name, "poses": r.poses, "calibration": yaml.safe_load(kalibr_text(r.rig))}
            for r in content.recordings
        ],
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(HEADER), json.dumps(header, indent=1, allow_nan=False))
        for name, array in arrays_of(content).items():
            with archive.open(zipfile.ZipInfo(_member(name)), "w", force_zip64=True) as file:
                dtype = ARRAYS[name][0]
                np.lib.format.write_array(
                    file, np.ascontiguousarray(array, dtype), (1, 0), allow_pickle=False
                )


def read_map(path: str | Path) -> SlamMap:
    """Read a map file, which may be untrusted.

    Raises:
        DataError: if it is no map, of a newer version, damaged, or inconsistent.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            members = _members(archive, size, path)
            header = _header(archive, members, path)
            arrays = _read_arrays(archive, members, path)
    except OSError as error:
        raise DataError(f"{path}: map cannot be read ({error.strerror or error})") from None
    except _READ_ERRORS as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(
            f"{path}: not a slam_graph map, or damaged ({reason}); take another copy of it"
        ) from None
    content = _assemble(header, arrays, path)
    _check_map(content, path)
    return content


def _member(name: str) -> str:
    return f"{name}.npy"


def arrays_of(content: SlamMap) -> dict[str, NDArray[Any]]:
    """All arrays of a map by name, as the file has them."""
    links = content.links
    return {
        "recording_of": content.recording_of,
        "stamps_ns": content.stamps_ns,
        "positions": content.poses.translations,
        "quaternions": Rotation.from_matrix(content.poses.rotations).as_quat(),
        "points": content.points,
        "feature_descriptors": content.feature_descriptors,
        "offsets": content.offsets,
        "features": content.features,
        "normalized": content.normalized,
        "descriptors": content.descriptors,
        "link_ends": links.ends,
        "link_positions": links.measured.translations,
        "link_quaternions": _quaternions(links.measured),
        "link_covariances": links.covariances,
        "words": content.vocabulary.words,
        "word_weights": content.vocabulary.idf,
    }


def _quaternions(poses: Poses) -> NDArray[np.float64]:
    """(N, 4) as x y z w; SciPy refuses to convert none."""
    if len(poses) == 0:
        return np.zeros((0, 4))
    return np.asarray(Rotation.from_matrix(poses.rotations).as_quat())


def _members(archive: zipfile.ZipFile, size: int, path: Path) -> dict[str, zipfile.ZipInfo]:
    """The members by name; refused if they could unpack to more than the file."""
    members = {info.filename: info for info in archive.infolist()}
    plain = all(
        info.compress_type == zipfile.ZIP_STORED
        and info.file_size == info.compress_size
        and not info.flag_bits & 1
        for info in members.values()
    )
    total = sum(info.file_size for info in members.values())
    if len(members) != len(archive.infolist()) or not plain or total > size:
        raise DataError(
            f"{path}: not a slam_graph map: its members are compressed, encrypted, of the same "
            "name, or larger than the file"
        )
    return members


def _header(archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], path: Path) -> _Header:
    """The header, if this version can read the file."""
    if HEADER not in members or members[HEADER].file_size > _MAX_HEADER_BYTES:
        raise DataError(f"{path}: not a slam_graph map: it has no {HEADER}, or too large a one")
    try:
        table = json.loads(archive.read(HEADER).decode("utf-8"))
    except (ValueError, RecursionError):
        raise DataError(f"{path}: {HEADER} is not JSON; take another copy of the map") from None
    if not isinstance(table, dict) or table.get("format") != _FORMAT:
        raise DataError(f"{path}: not a slam_graph map: {HEADER} does not say so")
    version = table.get("version")
    if isinstance(version, int) and version > _VERSION:
        raise DataError(
            f"{path}: a map of version {version}, this slam_graph reads version {_VERSION}; "
            "update slam_graph"
        )
    try:
        return _Header.model_validate(table)
    except (ValidationError, RecursionError) as error:
        fault = error.errors()[0] if isinstance(error, ValidationError) else None
        where = ".".join(str(x) for x in fault["loc"]) if fault else HEADER
        what = fault["msg"] if fault else "too deep"
        raise DataError(f"{path}: {HEADER}: {where}: {what}") from None


def _read_arrays(
    archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], path: Path
) -> dict[str, NDArray[Any]]:
    """All arrays, with consistent shapes and sizes."""
    sizes: dict[str, int] = {}
    arrays = {}
    for name, (dtype, wanted) in ARRAYS.items():
        where = f"{path}: {_member(name)}"
        if _member(name) not in members:
            raise DataError(f"{where} is missing; take another copy of the map")
        info = members[_member(name)]
        with archive.open(info) as file:
            shape, by_column, found = _array_header(file, where)
            _check_shape(shape, wanted, sizes, where)
            count = 1
            for size in shape:
                count *= size  # Python integers do not overflow
            left = info.file_size - file.tell()
            if found.str != dtype or by_column or count * found.itemsize != left:
                raise DataError(
                    f"{where}: has type {found.str}, shape {shape} and {left} bytes, which do not "
                    f"fit each other or the type {dtype}; take another copy of the map"
                )
            content = bytearray(file.read())
        arrays[name] = np.frombuffer(content, dtype).reshape(shape)
    return arrays


def _array_header(file: IO[bytes], where: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type of an array; `where` is for messages."""
    try:
        if np.lib.format.read_magic(file) == (1, 0):
            return np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # NumPy parses it as Python: any exception is possible
        reason = " ".join(str(error).split())[:100]
        raise DataError(f"{where}: damaged ({reason}); take another copy of the map") from None
    raise DataError(f"{where}: not an array of NumPy's format 1.0")


def _check_shape(shape: tuple[int, ...], wanted: _Shape, sizes: dict[str, int], where: str) -> None:
    """Check a shape against the expected one, and note new sizes."""
    good = len(shape) == len(wanted) and all(isinstance(n, int) and n >= 0 for n in shape)
    if good:
        for size, name in zip(shape, wanted, strict=True):
            if isinstance(name, int):
                good = good and size == name
            elif name == "K+1":
                good = good and size == sizes["K"] + 1
            else:
                good = good and sizes.setdefault(name, size) == size
    if not good:
        text = ", ".join(str(sizes.get(n, n)) if isinstance(n, str) else str(n) for n in wanted)
        raise DataError(f"{where}: has shape {shape}, not ({text}); take another copy of the map")


def _assemble(header: _Header, arrays: dict[str, NDArray[Any]], path: Path) -> SlamMap:
    """The map of header and arrays."""
    return SlamMap(
        tuple(_recording(entry, path) for entry in header.recordings),
        header.created,
        header.slam_graph,
        header.gravity_aligned,
        arrays["recording_of"],
        arrays["stamps_ns"],
        _poses(arrays, "", path),
        arrays["points"],
        arrays["feature_descriptors"],
        arrays["offsets"],
        arrays["features"],
        arrays["normalized"],
        arrays["descriptors"],
        Links(arrays["link_ends"], _poses(arrays, "link_", path), arrays["link_covariances"]),
        Vocabulary(arrays["words"], arrays["word_weights"]),
    )


def _poses(arrays: dict[str, NDArray[Any]], prefix: str, path: Path) -> Poses:
    """Poses from positions and unit quaternions."""
    quaternions, positions = arrays[f"{prefix}quaternions"], arrays[f"{prefix}positions"]
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    if not np.all(np.abs(lengths - 1.0) < 1e-6):
        row = int(np.argmax(~(np.abs(lengths - 1.0) < 1e-6)))
        raise DataError(
            f"{path}: {prefix}quaternions.npy: row {row} is not a unit quaternion; "
            "take another copy of the map, or make it again"
        )
    if len(quaternions) == 0:
        return Poses.identity(0, 3)
    return Poses(Rotation.from_quat(quaternions).as_matrix(), positions)


def _recording(entry: _Recording, path: Path) -> MapRecording:
    """A recording with its calibration."""
    rig = rig_from_kalibr(_yaml_text(entry.calibration), path / HEADER)
    return MapRecording(entry.name, entry.poses, rig)


def _yaml_text(table: dict[str, Any]) -> str:
    """A table as JSON that is YAML too.

    YAML does not know JSON's pairs of escapes for characters beyond 16 bits, so these stand as they
    are; it refuses or folds some others, which are escaped.
    """
    text = json.dumps(table, ensure_ascii=False)
    return _NOT_YAML.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _check_map(content: SlamMap, path: Path) -> None:
    """Refuse a map with inconsistent values.

    Raises:
        DataError: naming the array and the row.
    """
    if len(content) == 0 or len(content.features) == 0:
        raise DataError(f"{path}: the map is empty: it has no observations; make it again")
    if content.descriptors.shape[1] == 0 or len(content.vocabulary.words) == 0:
        raise DataError(
            f"{path}: the map has no descriptors, so that no place can be recognised in it; make "
            "it from images, or from tracks with descriptors"
        )
    for name, good, what in _rows(content):
        if not good.all():
            row = int(np.flatnonzero(~good.reshape(len(good), -1).all(axis=1))[0])
            raise DataError(f"{path}: {name}.npy: row {row} {what}; make the map again")


def _rows(content: SlamMap) -> Iterator[tuple[str, BoolArray, str]]:
    """Name of each array, whether its rows are valid, and what is wrong with invalid ones."""
    links, words = content.links, content.vocabulary
    for name, values, largest in (
        ("positions", content.poses.translations, _MAX_COORDINATE_M),
        ("points", content.points, _MAX_COORDINATE_M),
        ("normalized", content.normalized, _MAX_NORMALIZED),
        ("link_positions", links.measured.translations, _MAX_COORDINATE_M),
        ("link_covariances", links.covariances, _MAX_COORDINATE_M),
        ("word_weights", words.idf, _MAX_COORDINATE_M),
    ):
        yield name, np.abs(values) <= largest, f"is not finite or beyond {largest:g}"
    count, offsets = len(content), content.offsets
    ends = (offsets[0] == 0) & (offsets[-1] == len(content.features))
    rising = np.concatenate([[True], offsets[1:] >= offsets[:-1]])  # a difference may overflow
    yield "offsets", rising & ends, "does not lead from 0 to all observations"
    yield "features", _within(content.features, NO_FEATURE, len(content.points)), "is no feature"
    number = content.recording_of
    yield "recording_of", _within(number, 0, len(content.recordings)), "is no recording"
    yield "recording_of", np.diff(number, prepend=number[0]) >= 0, "is of an earlier recording"
    later = np.concatenate([[True], content.stamps_ns[1:] > content.stamps_ns[:-1]])
    first = np.diff(number, prepend=number[0]) > 0
    yield "stamps_ns", Files.are_times(content.stamps_ns), "is not a time in ns"
    yield "stamps_ns", later | first, "is not later than the row before"
    yield "link_ends", _within(links.ends, 0, count), "is no keyframe"
    yield "link_ends", links.ends[:, 0] != links.ends[:, 1], "joins a keyframe with itself"
    covariances = links.covariances
    same = np.isclose(covariances, covariances.transpose(0, 2, 1)).reshape(-1, 36)
    sound = same.all(axis=1) & (np.linalg.eigvalsh(covariances)[:, 0] > 0)
    yield "link_covariances", sound, "is not a covariance"
    yield "word_weights", words.idf >= 0, "is negative"


def _within(values: NDArray[Any], low: int, end: int) -> BoolArray:
    """Which values are at least `low` and below `end`."""
    return np.asarray((values >= low) & (values < end))
