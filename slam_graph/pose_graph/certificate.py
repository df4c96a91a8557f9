# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Whether an optimum of a pose graph is the global one: a dual certificate, after SE-Sync.

For a stationary point X of F = tr(X M Xᵀ) let Λ be the block-diagonal multipliers of R_iᵀ R_i = I
and S = M - Λ. For all rotations Y, with the translations that fit them best,

    F(Y) = tr(Y S Yᵀ) + tr Λ  ≥  tr Λ + d n λ,        tr Λ = F(X),

where λ is the smallest eigenvalue of S after the translations are eliminated. It is never positive,
as S X = 0. If it is zero, nothing is better than X (Rosen, Carlone, Bandeira and Leonard 2019).

The certificate is one of SE-Sync's objective, not of GTSAM's: both are small at the same places,
but their minima differ by the noise. So the estimate is first led to the minimum of F next to it,
by Newton's method, and what is certified is that minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, coo_matrix, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.chordal import (
    chordal_cost,
    factorized,
    stacked,
    unstacked,
    whitened_rows,
)
from slam_graph.pose_graph.graph import PoseGraph, Poses

RELATIVE_GAP = 1e-6
"""An optimum counts as global if nothing can be better by more than this part of it …"""
GAP_PER_EDGE = 1e-9
"""… and this for each edge, which is what counts if all edges agree exactly."""

ROUNDING = 1e-12
"""Where F promises to fall by no more than this part of it, it is a minimum."""

MAX_NEWTON_STEPS = 50
MAX_DAMPING = 1e6

