# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing pose graphs: g2o files, 2D and 3D, and TORO's.

| line | values after the ids |
|---|---|
| `VERTEX_SE2`, `VERTEX2` | x y θ |
| `VERTEX_SE3:QUAT` | x y z qx qy qz qw |
| `VERTEX3` | x y z roll pitch yaw |
| `EDGE_SE2` | x y θ, upper triangle of the information by rows |
| `EDGE2`, `ODOMETRY` | x y θ, information as TORO orders it: xx xy yy θθ xθ yθ |
| `EDGE_SE3:QUAT` | x y z qx qy qz qw, upper triangle of the information by rows |
| `EDGE3` | x y z roll pitch yaw, upper triangle of the information by rows |

Faults that change the problem are refused with file and line; repairs are counted in `Diagnostics`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import Rows
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError, DataError, closest
from slam_graph.files import Files
from slam_graph.pose_graph.graph import InformationRepair, PoseGraph, Poses, RotationInformation
from slam_graph.pose_graph.information_repair import positive_definite


@dataclass(frozen=True, slots=True)
class _Line:
    """The format of one kind of line.

    Attributes:
        dimension: 2 or 3.
        ids: number of ids: 1 of a vertex, 2 of an edge.
        rotation: its parametrisation.
        order: column in the file of each entry of the upper triangle of the information, by rows.
    """

    dimension: int
    ids: int
    rotation: Literal["angle", "quaternion", "rpy"]
    order: tuple[int, ...] = ()

    @property
    def pose_size(self) -> int:
        """Number of values of a pose."""
        return self.dimension + {"angle": 1, "quaternion": 4, "rpy": 3}[self.rotation]

    def expected(self) -> str:
        """The expected values, for messages."""
        ids = "two ids" if self.ids == 2 else "an id"
        information = f", {len(self.order)} of the information" if self.order else ""
        return f"{ids}, {self.pose_size} numbers of the pose{information}"


_BY_ROWS_2D = tuple(range(6))
_TORO_2D = (0, 1, 4, 2, 5, 3)
_BY_ROWS_3D = tuple(range(21))

_LINES = {
    "VERTEX_SE2": _Line(2, 1, "angle"),
    "VERTEX2": _Line(2, 1, "angle"),
    "VERTEX_SE3:QUAT": _Line(3, 1, "quaternion"),
    "VERTEX3": _Line(3, 1, "rpy"),
    "EDGE_SE2": _Line(2, 2, "angle", _BY_ROWS_2D),
    "EDGE2": _Line(2, 2, "angle", _TORO_2D),
    "ODOMETRY": _Line(2, 2, "angle", _TORO_2D),
    "EDGE_SE3:QUAT": _Line(3, 2, "quaternion", _BY_ROWS_3D),
    "EDGE3": _Line(3, 2, "rpy", _BY_ROWS_3D),
}


_LARGEST_INFORMATION = 1e50
"""Largest magnitude of a number of information, so that costs are finite."""

