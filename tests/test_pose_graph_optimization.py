# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pose-graph optimisation: known optima, laws of the cost and the gauge, awkward graphs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pose_graphs import distance, laps, turns, with_false_loops

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import chi2_of_edges, chi2_table
from slam_graph.pose_graph.graph_files import read_pose_graph
from slam_graph.pose_graph.graph_initialization import along_tree, chordal_cost, initialize
from slam_graph.pose_graph.gtsam_graph import edge_chi2, edge_factors, values_of
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.pose_graph.pose_graph_policy import (
    PoseGraphCostPolicy,
    PoseGraphPolicy,
    PoseGraphStepsPolicy,
)

METHODS = ("gauss_newton", "levenberg_marquardt", "dogleg", "isam2")

GTSAM_OPTIMA = {
    "sphere2500": 675.70096,
    "parking-garage": 0.6341924,
    "M3500": 68.957439,
    "intel": 22.502117,
    "MIT": 20.603474,
}


def by(method: str = "gauss_newton", **cost: object) -> PoseGraphPolicy:
    return PoseGraphPolicy(
        cost=PoseGraphCostPolicy(**cost), gauss_newton=PoseGraphStepsPolicy(method=method)
    )


@pytest.mark.data
@pytest.mark.parametrize("name", GTSAM_OPTIMA)
def test_known_optima_are_reached_from_own_estimates(data_dir: Path, name: str) -> None:
    graph = read_pose_graph(data_dir / "posegraphs" / f"{name}.g2o")
    solution = optimize_pose_graph(replace(graph, estimates=None))
    table = chi2_table(graph, solution.poses)
    assert table["gtsam_error"] == pytest.approx(GTSAM_OPTIMA[name], rel=1e-6)
    assert solution.minimum.converged


@pytest.mark.parametrize("dimension", [2, 3])
def test_chi2_of_edges_is_that_of_the_factors(dimension: int) -> None:
    """For angles from zero to nearly half a turn."""
    rng, count = np.random.default_rng(0), 300
    angles = np.concatenate(
        [np.zeros(1), np.geomspace(1e-6, 1.0, 149), np.linspace(1.0, 3.14, 150)]
    )
    axes = rng.standard_normal((count, 3 if dimension == 3 else 1))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    measured = Poses(turns(axes * angles[:, None]), rng.standard_normal((count, dimension)))
    root = rng.standard_normal((count, 3 * dimension - 3, 3 * dimension - 3))
    ends = np.tile([0, 1], (count, 1))
    information = root @ root.transpose(0, 2, 1)
    graph = PoseGraph(np.arange(2), None, ends, measured, information)
    poses = Poses(np.tile(np.eye(dimension), (2, 1, 1)), rng.standard_normal((2, dimension)))
    expected = edge_chi2(edge_factors(graph), values_of(poses))
    np.testing.assert_allclose(chi2_of_edges(graph, poses), expected, rtol=1e-9)


@pytest.mark.data
def test_chi2_in_the_convention_of_g2o(data_dir: Path) -> None:
    path = data_dir / "posegraphs" / "sphere2500.g2o"
    angle = optimize_pose_graph(read_pose_graph(path))
    assert chi2_table(angle.graph, angle.poses)["gtsam_chi2"] == pytest.approx(1351.40, abs=0.01)
    quaternion = optimize_pose_graph(read_pose_graph(path, rotation_information="quaternion"))
    table = chi2_table(quaternion.graph, quaternion.poses)
    assert table["g2o_chi2"] == pytest.approx(727.15, abs=0.01)
    # Near the optimum half the angle is the vector part of the quaternion, to third order.
    assert table["gtsam_chi2"] == pytest.approx(table["g2o_chi2"], rel=1e-3)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("how", ["chordal", "odometry", "lago"])
