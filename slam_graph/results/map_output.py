# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Maps as files of a run: the estimated points, PLY files, saving and loading of maps."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slam_graph import maps
from slam_graph.arrays import FloatArray, GrowingTable, IntArray
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.results.result_files import find_map, refuse_to_replace

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap

_POINT_COLOUR = (200, 200, 200)
_CAMERA_COLOUR = (220, 30, 30)

_POSITION_PROPERTIES = tuple(f"property double {axis}" for axis in "xyz")

RECENT = 10_000
"""Features are moved from the dictionary into the tables when there are more than this."""
_REMEMBERED_NS = 30_000_000_000
"""So long it is known which features were estimated when: states are taken back sooner."""


class PointMap:
    """The last estimate of every feature; some 24 bytes for each but the recent ones."""

    def __init__(self) -> None:
        self._updates: deque[tuple[int, IntArray]] = deque()
        self._recent: dict[int, tuple[float, float, float]] = {}
        self._ids = GrowingTable(1, np.int64)
        self._points = GrowingTable(3)

    def __len__(self) -> int:
        self._pack()
        return len(self._ids)

    def update(self, stamp_ns: int, ids: IntArray, points: FloatArray) -> None:
        """Replace the positions of features.

        Args:
            stamp_ns: time of the state that they were estimated with, later than those before.
            ids: (N,) of the features.
            points: (N, 3) in the world, m.
        """
        self._recent.update(zip(ids.tolist(), map(tuple, points.tolist()), strict=True))
        if len(self._recent) > RECENT:
            self._pack()
        self._updates.append((stamp_ns, ids))
        while self._updates[0][0] < stamp_ns - _REMEMBERED_NS:
            self._updates.popleft()

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the features that were estimated at or after a time, of the last half minute."""
        self._pack()
        gone = [np.zeros(0, np.int64)]
        while self._updates and self._updates[-1][0] >= stamp_ns:
            gone.append(self._updates.pop()[1])
        self._drop(np.concatenate(gone))

    def points(self) -> FloatArray:
        """(N, 3) in the world, m."""
        self._pack()
        return self._points.rows()

    def _pack(self) -> None:
        """Move the recent features into the tables; older positions of the same ids are dropped."""
        if not self._recent:
            return
        ids = np.array(list(self._recent), dtype=np.int64)
        points = np.array(list(self._recent.values()), dtype=np.float64).reshape(-1, 3)
        self._drop(ids)
        self._ids.extend(ids[:, None])
        self._points.extend(points)
        self._recent = {}

    def _drop(self, ids: IntArray) -> None:
        """Drop features (N,); they are mostly among the last ones."""
        dropped = np.isin(self._ids.rows()[:, 0], ids)
        if not dropped.any():
            return
        first = int(dropped.argmax())
        for table in (self._ids, self._points):
            rest = table.rows()[first:][~dropped[first:]]
            table.cut(first)
            table.extend(rest)


def write_ply(path: Path, points: FloatArray, centres: FloatArray | None = None) -> None:
    """Write points (N, 3) as a binary PLY point cloud; points that are not finite are left out.

    Args:
        path: of the file.
        points: of the world.
        centres: (M, 3) of cameras, if they are to be shown: then points are grey and these red.
    """
    finite = points[np.isfinite(points).all(axis=1)]
    fields: list[tuple[str, str, int]] = [("place", "<f8", 3)]
    lines = list(_POSITION_PROPERTIES)
    if centres is not None:
        fields.append(("colour", "u1", 3))
        lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    places = finite if centres is None else np.concatenate([finite, centres])
    vertices = np.empty(len(places), fields)
    vertices["place"] = places
    if centres is not None:
        vertices["colour"][: len(finite)] = _POINT_COLOUR
        vertices["colour"][len(finite) :] = _CAMERA_COLOUR
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *lines,
        "end_header",
    ]
    with Files.appearing(path) as partial:
        partial.write_bytes("\n".join(header).encode("ascii") + b"\n" + vertices.tobytes())


def read_ply(path: Path | str) -> FloatArray:
    """Read the points (N, 3) of a point cloud that `write_ply` wrote without cameras.

    Points that are not finite, or farther away than any, are left out.

    Raises:
        DataError: if the file is missing or has another form.
    """
    path = Path(path)
    try:
        header, separator, body = path.read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    lines = header.decode("ascii", errors="replace").splitlines()
    properties = tuple(line for line in lines if line.startswith("property"))
    binary = "format binary_little_endian 1.0" in lines
    whole = f"element vertex {len(body) // 24}" in lines and len(body) % 24 == 0
    if not separator or not binary or properties != _POSITION_PROPERTIES or not whole:
        raise DataError(f"{path}: not a point cloud of x, y, z as slam-graph writes it")
    points = np.frombuffer(body, "<f8").reshape(-1, 3).astype(np.float64)
    return np.asarray(points[Files.are_measurable(points).all(axis=1)])


def save_map(content: SlamMap, path: Path | str, force: bool = False) -> None:
    """Write a map file. If writing fails, a file that was there before stays as it was.

    Args:
        content: the map.
        path: of the file.
        force: whether an existing file may be replaced.

    Raises:
        DataError: if the file exists, or cannot be written (a full disk, no permission).
    """
    path = Path(path)
    refuse_to_replace(path, force)
    with Files.writing(path, "map "), Files.appearing(path) as partial:
        maps.write_map(partial, content)


def load_map(path: Path | str) -> SlamMap:
    """Read a map.

    Args:
        path: of a map file, of the folder of a run that saved one, or of a folder of runs, of which
            the latest is taken.

    Raises:
        DataError: if there is none, or it cannot be used.
    """
    return maps.read_map(find_map(path))


def export_map(
    content: SlamMap, ply: Path | None = None, tum: Path | None = None, force: bool = False
) -> list[Path]:
    """Write a map in formats of other programs; nothing is written if one of the files exists.

    Args:
        content: the map.
        ply: the points, and the keyframes in red, as a point cloud.
        tum: the keyframes as TUM trajectories, one for each recording: this file, or several with
            the number of the recording before the suffix.
        force: whether existing files may be replaced.

    Returns:
        The files.

    Raises:
        DataError: if a file exists or cannot be written.
    """
    clouds = [] if ply is None else [ply]
    tracks = [] if tum is None else _numbered(tum, len(content.recordings))
    for file in (*clouds, *tracks):
        refuse_to_replace(file, force)
    for file in clouds:
        write_ply(file, content.points, content.poses.translations)
    for file, trajectory in zip(tracks, content.trajectories(), strict=False):
        Files.write_text(file, trajectory.tum_lines())
    return [*clouds, *tracks]


def _numbered(path: Path, count: int) -> list[Path]:
    """Paths of `count` files: the path itself if it is only one."""
    return [path.with_stem(f"{path.stem}_{n}") if count > 1 else path for n in range(count)]