_QUATERNION_TOLERANCE = 0.1
"""Largest deviation of the norm of a quaternion from 1: files have few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """All lines of a file of one kind.

    Attributes:
        rows: the lines and their line numbers.
        ids: (L, 1 or 2).
        poses: of the vertices, or measurements of the edges.
        information: (L, k, k) of edges; (0, k, k) of vertices.
    """

    rows: Rows
    ids: IntArray
    poses: Poses
    information: FloatArray


def read_pose_graph(
    path: Path | str,
    diagnostics: Diagnostics | None = None,
    rotation_information: RotationInformation = "angle",
    repair: InformationRepair | None = None,
) -> PoseGraph:
    """Read a pose graph.

    Args:
        path: of a g2o or TORO file.
        diagnostics: counts repairs.
        rotation_information: whether the information of 3D rotations belongs to the angle (GTSAM)
            or to the vector part of the quaternion (g2o).
        repair: what stands in for information matrices that are not positive definite; without it
            they are refused.

    Faults that do not change the problem are repaired and counted in `diagnostics`, and so are
    lines of unknown kinds, which are skipped.

    Raises:
        DataError: naming file and line, if the file cannot be read, holds no edges, is cut short,
            has an edge to a missing vertex, numbers that are not finite, or an information matrix
            that is not positive definite.
        ConfigError: if `rotation_information` or `repair` is unknown.
    """
    if rotation_information not in get_args(RotationInformation):
        hint = closest(str(rotation_information), get_args(RotationInformation))
        raise ConfigError(f"unknown rotation_information '{rotation_information}'; {hint}")
    if repair is not None and repair not in get_args(InformationRepair):
        raise ConfigError(
            f"unknown repair '{repair}'; {closest(str(repair), get_args(InformationRepair))}"
        )
    path, diagnostics = Path(path), diagnostics or Diagnostics()
    blocks = [_parse(rows, tag) for tag, rows in _by_kind(path, diagnostics).items()]
    vertices = [block for block in blocks if block.ids.shape[1] == 1]
    between = [block for block in blocks if block.ids.shape[1] == 2]
    if not between:
        raise DataError(f"{path}: no edges; lines may begin with {', '.join(_LINES)}")
    if len({block.poses.dimension for block in blocks}) > 1:
        raise DataError(f"{path}: 2D and 3D poses in one file")
    rows, ids, measured, information = _joined(between)
    keys, estimates = np.unique(ids), None
    if vertices:
        vertex_rows, vertex_ids, poses, _ = _joined(vertices)
        kept = _first_of_each_id(vertex_rows, vertex_ids[:, 0], diagnostics)
        keys, estimates = vertex_ids[kept, 0], poses.select(kept)
    edges = _rows_of_keys(keys, ids, rows)
    information = positive_definite(information, rows, repair, diagnostics)
    graph = PoseGraph(
        keys, estimates, edges, measured, information, rotation_information, path.stem
    )
    return _checked(graph, rows, diagnostics)


def _by_kind(path: Path, diagnostics: Diagnostics) -> dict[str, Rows]:
    """The lines of a file by their first word; unknown kinds are counted."""
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    kinds: dict[str, Rows] = {}
    for number, line in enumerate(lines, 1):
        rows = kinds.get(line.partition(" ")[0])  # of most lines; the first of a kind goes on
        if rows is None:
            tag = line.split(None, 1)[0] if line and not line.isspace() else "#"
            if tag not in _LINES:
                if not tag.startswith("#"):
                    diagnostics.warn(
                        "pose_graph_line_ignored",
                        f"{path}:{number}: '{tag[:40]}' is not a known kind of line; left out",
                    )
                continue
            rows = kinds.setdefault(tag, Rows(path, [], []))
        rows.lines.append(line)
        rows.numbers.append(number)
    return kinds


def _parse(rows: Rows, tag: str) -> _Block:
    """Parse all lines of one kind."""
    line = _LINES[tag]
    size, entries = line.pose_size, len(line.order)
    if tag in ("EDGE2", "EDGE3") and len(rows.lines[0].split()) == 1 + line.ids + size:
        entries = 0  # TORO files may omit the information: it is the identity then
    dtype = [("tag", "S16"), ("ids", np.int64, (line.ids,)), ("numbers", float, (size + entries,))]
    table = rows.parse(dtype, f"{tag}, {line.expected()}", delimiter=None)
    ids, numbers = table["ids"], table["numbers"]
    _check_numbers(rows, numbers[:, :size], Files.LARGEST)
    _check_numbers(rows, numbers[:, size:], _LARGEST_INFORMATION)
    k = 3 * (line.dimension - 1)
    information = np.tile(np.eye(k), (len(ids) if line.ids == 2 else 0, 1, 1))
    if entries:
        information = _information(numbers[:, size:], line.order)
    return _Block(rows, ids, _poses(rows, numbers[:, :size], line), information)


def _information(entries: FloatArray, order: tuple[int, ...]) -> FloatArray:
    """(L, k, k) symmetric matrices from their upper triangles.

    Some writers use the order by rows in TORO's `EDGE2` too: it is taken where TORO's order would
    give no information on y or θ.
    """
    if order == _TORO_2D and not (entries[:, 2:4] > 0).any(axis=0).all():
        order = _BY_ROWS_2D
    k = 3 if len(order) == 6 else 6
    full = np.zeros((len(entries), k, k))
    above = np.triu_indices(k)
    full[:, *above] = entries[:, order]
    full[:, *above[::-1]] = entries[:, order]
    return full


def _poses(rows: Rows, numbers: FloatArray, line: _Line) -> Poses:
    """Poses from the values of a file."""
    translations, angles = numbers[:, : line.dimension], numbers[:, line.dimension :]
    if line.rotation == "angle":
        cos, sin = np.cos(angles[:, 0]), np.sin(angles[:, 0])
        return Poses(np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2), translations)
    if line.rotation == "rpy":
        return Poses(Rotation.from_euler("xyz", angles).as_matrix(), translations)
    length = np.linalg.norm(np.clip(angles, -2.0, 2.0), axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _QUATERNION_TOLERANCE)
    if len(bad):
        raise DataError(f"{rows.where(int(bad[0]))}: the quaternion is not of unit length")
    return Poses(Rotation.from_quat(angles).as_matrix(), translations)


def _joined(blocks: list[_Block]) -> tuple[Rows, IntArray, Poses, FloatArray]:
    """All blocks as one, in the order of the file."""
    path = blocks[0].rows.path
    numbers = np.concatenate([block.rows.numbers for block in blocks])
    order = np.argsort(numbers, kind="stable")
    lines = [line for block in blocks for line in block.rows.lines]
    poses = Poses(
        np.concatenate([block.poses.rotations for block in blocks]),
        np.concatenate([block.poses.translations for block in blocks]),
    )
    information = np.concatenate([block.information for block in blocks])
    return (
        Rows(path, [lines[k] for k in order], numbers[order].tolist()),
        np.concatenate([block.ids for block in blocks])[order],
        poses.select(order),
        information[order] if len(information) else information,
    )


def _check_numbers(rows: Rows, numbers: FloatArray, largest: float) -> None:
    """Check that all numbers are finite, and not beyond a magnitude.

    Raises:
        DataError: naming the first line where one is not.
    """
    bad = np.flatnonzero(~(np.abs(numbers) <= largest).all(axis=1))
    if len(bad):
        raise DataError(f"{rows.where(bad[0])}: a number is not finite, or too large")


def _first_of_each_id(rows: Rows, ids: IntArray, diagnostics: Diagnostics) -> IntArray:
    """The rows of the vertices, by increasing id; repeated ids are counted."""
    _, first = np.unique(ids, return_index=True)
    for row in np.setdiff1d(np.arange(len(ids)), first):
        diagnostics.warn(
            "pose_graph_repeated_vertex",
            f"{rows.where(row)}: vertex {ids[row]} is repeated; its first estimate is used",
        )
    return first.astype(np.int64)


def _rows_of_keys(keys: IntArray, ids: IntArray, rows: Rows) -> IntArray:
    """(M, 2) rows of the poses that edges refer to by id.

    Raises:
        DataError: naming the line of the first edge to a missing vertex.
    """
    found = np.minimum(np.searchsorted(keys, ids), len(keys) - 1)
    missing = np.argwhere(keys[found] != ids)
    if len(missing):
        edge, end = missing[0]
        raise DataError(f"{rows.where(edge)}: edge to vertex {ids[edge, end]}, which is missing")
    return found.astype(np.int64)


def _checked(graph: PoseGraph, rows: Rows, diagnostics: Diagnostics) -> PoseGraph:
    """The graph without edges from a pose to itself; unconnected components are counted.

    Raises:
        DataError: if no edge is left.
    """
    loops = graph.edges[:, 0] == graph.edges[:, 1]
    for row in np.flatnonzero(loops).tolist():
        diagnostics.warn("pose_graph_edge_to_itself", f"{rows.where(row)}: left out")
    graph = graph.keep_edges(~loops) if loops.any() else graph
    if len(graph.edges) == 0:
        raise DataError(f"{rows.path}: no edges between two poses")
    for part in range(1, len(graph.anchors)):
        size, key = np.count_nonzero(graph.components == part), graph.keys[graph.anchors[part]]
        diagnostics.warn(
            "pose_graph_not_connected",
            f"{rows.path}: {size} poses from {key} on are not connected to the first; "
            f"pose {key} is fixed",
        )
    return graph


def g2o_lines(graph: PoseGraph, poses: Poses) -> Iterator[str]:
    """The lines of a g2o file with given poses; reading it gives the same numbers back."""
    d = graph.dimension
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if d == 2 else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    for key, pose in zip(graph.keys.tolist(), _numbers(poses).tolist(), strict=True):
        yield f"{vertex} {key} {' '.join(map(repr, pose))}\n"
    above = np.triu_indices(3 * (d - 1))
    numbers = np.hstack([_numbers(graph.measured), graph.information[:, *above]])
    ends = graph.keys[graph.edges].tolist()
    for (i, j), row in zip(ends, numbers.tolist(), strict=True):
        yield f"{edge} {i} {j} {' '.join(map(repr, row))}\n"


def _numbers(poses: Poses) -> NDArray[np.float64]:
    """(N, 3) x y θ, or (N, 7) x y z qx qy qz qw."""
    if poses.dimension == 2:
        return np.column_stack([poses.translations, poses.angles()])
    turns = Rotation.from_matrix(poses.rotations).as_quat(canonical=True)
    return np.hstack([poses.translations, turns])