def test_without_noise_every_initialization_is_the_truth(dimension: int, how: str) -> None:
    graph, truth = laps(dimension)
    if how == "lago" and dimension == 3:
        with pytest.raises(DataError, match="2D"):
            initialize(graph, how, Diagnostics())
        return
    assert distance(initialize(graph, how, Diagnostics()), truth) < 1e-7


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_all_methods_find_the_same_minimum(dimension: int, method: str) -> None:
    graph, _ = laps(dimension, 0.05)
    best = chi2_table(graph, optimize_pose_graph(graph).poses)["gtsam_error"]
    solution = optimize_pose_graph(graph, by(method, initialization="odometry"))
    assert chi2_table(graph, solution.poses)["gtsam_error"] == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_cost_does_not_see_where_the_world_is(dimension: int) -> None:
    graph, truth = laps(dimension, 0.1)
    rng = np.random.default_rng(1)
    p = graph.tangent_size - dimension
    world = Poses(turns(rng.uniform(-2, 2, (1, p))), rng.uniform(-9, 9, (1, dimension)))
    index = np.zeros(len(truth), int)
    moved = world.select(index).compose(truth)
    here, there = chi2_table(graph, truth), chi2_table(graph, moved)
    assert here == pytest.approx(there, rel=1e-9)
    first = optimize_pose_graph(graph).poses
    second = optimize_pose_graph(replace(graph, estimates=moved)).poses
    assert distance(world.select(index).compose(first), second) < 1e-4


def test_a_noiseless_graph_costs_nothing_and_converges() -> None:
    graph, truth = laps(3)
    diagnostics = Diagnostics()
    solution = optimize_pose_graph(graph, by(initialization="odometry"), diagnostics)
    assert distance(solution.poses, truth) < 1e-7
    assert chordal_cost(graph, solution.poses) < 1e-9
    assert solution.minimum.converged
    assert not diagnostics.counts


@pytest.mark.parametrize("method", METHODS)
def test_parts_and_lonely_poses_are_held_where_they_are(method: str) -> None:
    graph, truth = laps(2, 0.02)
    apart = np.r_[np.arange(30), np.arange(200, 230), 999]
    inside = (graph.edges < 30).all(axis=1) | (graph.edges >= 30).all(axis=1)
    lonely = Poses(
        np.concatenate([truth.rotations, np.eye(2)[None]]),
        np.concatenate([truth.translations, [[7.0, 7.0]]]),
    )
    cut = replace(graph, keys=apart, estimates=lonely).keep_edges(inside)
    assert len(cut.anchors) == 3
    solution = optimize_pose_graph(cut, by(method))
    np.testing.assert_allclose(solution.poses.translations[60], [7.0, 7.0], atol=1e-12)
    assert distance(solution.poses, lonely) < 1.0
    covariances = solution.covariances()
    assert np.abs(covariances[[0, 30, 60]]).max() == 0.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_covariance_of_odometry_is_that_of_its_edge(dimension: int) -> None:
    graph, _ = laps(dimension, 0.05, poses=3, lap=3)
    solution = optimize_pose_graph(graph)
    covariances = solution.covariances()
    np.testing.assert_allclose(covariances[1], np.linalg.inv(graph.information[0]), atol=1e-9)
    assert np.linalg.eigvalsh(covariances[2] - covariances[1]).min() > -1e-6


def test_an_estimate_that_the_file_lacks_is_an_error() -> None:
    graph, _ = laps(2)
    with pytest.raises(DataError, match="no estimates"):
        optimize_pose_graph(replace(graph, estimates=None), by(initialization="file"))


