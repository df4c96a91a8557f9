# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph as a quadratic form in rotation matrices: the objective of SE-Sync.

    F(t, R) = Σ κ ‖R_j - R_i R_ij‖² + τ ‖t_j - t_i - R_i t_ij‖²  =  tr(X M Xᵀ),   X = [t | R]

with X of shape d × (n + dn): the n translations, then the n rotations side by side. κ and τ are
the isotropic precisions that fit an information matrix best, as SE-Sync reads g2o files (Rosen,
Carlone, Bandeira and Leonard 2019). With isotropic information F approximates χ² in 3D; in 2D its
rotations count twice.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, vstack
from scipy.sparse.linalg import SuperLU, splu

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.pose_graph.graph import PoseGraph, Poses


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
