# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of a least-squares solution whose residuals are alike within blocks of time."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray


def jackknife_covariance(
    information: FloatArray, scores: FloatArray, prior: FloatArray
) -> FloatArray:
    """Covariance (n, n) of the solution by the jackknife: without one block of time after another.

    A block that says most of what is known moves the solution much when it is left out, so that few
    such blocks do not make it look certain. Not below that of independent errors.

    Args:
        information: (B, n, n) of the blocks.
        scores: (B, n) gradients of the blocks at the solution.
        prior: (n, n) information beside them.
    """
    total = information.sum(axis=0) + prior
    moved = np.linalg.solve(total - information, scores[..., None])[..., 0]
    count = len(scores)
    jackknife = moved.T @ moved * (count - 1) / count
    return _not_below(jackknife, np.asarray(np.linalg.inv(total)))


def _not_below(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """The covariance (n, n) enlarged where it is below another one."""
    root = np.linalg.cholesky(least)
    white = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, axes = np.linalg.eigh(0.5 * (white + white.T))
    stretched = root @ axes * np.sqrt(np.maximum(values, 1.0))
    return np.asarray(stretched @ stretched.T, dtype=np.float64)
