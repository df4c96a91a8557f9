# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The certificate: it knows the global optima, and refuses minima that are only local."""

from pathlib import Path

import numpy as np
import pytest
from groups import slow_but
from pose_graphs import laps, turns
from scipy.optimize import approx_fprime

from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.pose_graph import certificate
from slam_graph.pose_graph.certificate import certify
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_files import read_pose_graph
from slam_graph.pose_graph.graph_initialization import chordal_cost, stacked, whitened_rows
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy, PoseGraphPolicy

SESYNC_OPTIMA = {
    "parking-garage": 1.2625244,
    "M3500": 193.86226,
    "intel": 52.348227,
    "MIT": 61.154116,
    "sphere2500": 1687.0058,
}


@pytest.mark.data
@pytest.mark.parametrize("name", slow_but({"parking-garage", "intel", "MIT"}, SESYNC_OPTIMA))
def test_the_optima_of_sesync_are_found_and_certified(data_dir: Path, name: str) -> None:
    graph = read_pose_graph(data_dir / "posegraphs" / f"{name}.g2o")
    found = certify(graph, optimize_pose_graph(graph).poses)
    assert found.certified
    assert found.objective == pytest.approx(SESYNC_OPTIMA[name], rel=1e-6)
    assert found.bound <= found.objective * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.data
def test_a_flat_valley_is_followed_to_its_end(data_dir: Path) -> None:
    """The Hessian of ais2klinik has entries that differ by many orders of magnitude."""
    graph = read_pose_graph(data_dir / "posegraphs" / "ais2klinik.g2o")
    found = certify(graph, optimize_pose_graph(graph).poses)
    assert found.converged
    assert found.certified
    assert found.objective == pytest.approx(188.5018, abs=1e-3)


@pytest.mark.slow
@pytest.mark.data
def test_the_optimum_of_a_repaired_graph_is_that_of_sesync(data_dir: Path) -> None:
    path, diagnostics = data_dir / "posegraphs" / "cubicle.g2o", Diagnostics()
    with pytest.raises(DataError, match="nor are those of 5020 other edges"):
        read_pose_graph(path)
    graph = read_pose_graph(path, diagnostics, repair="isotropic")
    assert diagnostics.counts["pose_graph_information_repaired"] == 5021
    found = certify(graph, optimize_pose_graph(graph).poses)
    assert found.certified
    assert found.objective == pytest.approx(717.126, abs=1e-3)


def test_steps_that_do_not_converge_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, truth = laps(2, 0.1)
    assert certify(graph, truth).converged
    monkeypatch.setattr(certificate, "_MAX_ATTEMPTS", 1)
    found = certify(graph, truth)
    assert not found.converged
    assert found.newton_steps == 1


@pytest.mark.data
def test_a_local_minimum_of_mit_is_refused(data_dir: Path) -> None:
    graph = read_pose_graph(data_dir / "posegraphs" / "MIT.g2o")
    policy = PoseGraphPolicy(cost=PoseGraphCostPolicy(initialization="odometry"))
    found = certify(graph, optimize_pose_graph(graph, policy).poses)
    assert not found.certified
    assert found.objective > 2 * SESYNC_OPTIMA["MIT"]
    assert found.bound < SESYNC_OPTIMA["MIT"]


def ring(poses: int, windings: int) -> tuple[PoseGraph, Poses]:
    """A ring whose edges say that nothing turns, and poses that turn full circles around it."""
    index = np.arange(poses)
    edges = np.column_stack([index, (index + 1) % poses])
    measured = Poses.identity(poses, 2)
    graph = PoseGraph(index, None, edges, measured, np.tile(np.eye(3), (poses, 1, 1)))
    angles = 2 * np.pi * windings * index / poses
    return graph, Poses(turns(angles[:, None]), np.zeros((poses, 2)))


def test_a_twisted_ring_is_refused_and_a_straight_one_is_not() -> None:
    graph, straight = ring(20, 0)
    assert certify(graph, straight).certified
    _, twisted = ring(20, 1)
    found = certify(graph, twisted)
    assert found.moved_deg < 1e-6, "it is a minimum"
    assert found.objective == pytest.approx(20 * 2 * 2 * (1 - np.cos(2 * np.pi / 20)), rel=1e-9)
    assert not found.certified
    assert found.bound == pytest.approx(0.0, abs=1e-9), "nothing is better than no turn at all"


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_bound_holds_for_all_poses(dimension: int) -> None:
    graph, truth = laps(dimension, 0.1)
    found = certify(graph, truth)
    assert found.certified
    assert found.objective <= chordal_cost(graph, truth)
    assert found.objective <= chordal_cost(graph, optimize_pose_graph(graph).poses)


@pytest.mark.parametrize("dimension", [2, 3])
def test_derivatives_are_those_of_the_objective(dimension: int) -> None:
    graph, truth = laps(dimension, 0.1, poses=6, lap=3)
    free, rows = certificate._free_tangents(graph), whitened_rows(graph)

    def cost(step: np.ndarray) -> float:
        return 0.5 * chordal_cost(graph, certificate._retracted(truth, step, free))

    def slope(step: np.ndarray) -> np.ndarray:
        return certificate._derivatives(rows, certificate._retracted(truth, step, free), free)[0]

    gradient, hessian = certificate._derivatives(rows, truth, free)
    zero = np.zeros(len(free))
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient, approx_fprime(zero, cost, 1e-7), atol=1e-4 * scale)
    # Slopes at moved poses are by other tangents, whose difference is antisymmetric to first order.
    numeric = approx_fprime(zero, slope, 1e-6)
    numeric = 0.5 * (numeric + numeric.T)
    np.testing.assert_allclose(hessian.toarray(), numeric, atol=1e-4 * np.abs(numeric).max())


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_smallest_eigenvalue_is_that_of_the_dense_matrix(dimension: int) -> None:
    graph, truth = laps(dimension, 0.3, poses=12, lap=4)
    S, trace = certificate._dual(whitened_rows(graph), truth)
    n, dense = len(truth), S.toarray()
    reduced = dense[n:, n:] - dense[n:, :n] @ np.linalg.pinv(dense[:n, :n]) @ dense[:n, n:]
    expected = np.linalg.eigvalsh(reduced)[0]
    assert certificate._smallest_eigenvalue(S, graph) == pytest.approx(expected, rel=1e-6)
    best = certify(graph, truth).objective
    assert trace + expected * dimension * n <= best


def test_the_quadratic_form_is_the_objective() -> None:
    graph, truth = laps(3, 0.2)
    residuals = stacked(truth) @ whitened_rows(graph).T
    assert np.sum(residuals**2) == pytest.approx(chordal_cost(graph, truth), rel=1e-10)
