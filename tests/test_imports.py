# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Commands import what they use: the names of modules are checked, the time is not."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slam_graph.pose_graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_files import g2o_lines

OPTIONAL = ("rerun", "dask", "distributed", "pandas", "rosbags", "IPython", "scipy.stats")
"""No command needs them unless it is asked for what they do."""

DRAWING = ("matplotlib", "PIL", "slam_graph.visualization.style")

NOT_BEFORE_THE_FIRST_FRAME = (
    *OPTIONAL,
    *DRAWING,
    *("scipy.optimize", "scipy.integrate", "scipy.interpolate", "scipy.ndimage"),
    *("scipy.sparse", "scipy.spatial.distance", "scipy.special"),
    *("numpy.f2py.f2py2e", "numpy.ma.core", "numpy.polynomial.polynomial", "unittest"),
    "slam_graph.evaluation.absolute_pose_error",
    "slam_graph.backend.smoothing.final_adjustment",
    "slam_graph.loop_closure.loop_closing",
    "slam_graph.maps.map_model",
    "slam_graph.pose_graph.graph",
    "slam_graph.simulation.simulator",
)

NOT_TO_OPTIMIZE = (*OPTIONAL, "numba", "cv2", "slam_graph.backend.estimator")

NOT_FOR_HELP = (*OPTIONAL, *DRAWING, "numpy", "scipy", "gtsam", "cv2", "numba", "slam_graph.config")

COMMAND = """
import sys
from slam_graph.cli.main import main
sys.argv = ["slam-graph", *sys.argv[1:]]
try:
    main()
finally:
    print(*sys.modules, file=sys.stderr)
"""

TO_THE_FIRST_FRAME = """
from slam_graph.cli.loading import loading
with loading():
    from slam_graph.pipeline import Tracking
def track(self):
    raise SystemExit
Tracking.in_turn = track
"""
"""Ends a run where its first frame would be read."""

POSTPONED = """
import sys
from slam_graph.cli.loading import loading
with loading():
    import numpy as np
    from scipy.spatial.transform import Rotation
    import slam_graph.frontend.camera_tracker, slam_graph.frontend.matching
assert not {"scipy.spatial.distance", "scipy.special"} & sys.modules.keys()
assert {"numpy.ma", "numpy.polynomial"} <= sys.modules.keys()
assert not {"numpy.ma.core", "numpy.polynomial.polynomial"} & sys.modules.keys()
import numpy.ma.extras
from numpy.polynomial.polynomial import polyval
assert polyval(2.0, [1.0, 3.0]) == np.polynomial.Polynomial([1.0, 3.0])(2.0) == 7.0
assert numpy.ma.extras.average(np.ma.array([1.0, 2.0], mask=[True, False])) == 2.0

import scipy.spatial
from scipy.spatial.distance import cdist
assert cdist(np.zeros((1, 2)), np.ones((1, 2))) == np.sqrt(2.0)
assert "scipy.spatial._kdtree" not in sys.modules
assert isinstance(scipy.spatial.cKDTree(np.eye(3)).n, int)
assert "scipy.spatial._kdtree" in sys.modules
assert scipy.spatial.transform.Rotation is Rotation
"""
"""Uses parts of NumPy and SciPy whose import is postponed, by a module of theirs first."""


def imported(*arguments: str, before: str = "") -> set[str]:
    """Names of all modules that a command has imported when it ends."""
    done = subprocess.run(
        [sys.executable, "-c", before + COMMAND, *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return set(done.stderr.splitlines()[-1].split())


def test_a_run_imports_little_before_its_first_frame(tmp_path: Path) -> None:
    modules = imported("run", "demo", "--output", str(tmp_path), before=TO_THE_FIRST_FRAME)
    assert "slam_graph.backend.estimator" in modules
    assert not modules.intersection(NOT_BEFORE_THE_FIRST_FRAME)


@pytest.mark.parametrize("dimension", [2, 3])
def test_optimization_needs_no_estimator(tmp_path: Path, dimension: int) -> None:
    poses, information = Poses.identity(3, dimension), np.tile(np.eye(3 * dimension - 3), (3, 1, 1))
    ends = np.array([[0, 1], [1, 2], [0, 2]])
    graph = PoseGraph(np.arange(3), poses, ends, poses, information)
    path = tmp_path / "triangle.g2o"
    path.write_text("".join(g2o_lines(graph, poses)))
    modules = imported("optimize", str(path), "--output", str(tmp_path / "results"))
    assert "matplotlib" in modules
    assert not modules.intersection(NOT_TO_OPTIMIZE)


def test_help_imports_nothing_heavy() -> None:
    assert not imported("run", "--help").intersection(NOT_FOR_HELP)
    assert not imported("--help").intersection((*NOT_FOR_HELP, "pydantic"))


def test_what_is_postponed_is_there_when_it_is_used() -> None:
    subprocess.run([sys.executable, "-c", POSTPONED], timeout=300, check=True)
