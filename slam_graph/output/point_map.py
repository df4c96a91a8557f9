# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The points of the world that a run has estimated, and their PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam_graph.output.files import appearing

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class PointMap:
    """The last estimate of every feature."""

    def __init__(self) -> None:
        self._points: dict[int, tuple[float, float, float]] = {}

    def __len__(self) -> int:
        return len(self._points)

    def update(self, ids: IntArray, points: FloatArray) -> None:
        """Take over the positions (N, 3) in the world of features (N,)."""
        self._points.update(zip(ids.tolist(), map(tuple, points.tolist()), strict=True))

    def points(self) -> FloatArray:
        """(N, 3) in the world, in metres."""
        return np.array(list(self._points.values()), dtype=np.float64).reshape(-1, 3)


def write_ply(path: Path, points: FloatArray) -> None:
    """Write points (N, 3) as a binary PLY point cloud; points that are not finite are left out."""
    finite = points[np.isfinite(points).all(axis=1)]
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(finite)}\n"
        "property double x\nproperty double y\nproperty double z\nend_header\n"
    )
    with appearing(path) as partial:
        partial.write_bytes(header.encode("ascii") + finite.astype("<f8").tobytes())
