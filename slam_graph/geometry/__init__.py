# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States and trajectories, their interpolation and alignment. Lie groups are GTSAM's.

- `trajectory`: `NavState` (its docstring has the order of the 15 components of the error),
  `Trajectory`, `interpolate`.
- `state_history`: `StateHistory`, all states of a run.
- `trajectory_alignment`: `Similarity`, the map that aligns one trajectory with another.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "AlignmentMode",
    "NavState",
    "Similarity",
    "StateHistory",
    "Trajectory",
    "interpolate",
]

if TYPE_CHECKING:
    from slam_graph.geometry.state_history import StateHistory
    from slam_graph.geometry.trajectory import NavState, Trajectory, interpolate
    from slam_graph.geometry.trajectory_alignment import AlignmentMode, Similarity
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "state_history": ("StateHistory",),
            "trajectory": ("NavState", "Trajectory", "interpolate"),
            "trajectory_alignment": ("AlignmentMode", "Similarity"),
        },
    )
