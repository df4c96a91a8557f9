# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Initial estimates of the poses of a graph: odometry, spanning tree, or chordal relaxation.

The pose graph as a quadratic form in rotation matrices: the objective of SE-Sync.

    F(t, R) = Σ κ ‖R_j - R_i R_ij‖² + τ ‖t_j - t_i - R_i t_ij‖²  =  tr(X M Xᵀ),   X = [t | R]

with X of shape d × (n + dn): the n translations, then the n rotations side by side. κ and τ are
the isotropic precisions that fit an information matrix best, as SE-Sync reads g2o files (Rosen,
Carlone, Bandeira and Leonard 2019). With isotropic information F approximates χ² in 3D; in 2D its
rotations count twice.
"""

from __future__ import annotations

from typing import Literal, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, vstack
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import SuperLU, splu

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.pose_graph.graph import PoseGraph, Poses

_Number = TypeVar("_Number", np.float64, np.complex128)


def translation_rows(graph: PoseGraph, τ: FloatArray) -> csr_matrix:
    """(M, n + dn) whitened rows b with X bᵀ = √τ (t_j - t_i - R_i t_ij)."""
    d, n, m = graph.dimension, len(graph.keys), len(graph.edges)
    i, j = graph.edges.T
    columns = np.hstack([i[:, None], j[:, None], _rotation_columns(i, n, d)])
    root = np.sqrt(τ)[:, None]
    values = np.hstack([-root, root, -root * graph.measured.translations])
    rows = np.repeat(np.arange(m), 2 + d)
    return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(m, n + d * n))


def rotation_rows(graph: PoseGraph, κ: FloatArray) -> csr_matrix:
    """(dM, n + dn) whitened rows b with X bᵀ = √κ (R_j - R_i R_ij), one for each column."""
    d, n, m = graph.dimension, len(graph.keys), len(graph.edges)
    i, j = graph.edges.T
    root = np.sqrt(κ)[:, None, None]
    of_i = np.repeat(_rotation_columns(i, n, d)[:, None, :], d, axis=1)
    of_j = _rotation_columns(j, n, d)[:, :, None]
    values = np.concatenate(
        [
            -root * graph.measured.rotations.transpose(0, 2, 1),
            np.broadcast_to(root, (m, d, 1)),
        ],
        axis=2,
    )
    columns = np.concatenate([of_i, of_j], axis=2)
    rows = np.repeat(np.arange(d * m), d + 1)
    return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(d * m, n + d * n))


def _rotation_columns(index: IntArray, n: int, d: int) -> IntArray:
    """(M, d) columns of X that hold the rotations of some poses."""
    columns: IntArray = n + d * index[:, None] + np.arange(d)
    return columns


def whitened_rows(graph: PoseGraph) -> csr_matrix:
    """All rows B, (M + dM, n + dn): F = ‖X Bᵀ‖², so that M = Bᵀ B."""
    κ, τ = graph.precisions
    return vstack([translation_rows(graph, τ), rotation_rows(graph, κ)], format="csr")


def stacked(poses: Poses) -> FloatArray:
    """The matrix X of poses, (d, n + dn)."""
    d = poses.dimension
    side_by_side = poses.rotations.transpose(1, 0, 2).reshape(d, -1)
    return np.hstack([poses.translations.T, side_by_side])


def unstacked(X: FloatArray) -> Poses:
    """The poses of a matrix X."""
    d = len(X)
    n = X.shape[1] // (d + 1)
    return Poses(X[:, n:].reshape(d, n, d).transpose(1, 0, 2), X[:, :n].T)


def chordal_cost(graph: PoseGraph, poses: Poses) -> float:
    """The value F of SE-Sync's objective."""
    κ, τ = graph.precisions
    i, j = graph.edges.T
    first, second = poses.select(i), poses.select(j)
    there = first.compose(graph.measured)
    of_R = np.sum((second.rotations - there.rotations) ** 2, axis=(1, 2))
    of_t = np.sum((second.translations - there.translations) ** 2, axis=1)
    return float(κ @ of_R + τ @ of_t)


