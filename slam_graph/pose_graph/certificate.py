# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate of global optimality of a pose graph: the dual bound of SE-Sync.

For a stationary point X of F = tr(X M Xᵀ) let Λ be the block-diagonal multipliers of R_iᵀ R_i = I
and S = M - Λ. For all rotations Y, with the translations that fit them best,

    F(Y) = tr(Y S Yᵀ) + tr Λ  ≥  tr Λ + d n λ,        tr Λ = F(X),

where λ is the smallest eigenvalue of S after elimination of the translations. It is never positive,
because S X = 0. If it is zero, X is a global optimum (Rosen, Carlone, Bandeira and Leonard 2019).

The certificate holds for SE-Sync's objective, not for GTSAM's: the two nearly agree, but their
minima differ by the noise. So Newton's method first moves the estimate to the next minimum of F,
and that minimum is certified.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, coo_matrix, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend import Attempt, TenfoldDamping, levenberg_marquardt
from slam_graph.display import Displayed
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_initialization import (
    chordal_cost,
    factorized,
    stacked,
    unstacked,
    whitened_rows,
)

_RELATIVE_GAP = 1e-6
"""An optimum is global if no poses can have an F lower by more than this part of it, plus …"""
_GAP_PER_EDGE = 1e-9
"""… this for each edge, which decides if all edges agree exactly (F = 0)."""

_ROUNDING = 1e-12
"""A step that is predicted to lower F by no more than this part of it has reached the minimum."""

_MAX_ATTEMPTS = 300
_FIRST_DAMPING, _MAX_DAMPING = 1e-12, 1e6
"""Relative to the mean of the diagonal of the Hessian, whose entries differ by many orders of
magnitude: damping that is strong beside the smallest makes the way along a flat valley endless."""

_GENERATORS = {
    2: np.array([[[0.0, -1.0], [1.0, 0.0]]]),
    3: np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    ),
}
"""Generators of SO(d), (p, d, d)."""


@dataclass(frozen=True, slots=True, eq=False)
class Certificate(Displayed):
    """A bound on the global optimum of SE-Sync's objective F.

    Attributes:
        certified: whether `poses` are the global optimum, up to rounding.
        objective: F at `poses`.
        bound: lower bound of F over all poses.
        smallest_eigenvalue: λ; zero up to rounding if `poses` are optimal.
        poses: the local minimum of F that Newton's method reaches from the estimate.
        moved_m, moved_deg: root-mean-square distance of `poses` from the estimate.
        newton_steps: number of Newton steps.
        converged: whether they reached that minimum; if not, `poses` are where they stopped.
    """

    certified: bool
    objective: float
    bound: float
    smallest_eigenvalue: float
    poses: Poses
    moved_m: float
    moved_deg: float
    newton_steps: int
    converged: bool = True

    def __repr__(self) -> str:
        found = "certified" if self.certified else "not certified"
        return f"Certificate({found}: objective {self.objective:.6g}, gap {self.gap:.2g})"

    def _facts(self) -> dict[str, object]:
        return {
            "certified": "yes, this is the global optimum" if self.certified else "no",
            "objective": f"{self.objective:.8g}",
            "lower bound": f"{self.bound:.8g}",
            "smallest eigenvalue": f"{self.smallest_eigenvalue:.3g}",
            "poses": len(self.poses),
            "moved": f"{self.moved_m:.3g} m, {self.moved_deg:.3g}° RMS",
            "Newton steps": f"{self.newton_steps}{'' if self.converged else ', not converged'}",
        }

    @property
    def gap(self) -> float:
        """The most by which F could be lower than at `poses`."""
        return max(self.objective - self.bound, 0.0)


def certify(graph: PoseGraph, estimate: Poses) -> Certificate:
    """Move an estimate to the next minimum of SE-Sync's objective, and bound F from below.

    Args:
        graph: the edges.
        estimate: world_T_body of all poses, from which the minimum is searched.

    Raises:
        EstimationError: if the smallest eigenvalue cannot be found.
    """
    B = whitened_rows(graph)
    poses, steps, converged = _refine(graph, B, estimate)
    S, trace = _dual(B, poses)
    smallest = _smallest_eigenvalue(S, graph)
    objective = chordal_cost(graph, poses)
    bound = trace + min(smallest, 0.0) * graph.dimension * len(poses)
    allowed = _RELATIVE_GAP * objective + _GAP_PER_EDGE * len(graph.edges)
    moved = estimate.inverse().compose(poses).in_space()
    return Certificate(
        certified=objective - bound <= allowed,
        objective=objective,
        bound=bound,
        smallest_eigenvalue=smallest,
        poses=poses,
        moved_m=float(np.sqrt(np.mean(np.sum(moved.translations**2, axis=1)))),
        moved_deg=float(
            np.degrees(np.sqrt(np.mean(Rotation.from_matrix(moved.rotations).magnitude() ** 2)))
        ),
        newton_steps=steps,
        converged=converged,
    )


