# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimization (PGO).

Start at `optimize.py` (`optimize_pose_graph`), which names the three modules of the table:
`graph_cost.py`, `optimize.py`, no marginalization. `graph_files.py` reads and writes g2o and
TORO, `graph_initialization.py` makes initial estimates, `gnc.py` classifies false loop closures,
`certificate.py` (`certify`) bounds the global optimum. Settings are in `pose_graph_policy.py`.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "ROTATION_FIRST",
    "Certificate",
    "PoseGraph",
    "PoseGraphCostPolicy",
    "PoseGraphPolicy",
    "PoseGraphSolution",
    "Poses",
    "RotationInformation",
    "along_tree",
    "certify",
    "chi2_of_edges",
    "chi2_table",
    "g2o_lines",
    "marginal_covariances",
    "optimize_pose_graph",
    "read_pose_graph",
]

if TYPE_CHECKING:
    from slam_graph.pose_graph.certificate import Certificate, certify
    from slam_graph.pose_graph.graph import PoseGraph, Poses, RotationInformation
    from slam_graph.pose_graph.graph_cost import chi2_of_edges, chi2_table
    from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph
    from slam_graph.pose_graph.graph_initialization import along_tree
    from slam_graph.pose_graph.gtsam_graph import ROTATION_FIRST
    from slam_graph.pose_graph.optimize import marginal_covariances, optimize_pose_graph
    from slam_graph.pose_graph.pose_graph_policy import (
        PoseGraphCostPolicy,
        PoseGraphPolicy,
        PoseGraphSolution,
    )
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "certificate": ("Certificate", "certify"),
            "graph": ("PoseGraph", "Poses", "RotationInformation"),
            "graph_cost": ("chi2_of_edges", "chi2_table"),
            "graph_files": ("g2o_lines", "read_pose_graph"),
            "graph_initialization": ("along_tree",),
            "gtsam_graph": ("ROTATION_FIRST",),
            "optimize": ("marginal_covariances", "optimize_pose_graph"),
            "pose_graph_policy": ("PoseGraphCostPolicy", "PoseGraphPolicy", "PoseGraphSolution"),
        },
    )
