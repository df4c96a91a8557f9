# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of K keyframe states: their factor, solutions and covariances.

Features connect the poses of keyframes, nearly all with all others where places are seen again. So
the information of the poses is a dense matrix. IMU factors connect a state with the next one only.
Velocities and biases are eliminated first, in blocks of consecutive keyframes: each block leaves
its poses, and velocity and bias of the two states at its ends, which are joints with the blocks
beside it. What is left is dense and is factorised by LAPACK, as UᵀU.

A state has 15 components: pose (rotation, translation), velocity, bias (accelerometer, gyroscope).

With the factor C of what is eliminated in a block, and Y = C⁻¹ M its rows of what is kept,

    x_inner = C⁻ᵀ η - C⁻ᵀ Y x_kept,   η ~ N(0, 1),

so that a root of the joint covariance of a block follows from U⁻¹. Differences of neighbouring
states may be known far better than the states themselves, and would be lost in the rounding of
covariances; roots keep them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from scipy.linalg import lapack, solve_triangular

from slam_graph.arrays import FloatArray, IntArray

STATE = 15
"""Components of a state."""
_POSE, _MOTION = 6, 9
"""Components of a pose; of velocity and bias."""
_BLOCK = 20
"""Intervals between keyframes in a block: the dense system has 9 / 20 columns more per keyframe."""
_PARTS = {"x": np.arange(6), "v": np.arange(6, 9), "b": np.arange(9, 15)}
"""Components of each kind of variable in a state."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainEquations:
    """Normal equations of factors that each depend on one keyframe state or on two neighbours.

    Attributes:
        information: (K-1, 30, 30) on the states k and k + 1.
        gradient: (K, 15) right-hand side.
    """

    information: FloatArray
    gradient: FloatArray

    @classmethod
    def of(cls, linear: gtsam.GaussianFactorGraph, keyframes: int) -> ChainEquations:
        """Those of a linear graph over X(k), V(k) and B(k) of the keyframes 0 to K-1."""
        information = np.zeros((keyframes - 1, 2 * STATE, 2 * STATE))
        gradient = np.zeros((keyframes, STATE))
        alike: dict[tuple[int, ...], list[tuple[int, FloatArray]]] = {}
        for factor in map(linear.at, range(linear.size())):
            keys = factor.keys()
            first = min(*map(gtsam.symbolIndex, keys), keyframes - 2)
            same = alike.setdefault(tuple(key - first for key in keys), [])
            same.append((first, factor.augmentedInformation()))
        for relative, same in alike.items():  # one by one they would take twice as long
            columns = _columns(relative)
            states, augmented = np.array([k for k, _ in same]), np.array([M for _, M in same])
            place = states[:, None, None], columns[:, None], columns
            if len(np.unique(states)) == len(states):  # as IMU factors are
                information[place] += augmented[:, :-1, :-1]
            else:
                np.add.at(information, place, augmented[:, :-1, :-1])
            rows = STATE * states[:, None] + columns
            np.add.at(gradient.reshape(-1), rows, augmented[:, :-1, -1])
        return cls(information, gradient)


@lru_cache
def _columns(keys: tuple[int, ...]) -> IntArray:
    """Columns (n,) of variables of two neighbouring states, whose keys count from the first one."""
    return np.concatenate(
        [STATE * gtsam.symbolIndex(k) + _PARTS[chr(gtsam.symbolChr(k))] for k in keys]
    )


@dataclass(frozen=True, slots=True, eq=False)
class StateColumns:
    """Columns of what is kept of K keyframe states: all poses, then velocity and bias at joints.

    Attributes:
        keyframes: their number.
        joints: (G + 1,) numbers of the keyframes at the ends of the G blocks.
    """

    keyframes: int
    joints: IntArray

    @classmethod
    def of(cls, keyframes: int) -> StateColumns:
        """For a number of keyframes."""
        return cls(keyframes, np.append(np.arange(0, keyframes - 1, _BLOCK), keyframes - 1))

    @property
    def size(self) -> int:
        """Number of columns."""
        return _POSE * self.keyframes + _MOTION * len(self.joints)

    def kept(self, block: int) -> IntArray:
        """Columns of what a block keeps: its poses, its first and its last joint."""
        first, last = self.joints[block : block + 2]
        ends = _POSE * self.keyframes + _MOTION * block
        return np.append(np.arange(_POSE * first, _POSE * last + _POSE), ends + np.arange(18))

    def local(self, block: int) -> tuple[IntArray, IntArray]:
        """Components of the states of a block that it keeps, as `kept`, and the inner ones."""
        first, last = self.joints[block : block + 2]
        parts = np.arange(STATE * (last - first + 1)).reshape(-1, STATE)
        poses, motions = parts[:, :_POSE], parts[:, _POSE:]
        kept = np.concatenate([poses.ravel(), motions[0], motions[-1]])
        return kept, motions[1:-1].ravel()


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """What was eliminated in a block: C (i, i) lower triangular, and Y (i, k)."""

    C: FloatArray
    Y: FloatArray


class EliminatedStates:
    """The factor of the normal equations of K states.

    Args:
        poses: (n, n) lower triangle of the information of poses, with room for `StateColumns`
            behind them, zero so far. It is overwritten, as it is large.
        chain: the other factors.
        damping: is added to the diagonal.

    Raises:
        LinAlgError: if the equations are not positive definite.
    """

    def __init__(self, poses: FloatArray, chain: ChainEquations, damping: float = 0.0) -> None:
        self._columns = columns = StateColumns.of(len(chain.gradient))
        self._blocks = []
        S = poses
        S.flat[:: len(S) + 1] += damping
        for block in range(len(columns.joints) - 1):
            M = _joined(chain.information[columns.joints[block] : columns.joints[block + 1]])
            kept, inner = columns.local(block)
            inside = M[np.ix_(inner, inner)] + damping * np.eye(len(inner))
            C = np.asarray(np.linalg.cholesky(inside), np.float64)
            Y = solve_triangular(C, M[np.ix_(inner, kept)], lower=True, check_finite=False)
            own = columns.kept(block)
            S[np.ix_(own, own)] += M[np.ix_(kept, kept)] - Y.T @ Y
            self._blocks.append(_Block(C, Y))
        self._U, info = lapack.dpotrf(S.T, lower=0, clean=1, overwrite_a=1)
        if info != 0:
            raise np.linalg.LinAlgError("the cost does not determine all of its variables")

    def times_covariance(self, right: FloatArray) -> FloatArray:
        """The product (K, 15, m) of the covariance of all states with a matrix (K, 15, m)."""
        columns, width = self._columns, right.shape[2]
        reduced = np.zeros((columns.size, width))
        poses = _POSE * columns.keyframes
        reduced[:poses] = right[:, :_POSE].reshape(poses, width)
        reduced[poses:] = right[columns.joints, _POSE:].reshape(-1, width)
        inside: list[FloatArray] = []
        for number, block in enumerate(self._blocks):
            first, last = columns.joints[number : number + 2]
            own = right[first + 1 : last, _POSE:].reshape(-1, width)
            inside.append(solve_triangular(block.C, own, lower=True, check_finite=False))
            reduced[columns.kept(number)] -= block.Y.T @ inside[-1]
        half = solve_triangular(self._U, reduced, trans="T", check_finite=False)
        x = solve_triangular(self._U, half, check_finite=False)
        found = np.empty(right.shape)
        found[:, :_POSE] = x[:poses].reshape(-1, _POSE, width)
        found[columns.joints, _POSE:] = x[poses:].reshape(-1, _MOTION, width)
        for number, (block, own) in enumerate(zip(self._blocks, inside, strict=True)):
            first, last = columns.joints[number : number + 2]
            own = own - block.Y @ x[columns.kept(number)]
            own = solve_triangular(block.C, own, trans="T", lower=True, check_finite=False)
            found[first + 1 : last, _POSE:] = own.reshape(-1, _MOTION, width)
        return found

    def pair_covariances(self) -> FloatArray:
        """Joint covariances (K-1, 30, 30) of neighbouring states."""
        columns = self._columns
        inverse, _ = lapack.dtrtri(self._U)
        pairs = np.empty((columns.keyframes - 1, 2 * STATE, 2 * STATE))
        for number, block in enumerate(self._blocks):
            kept, inner = columns.local(number)
            own = columns.kept(number)
            root = _root(inverse[own, own[0] :])
            backward = solve_triangular(
                block.C, np.eye(len(inner)), trans="T", lower=True, check_finite=False
            )
            width = root.shape[1]
            rows = np.zeros((len(kept) + len(inner), width + len(inner)))
            rows[kept, :width] = root
            rows[inner, :width] = -backward @ (block.Y @ root)
            rows[inner, width:] = backward
            first, last = columns.joints[number : number + 2]
            for k in range(last - first):
                pair = rows[STATE * k : STATE * (k + 2)]
                pairs[first + k] = pair @ pair.T
        return pairs


def _joined(information: FloatArray) -> FloatArray:
    """The information on the states of a block, of that (I, 30, 30) of its intervals."""
    M = np.zeros((STATE * (len(information) + 1),) * 2)
    for k, pair in enumerate(information):
        M[STATE * k : STATE * (k + 2), STATE * k : STATE * (k + 2)] += pair
    return M


def _root(rows: FloatArray) -> FloatArray:
    """A root (r, min(r, n)) of the covariance that `rows` (r, n) are a root of."""
    return np.asarray(np.linalg.qr(rows.T, mode="r")).T
