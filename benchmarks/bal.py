# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment in BAL's format beside GTSAM: the cost that is reached, and the time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time

import gtsam
import numpy as np

from benchmarks.bal_problems import ring
from benchmarks.metric import Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph.bundle_adjustment.bal_file import read_bal
from slam_graph.bundle_adjustment.bal_problem import BalProblem, usable
from slam_graph.bundle_adjustment.bal_solve import adjust_bundle
from slam_graph.diagnostics import Diagnostics

CAMERAS, POINTS = 100, 20_000
REPETITIONS = 3

LADYBUG = (49, 7776, 4.1)
"""Cameras, points, and views of a point, as the first problem of BAL's Ladybug has them."""

COST_BAR = 1e-4
TIME_BAR = 0.3

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
"""GTSAM's cameras look along their positive z axis, and their y axis points down."""

DEFAULT_TOLERANCE = 1e-5
"""GTSAM's, relative."""
GAUGE_SIGMA = 0.1
"""Of the priors on the first camera and the first point in GTSAM's own example."""

ORDERINGS = ("schur", "COLAMD", "METIS")
"""Points before cameras; and two that GTSAM finds by itself."""

SMALL = "dubrovnik-3-7-pre.txt"
"""A problem of 3 cameras and 7 points that comes with GTSAM; it has more unknowns than pixels."""

SMALL_BAR = 1e-6
"""Cost below which it is solved, px²."""


def beside_gtsam(
    data: Path, cameras: int = CAMERAS, points: int = POINTS, views: float = 6.0
) -> Outcome:
    """A made-up problem, solved by both from the same start; see `ring` for the arguments."""
    problem = usable(ring(cameras, points, views=views).problem, Diagnostics()).problem
    seconds: dict[str, float] = {}
    costs: dict[str, float] = {}
    solvers: dict[str, Callable[[], float]] = {
        "ours": lambda: adjust_bundle(problem).minimum.cost,
        **{
            f"gtsam_{ordering}{'_priors' if priors else ''}": partial(
                by_gtsam, problem, ordering, priors
            )
            for ordering in ORDERINGS
            for priors in (False, True)
        },
    }
    for _ in range(REPETITIONS):
        for name, solve in solvers.items():
            start = process_time()
            costs[name] = solve()
            seconds[name] = min(seconds.get(name, np.inf), process_time() - start)
    others = [name for name in solvers if name != "ours"]
    excess = costs["ours"] / min(costs[name] for name in others) - 1.0
    ratio = seconds["ours"] / min(seconds[name] for name in others)
    return Outcome(
        [
            Metric("excess_cost", excess, "relative", "lower", COST_BAR, None),
            Metric("time", ratio, "× GTSAM", "lower", TIME_BAR, None),
            info("cost", costs["ours"], "px²"),
            *(info(f"seconds.{name}", value, "s CPU") for name, value in seconds.items()),
        ],
        [
            f"{problem.cameras} cameras, {problem.points} points, {len(problem.camera)} "
            f"observations; CPU time, the shortest of {REPETITIONS} turns each, from arrays in "
            "memory to the optimum; GTSAM's is the shortest of three orderings, with and without "
            "priors on the gauge"
        ],
    )


def by_gtsam(problem: BalProblem, ordering: str, priors: bool) -> float:
    """The reprojection cost that GTSAM's Levenberg-Marquardt gets to."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise, first = gtsam.noiseModel.Unit.Create(2), gtsam.symbol("p", 0)
    start = problem.estimates
    for c in range(problem.cameras):
        R, t = UPSIDE_DOWN @ start.rotations[c], UPSIDE_DOWN @ start.translations[c]
        f, k1, k2 = start.intrinsics[c]
        world_T_camera = gtsam.Pose3(gtsam.Rot3(R), t).inverse()
        calibration = gtsam.Cal3Bundler(f, k1, k2, 0.0, 0.0)
        values.insert(c, gtsam.PinholeCameraCal3Bundler(world_T_camera, calibration))
    for j, point in enumerate(start.points):
        values.insert(first + j, point)
    pixels = problem.pixels * UPSIDE_DOWN.diagonal()[:2]
    for c, j, pixel in zip(problem.camera.tolist(), problem.point.tolist(), pixels, strict=True):
        graph.add(gtsam.GeneralSFMFactorCal3Bundler(pixel, noise, c, first + j))
    whole = gtsam.NonlinearFactorGraph(graph)
    if priors:
        camera = values.atPinholeCameraCal3Bundler(0)
        weak = [gtsam.noiseModel.Isotropic.Sigma(dim, GAUGE_SIGMA) for dim in (9, 3)]
        whole.addPriorPinholeCameraCal3Bundler(0, camera, weak[0])
        whole.addPriorPoint3(first, start.points[0], weak[1])
    optimum = gtsam.LevenbergMarquardtOptimizer(
        whole, values, _parameters(problem, ordering)
    ).optimize()
    return float(graph.error(optimum))


def _parameters(problem: BalProblem, ordering: str) -> gtsam.LevenbergMarquardtParams:
    """Defaults, but for the ordering."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(DEFAULT_TOLERANCE)
    if ordering != "schur":
        parameters.setOrderingType(ordering)
        return parameters
    points_first = gtsam.Ordering()
    for j in range(problem.points):
        points_first.push_back(gtsam.symbol("p", 0) + j)
    for c in range(problem.cameras):
        points_first.push_back(c)
    parameters.setOrdering(points_first)
    return parameters


def small(data: Path) -> Outcome:
    """The problem that comes with GTSAM."""
    problem = read_bal(Path(gtsam.__file__).parent / "Data" / SMALL)
    minimum = adjust_bundle(problem).minimum
    return Outcome(
        [
            Metric("cost", minimum.cost, "px²", "lower", SMALL_BAR, None),
            info("gtsam", by_gtsam(problem, "COLAMD", priors=False), "px²"),
        ],
        [f"{SMALL}: {2 * len(problem.camera)} coordinates of pixels, 41 unknowns"],
    )


BENCHMARKS = {
    "bal": Benchmark(
        f"Bundle adjustment, {CAMERAS} cameras and {POINTS} points, beside GTSAM", (), beside_gtsam
    ),
    "bal_49": Benchmark(
        "Bundle adjustment as large as BAL's Ladybug of 49 cameras, made up, beside GTSAM",
        (),
        lambda data: beside_gtsam(data, *LADYBUG),
    ),
    "bal_small": Benchmark(
        "Bundle adjustment of a small problem of GTSAM's", (), small, quick=True
    ),
}
