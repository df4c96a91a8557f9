# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimization (PGO).

Start at `optimize.py` (`optimize_pose_graph`), which names the three modules of the table:
`graph_cost.py`, `optimize.py`, no marginalization. `graph_files.py` reads and writes g2o and
TORO, `graph_initialization.py` makes initial estimates, `gnc.py` classifies false loop closures,
`certificate.py` (`certify`) bounds the global optimum. Settings are in `pose_graph_policy.py`, and
`pose_graph_solution.py` has the solution.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Certificate",
    "PoseGraph",
    "PoseGraphPolicy",
    "PoseGraphSolution",
    "Poses",
    "certify",
    "optimize_pose_graph",
    "read_pose_graph",
]

if TYPE_CHECKING:
    from slam_graph.pose_graph.certificate import Certificate, certify
    from slam_graph.pose_graph.graph import PoseGraph, Poses
    from slam_graph.pose_graph.graph_files import read_pose_graph
    from slam_graph.pose_graph.optimize import optimize_pose_graph
    from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy
    from slam_graph.pose_graph.pose_graph_solution import PoseGraphSolution
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "certificate": (
                "Certificate",
                "certify",
            ),
            "graph": (
                "PoseGraph",
                "Poses",
            ),
            "graph_files": ("read_pose_graph",),
            "optimize": ("optimize_pose_graph",),
            "pose_graph_policy": ("PoseGraphPolicy",),
            "pose_graph_solution": ("PoseGraphSolution",),
        },
    )
