# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs: known optima, certificates, speed beside bare GTSAM, false loop closures."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.metric import EXACT, Metric, info
from benchmarks.pose_graph_problems import drive, grid_walk
from benchmarks.suite import Benchmark, Outcome
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.pose_graph.certificate import certify
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import chi2_table
from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph
from slam_graph.pose_graph.gtsam_graph import (
    anchor_factors,
    edge_chi2,
    edge_factors,
    factor_graph,
    values_of,
)
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.pose_graph.pose_graph_policy import (
    PoseGraphCostPolicy,
    PoseGraphPolicy,
    PoseGraphStepsPolicy,
)

FOLDER = "posegraphs"

OPTIMA = {
    "sphere2500": (675.70096, 1687.0058),
    "parking-garage": (0.6341924, 1.2625244),
    "M3500": (68.957439, 193.86226),
    "intel": (22.502117, 52.348227),
    "MIT": (20.603474, 61.154116),
}
"""GTSAM's error at the optimum, and SE-Sync's certified optimum."""

OPTIMUM_BAR = 1e-6
TIME_BAR = 1.0
REPETITIONS = 5
GRID, DRIVE = (10_000, 10_000), (4541, 150)
"""Poses and loop closures of made-up graphs; the second is as long as KITTI's sequence 00."""

WITH_FALSE_LOOPS = ("sphere2500", "M3500", "intel")
SHARES = (0.1, 0.3, 0.5)
FALSE_BEYOND = 50.0
"""A random loop closure that the clean graph contradicts by a smaller χ² may as well be true, as
far as anybody can tell from the graph, and is drawn again."""
SURELY_FALSE = 1e3
"""With a larger χ² at the optimum a loop closure is false however far the poses may give way."""
ATE_BAR = 2.0
ATE_FLOOR_M = 1e-5
"""Below this an error is the rounding of the last step."""

TIGHT = PoseGraphStepsPolicy(tolerance=1e-12)


def optima(data: Path) -> Outcome:
    """What is reached from our own first estimates, and what the certificate says of it."""
    outcome = Outcome()
    for name, (error, objective) in OPTIMA.items():
        graph = read_pose_graph(data / FOLDER / f"{name}.g2o")
        solution = optimize_pose_graph(graph)
        reached = chi2_table(graph, solution.poses)["gtsam_error"]
        found = certify(graph, solution.poses)
        relative = {"error": reached / error - 1.0, "sesync": found.objective / objective - 1.0}
        outcome.metrics += [
            *(
                Metric(f"{name}.{key}", abs(value), "relative", "lower", OPTIMUM_BAR, None)
                for key, value in relative.items()
            ),
            Metric(f"{name}.certified", float(found.certified), "1 is yes", "higher", 1.0, EXACT),
            info(f"{name}.gap", found.gap / found.objective, "relative"),
        ]
    return outcome


def speed(data: Path) -> Outcome:
    """Reading and solving, beside a bare script of GTSAM that does the same."""
    with TemporaryDirectory() as folder:
        paths = [data / FOLDER / f"{name}.g2o" for name in ("sphere2500", "M3500")]
        for graph in (grid_walk(*GRID), drive(*DRIVE)):
            assert graph.estimates is not None
            paths.append(Path(folder) / f"{graph.name}.g2o")
            paths[-1].write_text("".join(g2o_lines(graph, graph.estimates)), encoding="ascii")
        metrics = [metric for path in paths for metric in _speed_of(path)]
    return Outcome(
        metrics,
        [
            f"CPU time, the shortest of {REPETITIONS} turns each, from the file to the optimum",
            f"grid: {GRID[0]} poses in 2D and {GRID[1]} loop closures; drive: {DRIVE[0]} poses in "
            f"3D and {DRIVE[1]} loop closures, both made up",
        ],
    )


def _speed_of(path: Path) -> list[Metric]:
    """The time beside that of the bare script, for one file."""
    reached: dict[str, float] = {}
    seconds: dict[str, list[float]] = {"ours": [], "bare": []}
    for _ in range(REPETITIONS):
        for name, solve in (("ours", ours), ("bare", bare_script)):
            start = process_time()
            reached[name] = solve(path)
            seconds[name].append(process_time() - start)
    assert abs(reached["ours"] / reached["bare"] - 1.0) < OPTIMUM_BAR, path
    best = {name: min(values) for name, values in seconds.items()}
    key = "time" if path.stem == "sphere2500" else f"{path.stem}.time"
    return [
        Metric(key, best["ours"] / best["bare"], "× bare", "lower", TIME_BAR, None),
        info(f"{path.stem}.bare", best["bare"], "s CPU"),
    ]


def ours(path: Path) -> float:
    """The error that we get to."""
    return optimize_pose_graph(read_pose_graph(path)).minimum.cost


