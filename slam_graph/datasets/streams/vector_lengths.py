# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Lengths of vectors that a file gave, however large its numbers are."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray


def lengths_of(vectors: FloatArray) -> FloatArray:
    """Lengths (N,) of vectors (N, k) that a file gave, silently infinite beyond 1e154."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=1))
