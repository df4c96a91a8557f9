# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with the lines of a pose graph: refused with file and line, or counted."""

from __future__ import annotations

import numpy as np

from slam_graph.datasets.rows import Rows
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.mapping.pose_graph import FloatArray, IntArray, PoseGraph


def check_numbers(rows: Rows, numbers: FloatArray) -> None:
    """Make sure that all numbers are finite.

    Raises:
        DataError: naming the first line where one is not.
    """
    bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    if len(bad):
        raise DataError(f"{rows.where(bad[0])}: a number is not finite")


def drop_repeated(rows: Rows, ids: IntArray, diagnostics: Diagnostics) -> IntArray:
    """The rows of vertices by increasing id, only the first of each id; others are counted."""
    _, first = np.unique(ids, return_index=True)
    for row in np.setdiff1d(np.arange(len(ids)), first):
        diagnostics.warn(
            "pose_graph_repeated_vertex",
            f"{rows.where(row)}: vertex {ids[row]} again; its first estimate is used",
        )
    return first.astype(np.int64)


def rows_of_keys(keys: IntArray, ids: IntArray, rows: Rows) -> IntArray:
    """(M, 2) rows of the poses that edges refer to by their ids.

    Raises:
        DataError: naming the line of the first edge to a vertex that is not there.
    """
    found = np.minimum(np.searchsorted(keys, ids), len(keys) - 1)
    missing = np.argwhere(keys[found] != ids)
    if len(missing):
        edge, end = missing[0]
        raise DataError(f"{rows.where(edge)}: edge to vertex {ids[edge, end]}, which is not there")
    return found.astype(np.int64)


def connected(graph: PoseGraph, rows: Rows, diagnostics: Diagnostics) -> PoseGraph:
    """The graph without edges from a pose to itself, checked; parts without a link are counted.

    Raises:
        DataError: if an information matrix is not positive definite, or no edge is left.
    """
    _check_information(graph.information, rows)
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
            f"{rows.path}: {size} poses from {key} on have no link to the first; "
            f"pose {key} is held where it is",
        )
    return graph


def _check_information(information: FloatArray, rows: Rows) -> None:
    """Make sure that all information matrices are positive definite."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(information)[:, 0]
        edge = int(np.argmin(smallest))
        raise DataError(
            f"{rows.where(edge)}: the information matrix is not positive definite "
            f"(smallest eigenvalue {smallest[edge]:.3g})"
        ) from None
