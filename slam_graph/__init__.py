# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Factor-graph SLAM: every back end as cost construction, Gauss-Newton steps, marginalization.

The names below are all that most programs need. Each is imported when it is first used, so that
`import slam_graph` is quick.

    import slam_graph as sg

    result = sg.run("demo", algorithm="swf")
    result.save("results/mine")
    sg.load_result("results/mine").trajectory
"""

from slam_graph.lazy import lazy_exports
from slam_graph.version import __version__

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
    "batch",
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

TYPE_CHECKING = False
"""As in `typing`, which takes too long: a signal may come before the command minds it."""

if TYPE_CHECKING:
    from slam_graph.backend import Estimator
    from slam_graph.bundle_adjustment import BalPolicy, adjust_bundle, read_bal
    from slam_graph.config import RunConfig, load_config
    from slam_graph.datasets import dataset_from_arrays, open_dataset, read_groundtruth
    from slam_graph.errors import SlamGraphError
    from slam_graph.evaluation import ape, rpe
    from slam_graph.experiment import batch, compare
    from slam_graph.frontend import build_frontend
    from slam_graph.geometry import NavState, StateHistory, Trajectory
    from slam_graph.loop_closure import close_loops
    from slam_graph.maps import SlamMap, merge_maps
    from slam_graph.pipeline import run
    from slam_graph.pose_graph import PoseGraphPolicy, certify, optimize_pose_graph, read_pose_graph
    from slam_graph.results import RunResult, SavedRun, load_map, load_result, save_map
    from slam_graph.sensors import FeatureFrame, Rig
    from slam_graph.simulation import simulate
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "backend": ("Estimator",),
            "bundle_adjustment": ("BalPolicy", "adjust_bundle", "read_bal"),
            "config": ("RunConfig", "load_config"),
            "datasets": ("dataset_from_arrays", "open_dataset", "read_groundtruth"),
            "errors": ("SlamGraphError",),
            "evaluation": ("ape", "rpe"),
            "experiment": ("batch", "compare"),
            "frontend": ("build_frontend",),
            "geometry": ("NavState", "StateHistory", "Trajectory"),
            "loop_closure": ("close_loops",),
            "maps": ("SlamMap", "merge_maps"),
            "pipeline": ("run",),
            "pose_graph": ("PoseGraphPolicy", "certify", "optimize_pose_graph", "read_pose_graph"),
            "results": ("RunResult", "SavedRun", "load_map", "load_result", "save_map"),
            "sensors": ("FeatureFrame", "Rig"),
            "simulation": ("simulate",),
        },
    )
