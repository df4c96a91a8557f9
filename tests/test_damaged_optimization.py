# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs and bundle adjustments, damaged in many ways and then optimised by every method.

What is read is sound (`test_damaged_files`); so must be what is made of it, or one line says why
there is nothing.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import tried
from pose_graphs import laps, with_false_loops
from sound import sound_poses, sound_table

from slam_graph.bundle_adjustment import BalPolicy, adjust_bundle, read_bal
from slam_graph.diagnostics import Diagnostics
from slam_graph.pose_graph import PoseGraphPolicy, certify, optimize_pose_graph, read_pose_graph
from slam_graph.pose_graph.graph_files import g2o_lines
from slam_graph.results import BalResult, PoseGraphResult

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]

IN_CI = 8
"""Ways in which a file is damaged, for each method."""


def solve_graph(path: Path, policy: PoseGraphPolicy, others: dict[str, Any]) -> None:
    """What `slam-graph optimize --certify --covariances --save` does, without its files."""
    diagnostics, saved = Diagnostics(), path.with_name("optimized.g2o")
    graph = read_pose_graph(path, diagnostics, **others)
    solution = optimize_pose_graph(graph, policy, diagnostics)
    sound_poses(solution.poses)
    covariances = solution.covariances()
    assert np.isfinite(covariances).all()
    certificate = certify(solution.weighted_graph(), solution.poses)
    counts = diagnostics.counts
    result = PoseGraphResult(policy, solution, certificate, covariances, {}, counts)
    sound_table(result.metrics)
    result.save_problem(saved)
    sound_poses(read_pose_graph(saved).anchor_poses())


METHODS = ("gauss_newton", "levenberg_marquardt", "dogleg", "isam2")
STARTS = ("auto", "chordal", "odometry", "file")
ROBUST = ("none", "gnc", "huber", "cauchy", "geman_mcclure", "dcs", "truncated")

POLICIES = [
    *(("auto", "none", method) for method in METHODS),
    *((start, "none", "gauss_newton") for start in STARTS[1:]),
    *(("auto", robust, "levenberg_marquardt") for robust in ROBUST[1:]),
]


@pytest.mark.parametrize(("start", "robust", "method"), POLICIES)
@pytest.mark.parametrize("dimension", [2, 3])
def test_pose_graphs(tmp_path: Path, dimension: int, start: str, robust: str, method: str) -> None:
    path = tmp_path / "graph.g2o"
    graph, truth = laps(dimension, 0.01, poses=12, lap=5)
    if robust != "none":
        graph = with_false_loops(graph, 2)
    path.write_text("".join(g2o_lines(graph, truth)))
    policy = PoseGraphPolicy.model_validate(
        {"cost": {"initialization": start, "robust": robust}, "gauss_newton": {"method": method}}
    )
    tried(path, lambda: solve_graph(path, policy, {}), IN_CI)


@pytest.mark.parametrize("repair", ["nearest", "isotropic"])
@pytest.mark.parametrize("meaning", ["angle", "quaternion"])
def test_information_that_is_repaired(tmp_path: Path, meaning: str, repair: str) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("".join(g2o_lines(*laps(3, 0.01, poses=12, lap=5))))
    others = {"rotation_information": meaning, "repair": repair}
    tried(path, lambda: solve_graph(path, PoseGraphPolicy(), others), IN_CI)


def test_graphs_of_the_plane_by_lago(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("".join(g2o_lines(*laps(2, 0.01, poses=12, lap=5))))
    policy = PoseGraphPolicy.model_validate({"cost": {"initialization": "lago"}})
    tried(path, lambda: solve_graph(path, policy, {}), IN_CI)


def solve_bundle(path: Path, policy: BalPolicy) -> None:
    """What `slam-graph optimize --save` does with a bundle adjustment, without its files."""
    diagnostics, saved = Diagnostics(), path.with_name("optimized.txt")
    solution = adjust_bundle(read_bal(path), policy, diagnostics)
    found = solution.estimates
    for values in (found.translations, found.intrinsics, found.points, found.rotations):
        assert np.isfinite(values).all()
    result = BalResult(policy, solution, {}, diagnostics.counts)
    sound_table(result.metrics)
    result.save_problem(saved)
    read_bal(saved)


def bundle_text() -> str:
    """Three cameras and eight points, each seen by all."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (8, 2)), rng.uniform(-6.0, -4.0, 8)])
    lines = ["3 8 24"]
    for camera, point in itertools.product(range(3), range(8)):
        moved = points[point] + [0.5 * camera, 0.0, 0.0]
        u, v = -500.0 * moved[:2] / moved[2] + rng.normal(0.0, 0.5, 2)
        lines.append(f"{camera} {point} {u:.6f} {v:.6f}")
    for camera in range(3):
        lines += ["0", "0.01", "0", f"{0.5 * camera}", "0", "0", "500", "0", "0"]
    lines += [f"{value:.6f}" for value in points.ravel().tolist()]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("intrinsics", ["per_camera", "shared", "fixed"])
def test_bundles(tmp_path: Path, intrinsics: str, robust: str) -> None:
    path = tmp_path / "problem.txt"
    path.write_text(bundle_text())
    policy = BalPolicy.model_validate({"cost": {"intrinsics": intrinsics, "robust": robust}})
    tried(path, lambda: solve_bundle(path, policy), IN_CI)
