# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Writing trajectories as TUM files: `t[s] x y z qx qy qz qw`, nine decimals each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_graph.geometry.trajectory import Trajectory


def seconds_text(stamp_ns: int) -> str:
    """A time in seconds with all nine decimals, which a float would not keep."""
    sign, magnitude = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{magnitude // 10**9}.{magnitude % 10**9:09d}"


def tum_lines(trajectory: Trajectory) -> Iterator[str]:
    """The lines of a TUM file."""
    rows = np.hstack([trajectory.positions, trajectory.quaternions])
    for stamp, row in zip(trajectory.stamps_ns, rows, strict=True):
        yield f"{seconds_text(int(stamp))} {' '.join(f'{value:.9f}' for value in row.tolist())}\n"