def _refine(graph: PoseGraph, B: csr_matrix, poses: Poses) -> tuple[Poses, int, bool]:
    """The local minimum of SE-Sync's objective next to given poses.

    Returns:
        The poses, the number of steps, and whether they converged.

    Newton's method with the exact Riemannian Hessian, which is S in the tangents; damped where it
    is not positive definite or a step does not lower F.
    """
    problem = _Chordal(graph, B, poses)

    def converged(attempt: Attempt) -> bool:
        return not attempt.accepted and attempt.predicted <= _ROUNDING * attempt.before

    damping = TenfoldDamping(
        _FIRST_DAMPING, _MAX_DAMPING, relief=0.01, negligible=10.0 * _FIRST_DAMPING
    )
    steps = levenberg_marquardt(problem, _MAX_ATTEMPTS, converged, damping)
    return problem.poses, steps.accepted, steps.converged


class _Chordal:
    """SE-Sync's objective as `levenberg_marquardt` takes it (see `DampedProblem`).

    Attributes:
        poses: the current estimates.
    """

    def __init__(self, graph: PoseGraph, B: csr_matrix, poses: Poses) -> None:
        self.poses = self._before = poses
        self._graph, self._B, self._free = graph, B, _free_tangents(graph)

    def value(self) -> float:
        return chordal_cost(self._graph, self.poses)

    def linearize(self) -> None:
        self._gradient, self._hessian = _derivatives(self._B, self.poses, self._free)

    def solve(self, damping: float) -> float:
        scale = self._hessian.diagonal().mean()
        lu = _positive_factors(
            self._hessian + damping * scale * identity(len(self._free), format="csc")
        )
        if lu is None:
            return np.inf
        self._step = -lu.solve(self._gradient)
        return float(-self._gradient @ self._step)

    def apply(self) -> None:
        self._before = self.poses
        self.poses = _retracted(self.poses, self._step, self._free)

    def undo(self) -> None:
        self.poses = self._before


def _dual(B: csr_matrix, poses: Poses) -> tuple[csc_matrix, float]:
    """S = M - Λ for given poses, and the trace of Λ; M = Bᵀ B."""
    n = len(poses)
    slopes = unstacked(_slope(B, poses)).rotations
    blocks = poses.rotations.transpose(0, 2, 1) @ slopes
    multipliers = 0.5 * (blocks + blocks.transpose(0, 2, 1))
    trace = float(np.trace(multipliers, axis1=1, axis2=2).sum())
    Λ = block_diag([csr_matrix((n, n)), block_diag(list(multipliers), format="csr")], format="csc")
    return (B.T @ B - Λ).tocsc(), trace


def _slope(B: csr_matrix, poses: Poses) -> FloatArray:
    """X M, (d, n + dn), computed from the residuals X Bᵀ, so that small ones stay exact."""
    slope: FloatArray = ((B @ stacked(poses).T).T) @ B
    return slope


def _smallest_eigenvalue(S: csc_matrix, graph: PoseGraph) -> float:
    """λ: the smallest eigenvalue of S over the rotations, with the translations eliminated.

    S with η added to the diagonal of its rotations is factorised; the signs of its pivots tell
    whether λ > -η (Sylvester's law of inertia). With the first η for which this holds, Lanczos'
    method on the inverse finds λ itself.

    Raises:
        EstimationError: if it holds for no η.
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
    """The LU factors of a symmetric matrix, or None if it is not positive definite.

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
    """Columns of the tangents that are not fixed: all but those of the anchors."""
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
    """Half the gradient and half the Hessian of F in the free tangents."""
    S, _ = _dual(B, poses)
    slope = _slope(B, poses)
    gradient, hessian = 0.0, 0.0
    for row, tangents in enumerate(_tangents(poses)):
        chosen = tangents[:, free]
        gradient = gradient + chosen.T @ slope[row]
        hessian = hessian + chosen.T @ S @ chosen
    return gradient, hessian.tocsc()  # type: ignore[return-value, attr-defined]  # sums of sparse


def _tangents(poses: Poses) -> list[csc_matrix]:
    """Derivatives of the d rows of X by (δt, ω), with R_i ← R_i exp(ω): each (n + dn, dn + pn)."""
    n, d = len(poses), poses.dimension
    turned = np.einsum("nij,ajk->nika", poses.rotations, _GENERATORS[d])
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
    """Poses moved by an increment of the free tangents."""
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