def test_lago_gives_way_where_a_link_is_missing() -> None:
    graph, _ = laps(2, 0.02)
    diagnostics = Diagnostics()
    broken = graph.keep_edges(np.arange(len(graph.edges)) != 10)
    poses = initialize(broken, "lago", diagnostics)
    assert dict(diagnostics.counts) == {"pose_graph_not_initialized": 1}
    assert distance(poses, along_tree(broken)) == 0.0


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_gnc_rejects_exactly_the_false_loops(dimension: int, share: float) -> None:
    graph, _ = laps(dimension, 0.02, poses=200)
    clean = optimize_pose_graph(graph, by(robust="gnc"))
    loops = np.count_nonzero(~graph.is_odometry)
    false = with_false_loops(graph, round(share / (1 - share) * loops))
    diagnostics = Diagnostics()
    solution = optimize_pose_graph(false, by(robust="gnc"), diagnostics)
    expected = np.arange(len(false.edges)) < len(graph.edges)
    # A true edge may be beyond its 99 % quantile; one in a hundred is.
    assert not solution.weights[~expected].any()
    assert np.mean(solution.weights[expected] == 1.0) > 0.98
    assert np.array_equal(solution.weights[expected], clean.weights)
    assert distance(solution.poses, clean.poses) < 1e-4
    assert diagnostics.counts["pose_graph_edge_rejected"] == np.sum(solution.weights < 0.5)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman_mcclure", "dcs", "truncated"])
def test_a_robust_loss_holds_false_loops_back(loss: str) -> None:
    graph, _ = laps(2, 0.02)
    clean = optimize_pose_graph(graph).poses
    false = with_false_loops(graph, 3)
    plain = optimize_pose_graph(false).poses
    solution = optimize_pose_graph(false, by(robust=loss))
    assert distance(solution.poses, clean) < 0.3 * distance(plain, clean)
    assert solution.weights[-3:].max() < 0.5 < np.median(solution.weights[:-3])


def test_gnc_keeps_a_graph_without_loops_as_it_is() -> None:
    graph, _ = laps(3, 0.02)
    odometry = graph.keep_edges(graph.is_odometry)
    solution = optimize_pose_graph(odometry, by(robust="gnc"))
    assert distance(solution.poses, along_tree(odometry)) < 1e-6
    assert solution.weights.all()


def test_gnc_keeps_suspected_odometry_connected() -> None:
    graph, _ = laps(2, 0.02)
    shifted = graph.measured.translations.copy()
    shifted[10] += 5.0
    broken = replace(graph, measured=Poses(graph.measured.rotations, shifted))
    clean = optimize_pose_graph(graph).poses
    solution = optimize_pose_graph(broken, by(robust="gnc", trust_odometry=False))
    assert solution.weights[10] < 0.5
    assert distance(solution.poses, clean) < 0.1


@pytest.mark.parametrize("ids", [1, 100])
def test_an_edge_between_two_sessions_is_no_odometry(ids: int) -> None:
    """Their ids are apart, whether they count poses or are times."""
    graph, _ = laps(2, 0.02)
    keys = ids * np.arange(60)
    keys[30:] += 20 * ids
    shifted = graph.measured.translations.copy()
    shifted[29] += 5.0
    sessions = replace(graph, keys=keys, measured=Poses(graph.measured.rotations, shifted))
    assert np.flatnonzero(graph.is_odometry).tolist() == list(range(59))
    assert np.flatnonzero(~sessions.is_odometry[:59]).tolist() == [29]
    solution = optimize_pose_graph(sessions, by(robust="gnc"))
    assert solution.weights[29] < 0.5
    assert distance(solution.poses, optimize_pose_graph(graph).poses) < 0.1


@pytest.mark.parametrize("unit", [7, 100_000_000])
def test_odometry_is_the_same_whatever_ids_count(unit: int) -> None:
    """Poses that are missing are no gap, ten usual steps are the most; one rule for all units."""
    graph, _ = laps(2)
    steps = np.ones(59, np.int64)
    steps[[5, 17, 40, 50]] = 2, 10, 11, 1000
    keys = np.concatenate([[0], np.cumsum(steps)])
    counted = replace(graph, keys=keys).is_odometry
    assert np.flatnonzero(~counted[:59]).tolist() == [40, 50]
    assert not counted[59:].any()
    assert np.array_equal(replace(graph, keys=unit * keys - 3).is_odometry, counted)


