# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Factor-graph SLAM: every back end as cost construction, Gauss-Newton steps, marginalization.

The names below are all that most programs need. Each is imported when it is first used, so that
`import slam_graph` is quick.

    import slam_graph as sg

    result = sg.run("demo", algorithm="swf")
    result.save("results/demo")
    sg.load_result("results/demo").trajectory
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
    from slam_graph.experiment.comparison import compare
    from slam_graph.frontend.build_frontend import build_frontend
    from slam_graph.geometry.trajectory import NavState, StateHistory, Trajectory
    from slam_graph.loop_closure.close_loops import close_loops
    from slam_graph.maps.map_merge import merge_maps
    from slam_graph.maps.map_model import SlamMap
    from slam_graph.pipeline.run import run
    from slam_graph.pose_graph.certificate import certify
    from slam_graph.pose_graph.graph_files import read_pose_graph
    from slam_graph.pose_graph.optimize import optimize_pose_graph
    from slam_graph.pose_graph.pose_graph_policy import PoseGraphPolicy
    from slam_graph.results.map_output import load_map, save_map
    from slam_graph.results.run_result import RunResult
    from slam_graph.results.saved_run import SavedRun, load_result
    from slam_graph.sensors.measurements import FeatureFrame
    from slam_graph.sensors.rig import Rig
    from slam_graph.simulation.simulator import simulate

__all__ = [
    "BalPolicy",
    "Estimator",
    "FeatureFrame",
    "NavState",
    "PoseGraphPolicy",
    "Rig",
    "RunConfig",
    "RunResult",
    "SavedRun",
    "SlamGraphError",
    "SlamMap",
    "StateHistory",
    "Trajectory",
    "__version__",
    "adjust_bundle",
    "ape",
    "build_frontend",
    "certify",
    "close_loops",
    "compare",
    "dataset_from_arrays",
    "load_config",
    "load_map",
    "load_result",
    "merge_maps",
    "open_dataset",
    "optimize_pose_graph",
    "read_bal",
    "read_groundtruth",
    "read_pose_graph",
    "rpe",
    "run",
    "save_map",
    "simulate",
]

_HOME = {
    "BalPolicy": "slam_graph.bundle_adjustment.bal_policy",
    "Estimator": "slam_graph.backend.estimator",
    "FeatureFrame": "slam_graph.sensors.measurements",
    "NavState": "slam_graph.geometry.trajectory",
    "PoseGraphPolicy": "slam_graph.pose_graph.pose_graph_policy",
    "Rig": "slam_graph.sensors.rig",
    "RunConfig": "slam_graph.config",
    "RunResult": "slam_graph.results.run_result",
    "SavedRun": "slam_graph.results.saved_run",
    "SlamGraphError": "slam_graph.errors",
    "SlamMap": "slam_graph.maps.map_model",
    "StateHistory": "slam_graph.geometry.trajectory",
    "Trajectory": "slam_graph.geometry.trajectory",
    "adjust_bundle": "slam_graph.bundle_adjustment.bal_solve",
    "ape": "slam_graph.evaluation.ape",
    "build_frontend": "slam_graph.frontend.build_frontend",
    "certify": "slam_graph.pose_graph.certificate",
    "close_loops": "slam_graph.loop_closure.close_loops",
    "compare": "slam_graph.experiment.comparison",
    "dataset_from_arrays": "slam_graph.datasets.memory_sequence",
    "load_config": "slam_graph.config",
    "load_map": "slam_graph.results.map_output",
    "load_result": "slam_graph.results.saved_run",
    "merge_maps": "slam_graph.maps.map_merge",
    "open_dataset": "slam_graph.datasets.dataset_registry",
    "optimize_pose_graph": "slam_graph.pose_graph.optimize",
    "read_bal": "slam_graph.bundle_adjustment.bal_file",
    "read_groundtruth": "slam_graph.datasets.groundtruth",
    "read_pose_graph": "slam_graph.pose_graph.graph_files",
    "rpe": "slam_graph.evaluation.rpe",
    "run": "slam_graph.pipeline.run",
    "save_map": "slam_graph.results.map_output",
    "simulate": "slam_graph.simulation.simulator",
}
"""The module of each public name."""


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted(__all__)