GENERATORS = {
    2: np.array([[[0.0, -1.0], [1.0, 0.0]]]),
    3: np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    ),
}
"""Derivatives of rotations by their tangents, (p, d, d)."""


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What is known of the global optimum of SE-Sync's objective.

    Attributes:
        certified: whether `poses` are the global optimum, to within the gap.
        objective: F at `poses`.
        bound: no poses have a lower F than this.
        smallest_eigenvalue: λ; zero to within rounding if `poses` are optimal.
        poses: the minimum of F next to the estimate.
        moved_m, moved_deg: root-mean-square way from the estimate to `poses`.
        newton_steps: steps that it took.
    """

    certified: bool
    objective: float
    bound: float
    smallest_eigenvalue: float
    poses: Poses
    moved_m: float
    moved_deg: float
    newton_steps: int

    @property
    def gap(self) -> float:
        """By how much F could be lower, at most."""
        return max(self.objective - self.bound, 0.0)


def certify(graph: PoseGraph, estimate: Poses) -> Certificate:
    """Lead an estimate to the next minimum of SE-Sync's objective, and bound what could be better.

    Raises:
        EstimationError: if the smallest eigenvalue cannot be found.
    """
    B = whitened_rows(graph)
    poses, steps = refine(graph, B, estimate)
    S, trace = dual(B, poses)
    smallest = smallest_eigenvalue(S, graph)
    objective = chordal_cost(graph, poses)
    bound = trace + min(smallest, 0.0) * graph.dimension * len(poses)
    allowed = RELATIVE_GAP * objective + GAP_PER_EDGE * len(graph.edges)
    way = estimate.inverse().compose(poses).in_space()
    return Certificate(
        certified=objective - bound <= allowed,
        objective=objective,
        bound=bound,
        smallest_eigenvalue=smallest,
        poses=poses,
        moved_m=float(np.sqrt(np.mean(np.sum(way.translations**2, axis=1)))),
        moved_deg=float(
            np.degrees(np.sqrt(np.mean(Rotation.from_matrix(way.rotations).magnitude() ** 2)))
        ),
        newton_steps=steps,
    )


def refine(graph: PoseGraph, B: csr_matrix, poses: Poses) -> tuple[Poses, int]:
    """The minimum of SE-Sync's objective next to given poses, and the steps to it.

    Newton's method with the exact Riemannian Hessian, which is S on the tangents; damped where that
    is not positive definite or a step does not lower F.
    """
    free = _free_tangents(graph)
    cost, damping = chordal_cost(graph, poses), 0.0
    for step in range(MAX_NEWTON_STEPS):
        gradient, hessian = _derivatives(B, poses, free)
        scale = hessian.diagonal().mean()
        while True:
            lu = _positive_factors(hessian + damping * scale * identity(len(free), format="csc"))
            if lu is not None:
                way = lu.solve(gradient)
                moved = _retracted(poses, -way, free)
                lower = chordal_cost(graph, moved)
                if lower < cost:
                    break
                if gradient @ way <= ROUNDING * cost:
                    return poses, step
            if damping > MAX_DAMPING:
                return poses, step
            damping = max(10.0 * damping, 1e-6)
        poses, cost, damping = moved, lower, damping / 100.0 if damping > 1e-5 else 0.0
    return poses, MAX_NEWTON_STEPS


def dual(B: csr_matrix, poses: Poses) -> tuple[csc_matrix, float]:
    """S = M - Λ for given poses, and the trace of Λ; M = Bᵀ B."""
    n = len(poses)
    slopes = unstacked(_slope(B, poses)).rotations
    blocks = poses.rotations.transpose(0, 2, 1) @ slopes
    multipliers = 0.5 * (blocks + blocks.transpose(0, 2, 1))
    trace = float(np.trace(multipliers, axis1=1, axis2=2).sum())
    Λ = block_diag([csr_matrix((n, n)), block_diag(list(multipliers), format="csr")], format="csc")
    return (B.T @ B - Λ).tocsc(), trace


def _slope(B: csr_matrix, poses: Poses) -> FloatArray:
    """X M, (d, n + dn), by way of the residuals X Bᵀ, which keeps small ones exact."""
    slope: FloatArray = ((B @ stacked(poses).T).T) @ B
    return slope


def smallest_eigenvalue(S: csc_matrix, graph: PoseGraph) -> float:
    """λ: the smallest eigenvalue of S over rotations, translations being what fits them best.

    S with η on the diagonal of its rotations is factorised; the signs of its pivots tell whether λ
    is above -η (Sylvester's law of inertia). From the first η that is enough, Lanczos' method on
    the inverse finds λ itself.

    Raises:
        EstimationError: if no η is enough.
    """
    n = len(graph.keys)
    kept = np.setdiff1d(np.arange(S.shape[0]), graph.anchors)
    grounded = S[kept][:, kept].tocsc()
    on_rotations = diags((kept >= n).astype(float), format="csc")
    rotations = np.flatnonzero(kept >= n)
    shift = 1e-9 * float(np.abs(S.diagonal()).max())
    for _ in range(20):
        lu = _positive_factors(grounded + shift * on_rotations)
        if lu is not None:
            break
        shift *= 10.0
    else:
        raise EstimationError(f"{graph.name}: the smallest eigenvalue cannot be found")

    def inverse(vector: FloatArray) -> FloatArray:
        full = np.zeros(len(kept))
        full[rotations] = vector.ravel()
        solved: FloatArray = lu.solve(full)[rotations]
        return solved

    operator = LinearOperator((len(rotations),) * 2, matvec=inverse, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(len(rotations))
    largest = eigsh(operator, k=1, which="LA", v0=start, tol=1e-6, return_eigenvectors=False)
    return float(1.0 / largest[0] - shift)


def _positive_factors(matrix: csc_matrix) -> SuperLU | None:
    """The factors of a symmetric matrix, or None if it is not positive definite.

    With pivots on the diagonal their signs are those of the eigenvalues (Sylvester's law of
    inertia).
    """
    try:
        lu = factorized(matrix)
    except RuntimeError:  # singular
        return None
    positive = np.array_equal(lu.perm_r, lu.perm_c) and (lu.U.diagonal() > 0).all()
    return lu if positive else None


def _free_tangents(graph: PoseGraph) -> IntArray:
    """Columns of the tangents that are not held: all but those of the anchors."""
    d, n = graph.dimension, len(graph.keys)
    p = d * (d - 1) // 2
    held = np.concatenate(
        [
            (d * graph.anchors[:, None] + np.arange(d)).ravel(),
            (d * n + p * graph.anchors[:, None] + np.arange(p)).ravel(),
        ]
    )
    return np.setdiff1d(np.arange((d + p) * n), held)


def _derivatives(B: csr_matrix, poses: Poses, free: IntArray) -> tuple[FloatArray, csc_matrix]:
    """Half the gradient and half the Hessian of F by the free tangents."""
    S, _ = dual(B, poses)
    slope = _slope(B, poses)
    gradient, hessian = 0.0, 0.0
    for row, tangents in enumerate(_tangents(poses)):
        chosen = tangents[:, free]
        gradient = gradient + chosen.T @ slope[row]
        hessian = hessian + chosen.T @ S @ chosen
    return gradient, hessian.tocsc()  # type: ignore[return-value, attr-defined]  # sums of sparse


def _tangents(poses: Poses) -> list[csc_matrix]:
    """For each row of X its derivative by (δt, ω), R_i ← R_i exp(ω): d of (n + dn, dn + pn)."""
    n, d = len(poses), poses.dimension
    turned = np.einsum("nij,ajk->nika", poses.rotations, GENERATORS[d])
    p = turned.shape[-1]
    of_t = np.arange(n)
    rows = n + d * of_t[:, None, None] + np.arange(d)[:, None] + np.zeros(p, int)
    columns = d * n + p * of_t[:, None, None] + np.arange(p) + np.zeros((d, 1), int)
    made = []
    for row in range(d):
        values = np.concatenate([np.ones(n), turned[:, row].ravel()])
        at = (
            np.concatenate([of_t, rows.ravel()]),
            np.concatenate([d * of_t + row, columns.ravel()]),
        )
        made.append(coo_matrix((values, at), shape=(n + d * n, (d + p) * n)).tocsc())
    return made


def _retracted(poses: Poses, step: FloatArray, free: IntArray) -> Poses:
    """Poses moved by free tangents."""
    n, d = len(poses), poses.dimension
    p = d * (d - 1) // 2
    full = np.zeros((d + p) * n)
    full[free] = step
    ω = full[d * n :].reshape(n, p)
    if d == 3:
        turns = Rotation.from_rotvec(ω).as_matrix()
    else:
        cos, sin = np.cos(ω[:, 0]), np.sin(ω[:, 0])
        turns = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    return Poses(poses.rotations @ turns, poses.translations + full[: d * n].reshape(n, d))
