# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's three smoothers behind one interface: two with a fixed lag, and iSAM2 without.

`IncrementalFixedLagSmoother` is iSAM2 with a lag, `BatchFixedLagSmoother` solves the whole lag by
Levenberg-Marquardt at every update. They eliminate by Cholesky, or by QR if the policy says so, in
COLAMD's order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.policies import SmootherPolicy
from slam_graph.backend.solve.state import dim

Stamps = Mapping[Any, float]
"""Time of each key, in seconds."""


class SmootherSolver(Protocol):
    """A smoother of GTSAM."""

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """Add factors and variables and solve.

        Args:
            factors: new ones.
            values: first estimates of the new variables.
            stamps_s: when each new or newly observed variable was seen.

        Raises:
            RuntimeError: if the problem cannot be solved; the solver cannot be used any more.
        """
        ...

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """Estimates of at least those of some variables that were not marginalised."""
        ...

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """All factors, with those that marginalised variables have left behind."""
        ...

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """Estimates and stamps of all variables."""
        ...

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint marginal covariance of some variables, in the order given."""
        ...


def _graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """A graph of some factors."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def _stacked(joint: gtsam.JointMarginal, keys: Sequence[int]) -> FloatArray:
    """The joint covariance with its blocks in the order of `keys`, exactly symmetric."""
    full = np.block([[joint.at(i, j).reshape(dim(i), dim(j)) for j in keys] for i in keys])
    return np.asarray(0.5 * (full + full.T), dtype=np.float64)


def _covariance_of_graph(
    graph: gtsam.NonlinearFactorGraph, at: gtsam.Values, keys: Sequence[int]
) -> FloatArray:
    """Joint marginal covariance of some variables, which are eliminated last and so in the root."""
    linear = graph.linearize(at)
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, list(keys))
    try:
        root = linear.eliminateMultifrontal(order).roots()[0].conditional()
    except RuntimeError:  # it refuses some graphs that are determined
        return _covariance_of_dense(linear, order, keys)
    size = sum(dim(key) for key in keys)
    inverse = np.asarray(np.linalg.inv(root.R()[-size:, -size:]), dtype=np.float64)
    return _in_order(inverse, list(root.keys()), keys)


def _in_order(root: FloatArray, ordered: Sequence[int], keys: Sequence[int]) -> FloatArray:
    """The covariance (n, n) of variables from the inverse (n, n) of their block of R.

    Args:
        root: that inverse; the block is the last of R.
        ordered: all variables of R, in its order.
        keys: the last of them, in the order that is asked for.
    """
    ends = dict(zip(ordered, np.cumsum([dim(key) for key in ordered]).tolist(), strict=True))
    begin = max(ends.values()) - len(root)
    places = np.concatenate([np.arange(ends[k] - dim(k), ends[k]) for k in keys]) - begin
    return np.asarray((root @ root.T)[np.ix_(places, places)], dtype=np.float64)


def _covariance_of_dense(
    linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering, keys: Sequence[int]
) -> FloatArray:
    """The same by a dense Cholesky decomposition of variables that are scaled alike.

    Args:
        linear: the graph.
        order: of its variables; those that are asked for come last, in any order.
        keys: these.

    Raises:
        numpy.linalg.LinAlgError: if the graph is indeterminate indeed.
    """
    H, size = linear.hessian(order)[0], sum(dim(key) for key in keys)
    scale = 1.0 / np.sqrt(np.diag(H))
    R = np.linalg.cholesky(scale[:, None] * H * scale).T
    root = scale[-size:, None] * np.linalg.inv(R[-size:, -size:])
    return _in_order(root, [order.at(k) for k in range(order.size())], keys)


class _FixedLag:
    """A smoother of GTSAM out of which variables are marginalised that are older than the lag."""

    def __init__(
        self, smoother: gtsam.IncrementalFixedLagSmoother | gtsam.BatchFixedLagSmoother
    ) -> None:
        self._smoother = smoother
        self._estimate = gtsam.Values()

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """See `SmootherSolver`."""
        self._smoother.update(_graph_of(factors), values, stamps_s)
        self._estimate = self._smoother.calculateEstimate()

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """All variables, whatever the keys: see `SmootherSolver`."""
        return self._estimate

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See `SmootherSolver`."""
        return gtsam.NonlinearFactorGraph(self._smoother.getFactors())

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """See `SmootherSolver`."""
        return self._estimate, dict(self._smoother.timestamps())

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `SmootherSolver`."""
        return _covariance_of_graph(self._smoother.getFactors(), self._estimate, keys)


class _FullIsam2:
    """`ISAM2`: nothing is ever marginalised."""

    def __init__(self, isam2: gtsam.ISAM2) -> None:
        self._isam2 = isam2

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """See `SmootherSolver`."""
        self._isam2.update(_graph_of(factors), values)

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """See `SmootherSolver`."""
        values = gtsam.Values()
        for key in keys:
            kind = chr(gtsam.Symbol(key).chr())
            if not self._isam2.valueExists(key):
                continue
            if kind == "x":
                values.insert(key, self._isam2.calculateEstimatePose3(key))
            elif kind == "b":
                values.insert(key, self._isam2.calculateEstimateConstantBias(key))
            elif kind == "l":
                values.insert(key, self._isam2.calculateEstimatePoint3(key))
            else:
                values.insert(key, self._isam2.calculateEstimateVector(key))
        return values

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See `SmootherSolver`."""
        return gtsam.NonlinearFactorGraph(self._isam2.getFactorsUnsafe())

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """See `SmootherSolver`; there are no stamps."""
        return self._isam2.calculateEstimate(), {}

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `SmootherSolver`."""
        return _stacked(self._isam2.jointMarginalCovariance(list(keys)), keys)


def _isam2_params(policy: SmootherPolicy) -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(policy.relinearize_threshold)
    params.relinearizeSkip = policy.relinearize_skip
    params.setFactorization(policy.factorization.upper())
    params.findUnusedFactorSlots = True
    return params


def _isam2(policy: SmootherPolicy) -> SmootherSolver:
    return _FullIsam2(gtsam.ISAM2(_isam2_params(policy)))


def _fixed_lag_isam2(policy: SmootherPolicy) -> SmootherSolver:
    return _FixedLag(gtsam.IncrementalFixedLagSmoother(policy.lag_s, _isam2_params(policy)))


def _fixed_lag_batch(policy: SmootherPolicy) -> SmootherSolver:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(policy.max_iterations)
    params.setLinearSolverType(f"MULTIFRONTAL_{policy.factorization.upper()}")
    return _FixedLag(gtsam.BatchFixedLagSmoother(policy.lag_s, params))


SOLVERS: dict[str, Callable[[SmootherPolicy], SmootherSolver]] = {
    "fixed_lag_isam2": _fixed_lag_isam2,
    "fixed_lag_batch": _fixed_lag_batch,
    "isam2": _isam2,
}
"""Makes the smoother that `algorithm.engine` names."""
