# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States and trajectories, their interpolation and alignment. Lie groups are GTSAM's.

- `trajectory`: `NavState` (its docstring has the order of the 15 components of the error),
  `Trajectory`, `StateHistory`.
- `interpolation`: `interpolate`.
- `trajectory_alignment`: `align`, `Similarity`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "DEFAULT_MAX_GAP_S",
    "AlignmentMode",
    "NavState",
    "Similarity",
    "StateHistory",
    "Trajectory",
    "align",
    "align_first_pose",
    "align_yaw",
    "interpolate",
    "tum_lines",
    "umeyama",
]

if TYPE_CHECKING:
    from slam_graph.geometry.trajectory import (
        DEFAULT_MAX_GAP_S,
        NavState,
        StateHistory,
        Trajectory,
        interpolate,
        tum_lines,
    )
    from slam_graph.geometry.trajectory_alignment import (
        AlignmentMode,
        Similarity,
        align,
        align_first_pose,
        align_yaw,
        umeyama,
    )
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "trajectory": (
                "DEFAULT_MAX_GAP_S",
                "NavState",
                "StateHistory",
                "Trajectory",
                "interpolate",
                "tum_lines",
            ),
            "trajectory_alignment": (
                "AlignmentMode",
                "Similarity",
                "align",
                "align_first_pose",
                "align_yaw",
                "umeyama",
            ),
        },
    )