def test_the_only_edge_between_two_sessions_is_trusted() -> None:
    """Until another one joins them, too."""
    graph, _ = laps(2, 0.02)
    keys = np.arange(60)
    keys[30:] += 500
    crosses = (graph.edges < 30).any(axis=1) & (graph.edges >= 30).any(axis=1)
    crosses[29] = False
    sessions = replace(graph, keys=keys).keep_edges(~crosses)
    assert np.flatnonzero(sessions.is_odometry).tolist() == list(range(59))
    joined = replace(graph, keys=keys).keep_edges(~crosses | (graph.edges == [10, 30]).all(axis=1))
    assert len(joined.edges) == len(sessions.edges) + 1
    assert np.flatnonzero(~joined.is_odometry[:59]).tolist() == [29]
    twice = np.concatenate([np.arange(len(sessions.edges)), [29]])
    assert not sessions.keep_edges(twice).is_odometry[[29, -1]].any(), "two may contradict"


@pytest.mark.parametrize("robust", ["gnc", "dcs"])
@pytest.mark.parametrize("count", [1, 2])
def test_single_false_loops_do_not_outdo_the_edge_between_two_sessions(
    robust: str, count: int
) -> None:
    """Nothing confirms any of them; the edge between consecutive poses is the likeliest."""
    graph, _ = laps(2, 0.02)
    crosses = (graph.edges < 30).any(axis=1) & (graph.edges >= 30).any(axis=1)
    crosses[29] = False
    keys = np.arange(60)
    keys[30:] += 500
    sessions = replace(graph, keys=keys).keep_edges(~crosses)
    ends, far = np.array([[5, 52], [21, 40]])[:count], np.array([[30.0, 5.0], [-8.0, 25.0]])[:count]
    false = Poses(np.tile(np.eye(2), (count, 1, 1)), far)
    measured, weights = sessions.measured.concatenated(false), sessions.information
    wrong = replace(
        sessions,
        edges=np.concatenate([sessions.edges, ends]),
        measured=measured,
        information=np.concatenate([weights, weights[:count]]),
    )
    assert not wrong.is_odometry[29]
    policy = PoseGraphPolicy.model_validate({"cost": {"robust": robust}})
    found = optimize_pose_graph(wrong, policy).weights
    assert found[29] > 0.5
    assert (found[len(sessions.edges) :] < 0.5).all()


@pytest.mark.parametrize("seed", range(20))
def test_an_edge_across_a_gap_is_odometry_if_it_alone_joins_two_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, edges = int(rng.integers(4, 15)), rng.integers(0, 15, (int(rng.integers(3, 22)), 2))
    edges = edges[(edges < count).all(axis=1) & (edges[:, 0] != edges[:, 1])]
    keys = np.arange(count)
    keys[count // 2 :] += 10 * count
    measured = Poses.identity(len(edges), 2)
    information = np.tile(np.eye(3), (len(edges), 1, 1))
    graph = PoseGraph(keys, None, edges, measured, information)
    for row, ends in enumerate(np.sort(edges, axis=1).tolist()):
        without = graph.keep_edges(np.arange(len(edges)) != row)
        alone = len(without.anchors) > len(graph.anchors)
        across = ends == [count // 2 - 1, count // 2]
        assert graph.is_odometry[row] == (ends[1] - ends[0] == 1 and (alone or not across))


def test_consecutive_poses_need_not_have_consecutive_ids() -> None:
    """They may be times, of which a few are missing."""
    graph, _ = laps(2, 0.02)
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.integers(40_000_000, 100_000_000, 60))
    assert replace(graph, keys=times).is_odometry.sum() == 59
    diagnostics = Diagnostics()
    poses = initialize(replace(graph, keys=times), "lago", diagnostics)
    assert not diagnostics.counts
    assert distance(poses, initialize(graph, "lago", diagnostics)) == 0.0