def bare_script(path: Path) -> float:
    """The error that a user of GTSAM gets to in five lines, as in its examples."""
    in_space = "SE3" in path.read_text(encoding="ascii")
    graph, _ = gtsam.readG2o(str(path), in_space)
    anchored = gtsam.NonlinearFactorGraph(graph)
    if in_space:
        variances = np.repeat([1e-6, 1e-4], 3)
        noise = gtsam.noiseModel.Diagonal.Variances(variances)
        anchored.addPriorPose3(0, gtsam.Pose3(), noise)
        start = gtsam.InitializePose3.initialize(anchored)
    else:
        noise = gtsam.noiseModel.Diagonal.Variances(np.array([1e-6, 1e-6, 1e-8]))
        anchored.addPriorPose2(0, gtsam.Pose2(), noise)
        start = gtsam.lago.initialize(anchored)
    return float(graph.error(gtsam.GaussNewtonOptimizer(anchored, start).optimize()))


def false_loops(data: Path) -> Outcome:
    """GNC with false loop closures: how far it is from the optimum of the clean graph."""
    outcome = Outcome()
    robust = PoseGraphPolicy(cost=PoseGraphCostPolicy(robust="gnc"), gauss_newton=TIGHT)
    for name in WITH_FALSE_LOOPS:
        graph = read_pose_graph(data / FOLDER / f"{name}.g2o")
        optimum = optimize_pose_graph(graph, PoseGraphPolicy(gauss_newton=TIGHT)).poses
        clean = ate(graph, optimum, optimize_pose_graph(graph, robust).poses)
        outcome.metrics += [info(f"{name}.false_0.ate", clean, "m")]
        for share in SHARES:
            worse = with_false_loops(graph, optimum, share, np.random.default_rng(0))
            solution = optimize_pose_graph(worse, robust)
            error = ate(graph, optimum, solution.poses)
            bar = ATE_BAR * max(clean, ATE_FLOOR_M)
            key, true = f"{name}.false_{share * 100:.0f}", len(graph.edges)
            wrong = np.sum(solution.weights[:true] < 0.5) + np.sum(solution.weights[true:] > 0)
            outcome.metrics += [
                Metric(f"{key}.ate", error, "m", "lower", bar, None),
                Metric(f"{key}.misjudged", float(wrong), "edges", "lower", 0.0, EXACT),
            ]
    outcome.notes += [
        "x %: of all loop closures so many are false; each is a measured one of the graph between "
        "two random poses, which the clean graph contradicts (χ² of the innovation above "
        f"{FALSE_BEYOND:g})",
        f"the bar is twice the ATE of GNC on the clean graph, or {ATE_FLOOR_M:g} m: with the same "
        "edges kept both are the same optimum, to rounding",
    ]
    return outcome


def with_false_loops(
    graph: PoseGraph, optimum: Poses, share: float, rng: np.random.Generator
) -> PoseGraph:
    """A graph with so many false loop closures that they are a share of all."""
    loops = np.flatnonzero(~graph.is_odometry)
    count, made, true = round(share / (1.0 - share) * len(loops)), graph, len(graph.edges)
    while len(made.edges) < true + count:
        missing = true + count - len(made.edges)
        ends = np.sort(rng.integers(0, len(graph.keys), (2 * missing, 2)), axis=1)
        ends = ends[np.diff(ends)[:, 0] > 1][:missing]
        source = rng.choice(loops, len(ends))
        made = made.add_edges(ends, graph.measured.select(source), graph.information[source])
        made = made.keep_edges(
            (np.arange(len(made.edges)) < true) | _contradicted(made, graph, optimum)
        )
    return made


def _contradicted(made: PoseGraph, graph: PoseGraph, optimum: Poses) -> NDArray[np.bool_]:
    """(M,) for each edge whether the clean graph contradicts it.

    That is by its innovation: b whitened residuals, A their Jacobian and Σ the covariance of the
    two poses, χ² = bᵀ (I + A Σ Aᵀ)⁻¹ b.
    """
    values, factors = values_of(optimum), edge_factors(made)
    squared = edge_chi2(factors, values)
    clean = [*factors[: len(graph.edges)], *anchor_factors(graph)]
    marginals = gtsam.Marginals(factor_graph(clean), values)
    for row in np.flatnonzero(squared < SURELY_FALSE).tolist():
        if row < len(graph.edges):
            continue
        A, b = gtsam.JacobianFactor(factors[row].linearize(values)).jacobian()
        i, j = factors[row].keys()
        joint = marginals.jointMarginalCovariance([i, j])
        Σ = np.block([[joint.at(i, i), joint.at(i, j)], [joint.at(j, i), joint.at(j, j)]])
        squared[row] = b @ np.linalg.solve(np.eye(len(b)) + A @ Σ @ A.T, b)
    contradicted: NDArray[np.bool_] = squared > FALSE_BEYOND
    return contradicted


def ate(graph: PoseGraph, truth: Poses, estimate: Poses) -> float:
    """Root mean square of the position errors after alignment in SE(3), in metres."""
    trajectories = graph.trajectory(truth), graph.trajectory(estimate)
    return ape(*trajectories, "trans_part", "se3").statistics.rmse


BENCHMARKS = {
    "posegraphs": Benchmark(
        "Five pose graphs: known optima, certificates", (FOLDER,), optima, quick=True
    ),
    "posegraphs_speed": Benchmark(
        "Four pose graphs: time beside a bare GTSAM script that does the same", (FOLDER,), speed
    ),
    "posegraphs_false_loops": Benchmark(
        "GNC with 10, 30 and 50 % of false loop closures: ATE against the clean optimum",
        (FOLDER,),
        false_loops,
    ),
}
