# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How well something is told from the rest by probabilities: precision, recall and ROC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Detection:
    """How well moving features are told from static ones.

    Attributes:
        precision: share of those called moving that move.
        recall: share of those that move that are called so.
        false_positives, true_positives: (K,) the curve (ROC), from no to all features.
        area: under the curve; one half is chance.
    """

    precision: float
    recall: float
    false_positives: FloatArray
    true_positives: FloatArray
    area: float


def detection(probabilities: FloatArray, moving: BoolArray, limit: float = 0.5) -> Detection:
    """Compare probabilities (N,) that features move with the truth (N,).

    Args:
        probabilities: of moving.
        moving: whether they do.
        limit: probability from which a feature is called moving.
    """
    called = probabilities >= limit
    hits = int(np.count_nonzero(called & moving))
    count = max(int(np.count_nonzero(moving)), 1), max(int(np.count_nonzero(~moving)), 1)
    order = np.argsort(-probabilities, kind="stable")
    true = np.concatenate([[0.0], np.cumsum(moving[order]) / count[0]])
    false = np.concatenate([[0.0], np.cumsum(~moving[order]) / count[1]])
    return Detection(
        hits / max(int(np.count_nonzero(called)), 1),
        hits / count[0],
        false,
        true,
        float(np.trapezoid(true, false)),
    )
