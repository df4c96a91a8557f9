# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's three smoothers behind one interface: two with a fixed lag, and iSAM2 without.

They eliminate by Cholesky, or by QR if the policy says so. Orderings are COLAMD's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.policies import SmootherPolicy
from slam_graph.backend.solve.state import dim

Stamps = Mapping[Any, float]
"""Time of each key, in seconds."""


class NativeSolver(Protocol):
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
            RuntimeError: if the problem cannot be solved; the solver is of no use then.
        """
        ...

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """Estimates of those of some variables that are still there."""
        ...

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """All factors that it holds, those of variables that left included."""
        ...

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """Estimates and stamps of all variables."""
        ...

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint marginal covariance of some variables, in the order given."""
        ...


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
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
    """Joint marginal covariance from a graph: what is asked for is eliminated last, in the root."""
    linear = graph.linearize(at)
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, list(keys))
    root = linear.eliminateMultifrontal(order).roots()[0].conditional()
    size = sum(dim(key) for key in keys)
    ends = np.cumsum([dim(key) for key in root.keys()])  # noqa: SIM118
    columns = dict(zip(root.keys(), ends, strict=True))
    order_in_root = np.concatenate([np.arange(columns[k] - dim(k), columns[k]) for k in keys])
    order_in_root -= int(ends[-1]) - size
    inverse = np.linalg.inv(root.R()[-size:, -size:])
    covariance: FloatArray = (inverse @ inverse.T)[np.ix_(order_in_root, order_in_root)]
    return covariance


def _isam2_params(policy: SmootherPolicy) -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(policy.relinearize_threshold)
    params.relinearizeSkip = policy.relinearize_skip
    params.setFactorization(policy.factorization.upper())
    params.findUnusedFactorSlots = True
    return params


class FixedLagIsam2:
    """`IncrementalFixedLagSmoother`: iSAM2, out of which old variables are marginalised."""

    def __init__(self, policy: SmootherPolicy) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(policy.lag_s, _isam2_params(policy))
        self._estimate = gtsam.Values()

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """See `NativeSolver`."""
        self._smoother.update(graph_of(factors), values, stamps_s)
        self._estimate = self._smoother.calculateEstimate()

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """See `NativeSolver`."""
        return self._estimate

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See `NativeSolver`."""
        return gtsam.NonlinearFactorGraph(self._smoother.getFactors())

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """See `NativeSolver`."""
        return self._estimate, dict(self._smoother.timestamps())

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `NativeSolver`."""
        return _covariance_of_graph(self._smoother.getFactors(), self._estimate, keys)


class FixedLagBatch:
    """`BatchFixedLagSmoother`: Levenberg-Marquardt over the whole lag at every update."""

    def __init__(self, policy: SmootherPolicy) -> None:
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(policy.max_iterations)
        params.setLinearSolverType(f"MULTIFRONTAL_{policy.factorization.upper()}")
        self._smoother = gtsam.BatchFixedLagSmoother(policy.lag_s, params)
        self._estimate = gtsam.Values()

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """See `NativeSolver`."""
        self._smoother.update(graph_of(factors), values, stamps_s)
        self._estimate = self._smoother.calculateEstimate()

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """See `NativeSolver`."""
        return self._estimate

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See `NativeSolver`."""
        return gtsam.NonlinearFactorGraph(self._smoother.getFactors())

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """See `NativeSolver`."""
        return self._estimate, dict(self._smoother.timestamps())

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `NativeSolver`."""
        return _covariance_of_graph(self._smoother.getFactors(), self._estimate, keys)


class FullIsam2:
    """`ISAM2`: nothing ever leaves."""

    def __init__(self, policy: SmootherPolicy) -> None:
        self._isam2 = gtsam.ISAM2(_isam2_params(policy))

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        stamps_s: Stamps,
    ) -> None:
        """See `NativeSolver`."""
        self._isam2.update(graph_of(factors), values)

    def estimate(self, keys: Iterable[int]) -> gtsam.Values:
        """See `NativeSolver`."""
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
        """See `NativeSolver`."""
        return gtsam.NonlinearFactorGraph(self._isam2.getFactorsUnsafe())

    def everything(self) -> tuple[gtsam.Values, dict[int, float]]:
        """See `NativeSolver`."""
        return self._isam2.calculateEstimate(), {}

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `NativeSolver`."""
        return _stacked(self._isam2.jointMarginalCovariance(list(keys)), keys)


SOLVERS: dict[str, type[FixedLagIsam2] | type[FixedLagBatch] | type[FullIsam2]] = {
    "fixed_lag_isam2": FixedLagIsam2,
    "fixed_lag_batch": FixedLagBatch,
    "isam2": FullIsam2,
}
