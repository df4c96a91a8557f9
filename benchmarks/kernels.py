# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features reduced to what they say of the poses: own forms, compiled kernels, and GTSAM.

The same made-up problem is given to all: J features seen from F poses by two cameras, and a prior
on each pose. Asked for is the information of the poses, as the triangle of a square root (the
features' positions being eliminated). Each way begins with its linearisation:

- `rows`: null-space rows of each feature by Householder's reflections, then QR of all rows;
- `sum`: the sum of the Schur complements, then Cholesky; both in NumPy and compiled;
- `gtsam_cholesky` and `gtsam_qr`: `linearize` with factors that exist, then elimination of the
  features (`eliminatePartialSequential`) and of the poses.

Times are CPU times, the least of a few rounds in which all ways take turns, over GTSAM's with
Cholesky. All ways must agree to 1e-9 of the largest information. `elimination` looks at windows of
real runs instead, with their priors, IMU factors and features of the state.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from scipy.linalg import cholesky
from threadpoolctl import threadpool_limits

from benchmarks.metric import TIMING_TOLERANCE, Metric, info
from benchmarks.suite import Benchmark, Outcome
from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_factors import WhitenedObservations, whiten
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.gtsam_smoothers.smoother_features import ProjectionFactors, pixel_noise
from slam_graph.backend.solve.state import POSE_DIM
from slam_graph.kernels.feature_sums import sum_of_features, sum_of_features_numpy
from slam_graph.kernels.null_space import triangularize_features, triangularize_features_numpy
from slam_graph.sensors.rig import Rig
from slam_graph.simulation.simulation_config import SimulationConfig
from slam_graph.simulation.simulator import simulate

SIZES = {
    "msckf": (12, 11),
    "swf": (20, 15),
    "okvis": (150, 8),
    "large": (60, 15),
}
"""Features and poses: tracks that end in a frame, features of keyframes, and a large window."""

SIGMA_PX = 1.0
PRIOR_SIGMA = 0.1
"""Of each pose, rad and m: without it the whole could move."""
AGREEMENT_BAR = 1e-9
OWN_BAR = 1 / 1.2
"""The own kernel is kept as long as GTSAM takes 1.2 times as long or more."""
ROUNDS = 30

Way = Callable[[], Any]
Sum = Callable[..., None]
Triangularize = Callable[[FloatArray, FloatArray], None]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Features seen from poses.

    Attributes:
        rig: two cameras.
        obs: observations of every feature by both cameras at every pose.
        at: where they are linearised.
        graph: the same as factors of GTSAM, with the priors.
        values: `at` as GTSAM's.
    """

    rig: Rig
    obs: Observations
    at: Geometry
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values

    @property
    def size(self) -> int:
        """Number of columns of the poses."""
        return POSE_DIM * len(self.obs.frames)


def measure(data: Path, rounds: int = ROUNDS) -> Outcome:
    """Times of all ways on problems of some sizes.

    Args:
        data: folder of recordings; not needed.
        rounds: each way is timed so often.
    """
    outcome, rng = Outcome(), np.random.default_rng(0)
    with threadpool_limits(limits=1, user_api="blas"):
        for name, (features, poses) in SIZES.items():
            problem = made_up(features, poses, rng)
            outcome.add(name, [info("observations", len(problem.obs), ""), *timed(problem, rounds)])
    outcome.notes.append(
        "times over `gtsam_cholesky`, which is GTSAM's linearisation with factors that exist and "
        "elimination by Cholesky; `error`: largest difference of an information from that of "
        "GTSAM's QR, over the largest"
    )
    return outcome


def made_up(features: int, poses: int, rng: np.random.Generator) -> Problem:
    """A problem: the cameras look along the z axis of the world at features 3 m to 8 m away."""
    rig = simulate(SimulationConfig(cameras=2, duration_s=1.0)).rig
    projection = RigProjection(rig)
    ahead = rig.cameras[0].body_T_camera.rotation().inverse()
    turns = rng.normal(0.0, 0.02, (poses, 3))
    rotations = np.array([(gtsam.Rot3.Expmap(turn) * ahead).matrix() for turn in turns])
    positions = np.linspace([-0.3, 0.0, 0.0], [0.3, 0.1, 0.2], poses)
    positions += rng.normal(0.0, 0.01, (poses, 3))
    depths = rng.uniform(3.0, 8.0, features)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (features, 2)) * depths[:, None], depths])
    feature, frame, camera = (
        part.ravel()
        for part in np.meshgrid(np.arange(features), np.arange(poses), [0, 1], indexing="ij")
    )
    blank = np.zeros((len(feature), 2))
    ids = np.arange(features)
    at = Geometry(rotations, positions, points)
    without = Observations(ids, tuple(range(poses)), feature, frame, camera, blank, blank)
    seen = projection.views(without, at).pixels + rng.normal(0.0, SIGMA_PX, blank.shape)
    obs = Observations(ids, without.frames, feature, frame, camera, seen, blank)
    return Problem(rig, obs, at, *as_graph(rig, obs, at))


def as_graph(
    rig: Rig, obs: Observations, at: Geometry
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A problem as GTSAM takes it."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(POSE_DIM, PRIOR_SIGMA)
    for i, (R, p) in enumerate(zip(at.rotations, at.positions, strict=True)):
        pose = gtsam.Pose3(gtsam.Rot3(R), p)
        values.insert(X(i), pose)
        graph.add(gtsam.PriorFactorPose3(X(i), pose, noise))
    for j, point in enumerate(at.points):
        values.insert(L(j), point)
    for factor in ProjectionFactors(rig, pixel_noise(SIGMA_PX, RobustLoss())).of(obs):
        graph.add(factor)
    return graph, values


def timed(problem: Problem, rounds: int) -> list[Metric]:
    """The figures of one problem."""
    ways: dict[str, Way] = {
        "rows_numpy": lambda: root_of_rows(problem, triangularize_features_numpy),
        "rows_compiled": lambda: root_of_rows(problem, triangularize_features),
        "sum_numpy": lambda: root_of_sum(problem, sum_of_features_numpy),
        "sum_compiled": lambda: root_of_sum(problem, sum_of_features),
        "gtsam_cholesky": lambda: root_by_gtsam(problem),
        "gtsam_qr": lambda: root_by_gtsam(problem, gtsam.EliminateQR),
    }
    parts: dict[str, Way] = {
        "linearize": lambda: linear_of(problem),
        "gtsam_linearize": lambda: problem.graph.linearize(problem.values),
        "gtsam_build": lambda: as_graph(problem.rig, problem.obs, problem.at),
    }
    informations = {name: information_of(way()) for name, way in ways.items()}
    truth = informations["gtsam_qr"]
    error = max(float(np.abs(found - truth).max()) for found in informations.values())
    times = least_cpu_s({**ways, **parts}, rounds)
    unit_s = times.pop("gtsam_cholesky")
    return [
        Metric("error", error / np.abs(truth).max(), "", "lower", AGREEMENT_BAR, None),
        info("gtsam_cholesky", 1e3 * unit_s, "ms CPU"),
        Metric(
            "sum_compiled",
            times.pop("sum_compiled") / unit_s,
            "× GTSAM",
            "lower",
            OWN_BAR,
            TIMING_TOLERANCE,
        ),
        *(info(name, value_s / unit_s, "× GTSAM") for name, value_s in times.items()),
    ]


def least_cpu_s(ways: dict[str, Way], rounds: int) -> dict[str, float]:
    """The least CPU time of each way over some rounds in which they take turns."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            began_s = time.thread_time()
            way()
            times[name].append(time.thread_time() - began_s)
    return {name: min(values) for name, values in times.items()}


def linear_of(problem: Problem) -> WhitenedObservations:
    """The linearised observations, by this package."""
    projection = RigProjection(problem.rig)
    return whiten(problem.obs, projection, problem.at, problem.at, SIGMA_PX, RobustLoss())


def root_of_rows(problem: Problem, triangularize: Triangularize) -> FloatArray:
    """The triangle by null-space rows and QR."""
    obs, linear, size = problem.obs, linear_of(problem), problem.size
    J, M = len(obs.ids), int(obs.counts.max())
    A = linear.by_point.reshape(J, 2 * M, 3).copy()
    B = np.zeros((J, M, 2, len(obs.frames), POSE_DIM))
    B[obs.feature, obs.slots, :, obs.frame] = linear.by_pose
    rows = B.reshape(J, 2 * M, size)
    triangularize(A, rows)
    prior = np.eye(size) / PRIOR_SIGMA
    stacked = np.concatenate([prior, rows[:, 3:].reshape(-1, size)])
    return np.asarray(np.linalg.qr(stacked, mode="r"))


def root_of_sum(problem: Problem, add_up: Sum) -> FloatArray:
    """The triangle by the sum of Schur complements and Cholesky."""
    obs, linear, size = problem.obs, linear_of(problem), problem.size
    J = len(obs.ids)
    R_f, T = np.empty((J, 3, 3)), np.empty((J, 3, size + 1))
    information = np.empty((size + 1, size + 1))
    parts = linear.r, linear.by_pose, linear.by_point, linear.by_calibration
    add_up(*parts, obs.frame, obs.starts, R_f, T, information)
    stacked = T.reshape(-1, size + 1)
    information -= stacked.T @ stacked
    whole = information[:size, :size] + np.eye(size) / PRIOR_SIGMA**2
    return np.asarray(cholesky(whole, check_finite=False))


def root_by_gtsam(problem: Problem, *eliminate: Any) -> Any:
    """The triangle by GTSAM, as the conditionals of the poses; by Cholesky if not said."""
    linear = problem.graph.linearize(problem.values)
    features = [L(j) for j in problem.obs.ids.tolist()]
    rest = linear.eliminatePartialSequential(features, *eliminate)[1]
    return rest.eliminateSequential(pose_order(problem), *eliminate)


def pose_order(problem: Problem) -> gtsam.Ordering:
    """The poses in the order of time."""
    order = gtsam.Ordering()
    for i in problem.obs.frames:
        order.push_back(X(i))
    return order


def information_of(root: Any) -> FloatArray:
    """(size, size) of a square root in either form."""
    conditionals = isinstance(root, gtsam.GaussianBayesNet)
    triangle = root.matrix()[0] if conditionals else root
    return np.asarray(triangle.T @ triangle)


BENCHMARKS = {
    "kernels": Benchmark(
        "features reduced to the poses: own forms in NumPy, compiled, and GTSAM, same result",
        (),
        measure,
    )
}