def nearest_rotations(matrices: FloatArray) -> FloatArray:
    """(N, d, d) rotations nearest to given matrices in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrices)
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    rotations: FloatArray = U @ Vt
    return rotations


def factorized(matrix: csc_matrix) -> SuperLU:
    """LU factors of a symmetric sparse matrix, with pivots on the diagonal."""
    return splu(
        csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


Initialization = Literal["chordal", "lago", "odometry", "file"]

_LOOP_CLOSURE_LENGTH, _GAP_LENGTH = 1e6, 1e3
"""Length of a loop closure in the spanning tree, where an edge of odometry has 1; and of one that
joins consecutive poses, across a gap between their ids: it is seldom false."""


def initialize(graph: PoseGraph, how: Initialization, diagnostics: Diagnostics) -> Poses:
    """Initial estimates of all poses.

    Args:
        graph: the pose graph.
        how: chordal: relaxed rotations, projected on SO(d), then translations (Carlone, Tron,
            Daniilidis and Dellaert 2015). lago: angles first, in 2D (Carlone, Aragues, Castellanos
            and Bona 2014). odometry: composed along a spanning tree that prefers odometry.
            file: those of the file.
        diagnostics: counts if the method fails and odometry is used instead.

    Raises:
        DataError: if the file has no estimates, or `lago` is asked for in 3D.
    """
    if how == "file":
        if graph.estimates is None:
            raise DataError(f"{graph.name}: the file has no estimates; use another initialization")
        return graph.estimates
    if how == "odometry":
        return along_tree(graph)
    if how == "lago" and graph.dimension == 3:
        raise DataError(f"{graph.name}: lago is for 2D; use the chordal initialization")
    try:
        rotations = _chordal_rotations(graph) if how == "chordal" else _lago_rotations(graph)
        return Poses(rotations, _translations_given(graph, rotations))
    except (RuntimeError, np.linalg.LinAlgError) as error:
        diagnostics.warn(
            "pose_graph_not_initialized", f"{how}: {str(error).strip()}; odometry is used"
        )
        return along_tree(graph)


def _chordal_rotations(graph: PoseGraph) -> FloatArray:
    """(N, d, d) minimum of Σ κ ‖R_j - R_i R_ij‖² over all matrices, projected on SO(d)."""
    if graph.dimension == 2:
        return _chordal_rotations_2d(graph)
    d, n = graph.dimension, len(graph.keys)
    rows = rotation_rows(graph, graph.precisions[0])[:, n:]
    held = (d * graph.anchors[:, None] + np.arange(d)).ravel()
    first = graph.anchor_poses().rotations.transpose(0, 2, 1).reshape(-1, d)
    transposed = _solved(rows, held, first).reshape(n, d, d)
    return nearest_rotations(transposed.transpose(0, 2, 1))


def _chordal_rotations_2d(graph: PoseGraph) -> FloatArray:
    """(N, 2, 2) the same in 2D, with a complex number for each rotation.

    The minimum over all matrices is found among multiples of rotations, because the measurements
    and the anchors are rotations. So half the unknowns do.
    """
    n, m, root = len(graph.keys), len(graph.edges), np.sqrt(graph.precisions[0])
    turns, first = (
        R[:, 0, 0] + 1j * R[:, 1, 0]
        for R in (graph.measured.rotations, graph.anchor_poses().rotations)
    )
    values = np.stack([-root * turns, root.astype(complex)], axis=1)
    rows = np.repeat(np.arange(m), 2)
    matrix = csr_matrix((values.ravel(), (rows, graph.edges.ravel())), shape=(m, n))
    z = _solved(matrix, graph.anchors, first[:, None])[:, 0]
    z = z / np.abs(z)
    if not np.isfinite(z).all():
        raise np.linalg.LinAlgError("a relaxed rotation is zero")
    return np.stack([z.real, -z.imag, z.imag, z.real], axis=1).reshape(-1, 2, 2)


def _lago_rotations(graph: PoseGraph) -> FloatArray:
    """(N, 2, 2) rotations by LAGO: a linear problem in the angles, unwrapped along a tree."""
    problem, first = gtsam.NonlinearFactorGraph(), graph.anchor_poses().rotations
    angles = np.arctan2(graph.measured.rotations[:, 1, 0], graph.measured.rotations[:, 0, 0])
    sigmas = 1.0 / np.sqrt(graph.information[:, 2, 2])
    for (i, j), angle, sigma in zip(
        graph.edges.tolist(), angles.tolist(), sigmas.tolist(), strict=True
    ):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, sigma]))
        problem.push_back(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(0.0, 0.0, angle), noise))
    _lago_applies(graph)
    unit = gtsam.noiseModel.Unit.Create(3)
    problem.addPriorPose2(
        0, gtsam.Pose2(0.0, 0.0, np.arctan2(first[0, 1, 0], first[0, 0, 0])), unit
    )
    found = gtsam.lago.initializeOrientations(problem)
    theta = np.array([found.at(k)[0] for k in range(len(graph.keys))])
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)


def _lago_applies(graph: PoseGraph) -> None:
    """GTSAM's LAGO does not return if an edge between consecutive poses is missing.

    Raises:
        RuntimeError: if one is missing.
    """
    to_next = np.abs(np.diff(graph.edges, axis=1))[:, 0] == 1
    steps = np.unique(graph.edges[to_next].min(axis=1))
    if len(steps) != len(graph.keys) - 1:
        raise RuntimeError("not every pose has an edge to the next one")


def _translations_given(graph: PoseGraph, rotations: FloatArray) -> FloatArray:
    """(N, d) translations that fit given rotations best: a linear problem."""
    n, d = len(graph.keys), graph.dimension
    rows = translation_rows(graph, graph.precisions[1])
    side_by_side = rotations.transpose(1, 0, 2).reshape(d, -1)
    offsets = rows[:, n:] @ side_by_side.T
    return _solved(rows[:, :n], graph.anchors, graph.anchor_poses().translations, -offsets)


def _solved(
    rows: csr_matrix,
    held: IntArray,
    values: NDArray[_Number],
    right: NDArray[_Number] | None = None,
) -> NDArray[_Number]:
    """Least-squares solution x (n, c) of rows · x = right with some entries of x fixed."""
    count = rows.shape[1]
    free = np.setdiff1d(np.arange(count), held)
    x = np.zeros((count, values.shape[1]), values.dtype)
    x[held] = values
    if len(free) == 0:
        return x
    residual = (0.0 if right is None else right) - rows @ x
    columns = rows.tocsc()[:, free]
    adjoint = columns.conj().T
    x[free] = factorized(adjoint @ columns).solve(adjoint @ residual)
    if not np.isfinite(x).all():
        raise np.linalg.LinAlgError("the linear problem has no unique solution")
    return x


def along_tree(graph: PoseGraph) -> Poses:
    """Poses composed along a spanning tree that prefers odometry."""
    poses = Poses.identity(len(graph.keys), graph.dimension)
    at_anchors = graph.anchor_poses()
    poses.rotations[graph.anchors] = at_anchors.rotations
    poses.translations[graph.anchors] = at_anchors.translations
    forth, back, ends = graph.measured, graph.measured.inverse(), graph.edges
    for child, parent, row in _tree(graph):
        step = back if ends[row, 0] == child else forth
        R = poses.rotations[parent]
        poses.rotations[child] = R @ step.rotations[row]
        poses.translations[child] = poses.translations[parent] + R @ step.translations[row]
    return Poses(nearest_rotations(poses.rotations), poses.translations)


def tree_edges(graph: PoseGraph) -> IntArray:
    """Rows of the edges of that spanning tree."""
    return np.array([row for _, _, row in _tree(graph)], dtype=np.int64)


def _tree(graph: PoseGraph) -> list[tuple[int, int, int]]:
    """Triples (pose, parent in the tree, edge), parents first."""
    n = len(graph.keys)
    follows = np.abs(np.diff(graph.edges, axis=1))[:, 0] == 1
    lengths = np.where(follows, _GAP_LENGTH, _LOOP_CLOSURE_LENGTH)
    lengths[graph.is_odometry] = 1.0
    ends, first = np.unique(np.sort(graph.edges, axis=1), axis=0, return_index=True)
    links = coo_matrix((lengths[first], tuple(ends.T)), shape=(n, n))
    tree = minimum_spanning_tree(links.tocsr())
    edge_of = dict(zip(map(tuple, ends.tolist()), first.tolist(), strict=True))
    found = []
    for anchor in graph.anchors.tolist():
        nodes, before = breadth_first_order(tree, anchor, directed=False)
        pairs = [(node, int(before[node])) for node in nodes[1:].tolist()]
        found += [(node, last, edge_of[min(node, last), max(node, last)]) for node, last in pairs]
    return found
