# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""States and trajectories, their interpolation and alignment. Lie groups are GTSAM's.

- `trajectory`: `NavState` (its docstring has the order of the 15 components of the error),
  `Trajectory`, `StateHistory`.
- `interpolation`: `interpolate`.
- `trajectory_alignment`: `align`, `Similarity`.
"""
