# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Factor-graph SLAM: every back end as cost construction, Gauss-Newton steps, marginalization.

The names below are all that most programs need; each is imported when it is first used, so that
importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from slam_graph.version import __version__

if TYPE_CHECKING:
    from slam_graph.backend.estimator import Estimator
    from slam_graph.bundle_adjustment.bal_file import read_bal
    from slam_graph.bundle_adjustment.bal_policy import BalPolicy
    from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
    from slam_graph.config import RunConfig, load_config
    from slam_graph.datasets.dataset_registry import open_dataset
    from slam_graph.datasets.groundtruth import read_groundtruth
    from slam_graph.datasets.memory_sequence import dataset_from_arrays
    from slam_graph.errors import SlamGraphError
    from slam_graph.evaluation.ape import ape
    from slam_graph.evaluation.rpe import rpe
    from slam_graph.geometry.trajectory import NavState, Trajectory
    from slam_graph.maps.map_merge import merge_maps
    from slam_graph.maps.map_model import SlamMap
    from slam_graph.pipeline.run import RunResult, run
    from slam_graph.pose_graph.certificate import certify
    from slam_graph.pose_graph.graph_files import read_pose_graph
    from slam_graph.pose_graph.optimize import optimize_pose_graph
    from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy
    from slam_graph.results.map_output import load_map, save_map

__all__ = [
    "BalPolicy",
    "Estimator",
    "NavState",
    "PoseGraphPolicy",
    "RunConfig",
    "RunResult",
    "SlamGraphError",
    "SlamMap",
    "Trajectory",
    "__version__",
    "adjust_bundle",
    "ape",
    "certify",
    "dataset_from_arrays",
    "load_config",
    "load_map",
    "merge_maps",
    "open_dataset",
    "optimize_pose_graph",
    "read_bal",
    "read_groundtruth",
    "read_pose_graph",
    "rpe",
    "run",
    "save_map",
]

_HOME = {
    "BalPolicy": "slam_graph.bundle_adjustment.bal_policy",
    "Estimator": "slam_graph.backend.estimator",
    "NavState": "slam_graph.geometry.trajectory",
    "PoseGraphPolicy": "slam_graph.pose_graph.pose_graph_policy",
    "RunConfig": "slam_graph.config",
    "RunResult": "slam_graph.pipeline.run",
    "SlamGraphError": "slam_graph.errors",
    "SlamMap": "slam_graph.maps.map_model",
    "Trajectory": "slam_graph.geometry.trajectory",
    "adjust_bundle": "slam_graph.bundle_adjustment.bal_solve",
    "ape": "slam_graph.evaluation.ape",
    "certify": "slam_graph.pose_graph.certificate",
    "dataset_from_arrays": "slam_graph.datasets.memory_sequence",
    "load_config": "slam_graph.config",
    "load_map": "slam_graph.results.map_output",
    "merge_maps": "slam_graph.maps.map_merge",
    "open_dataset": "slam_graph.datasets.dataset_registry",
    "optimize_pose_graph": "slam_graph.pose_graph.optimize",
    "read_bal": "slam_graph.bundle_adjustment.bal_file",
    "read_groundtruth": "slam_graph.datasets.groundtruth",
    "read_pose_graph": "slam_graph.pose_graph.graph_files",
    "rpe": "slam_graph.evaluation.rpe",
    "run": "slam_graph.pipeline.run",
    "save_map": "slam_graph.results.map_output",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its home on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted(__all__)
