# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimization (PGO).

Start at `optimize.py` (`optimize_pose_graph`), which names the three modules of the table:
`graph_cost.py`, `graph_steps.py`, no marginalization. `graph_files.py` reads and writes g2o and
TORO, `graph_initialization.py` makes initial estimates, `gnc.py` classifies false loop closures,
`certificate.py` (`certify`) bounds the global optimum. Settings are in `pose_graph_policy.py`.
"""
