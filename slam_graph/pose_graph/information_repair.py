# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Information matrices that are not positive definite: refused, or repaired if that is asked for.

Some graphs that are widely used have them: of the 16 869 edges of `cubicle` 5021 do. Their cost has
no lower bound, so they cannot be minimised as they are.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.datasets import Rows
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.pose_graph.graph import InformationRepair

_LEAST = 1e-6
"""Smallest eigenvalue of a repaired matrix, as a part of its largest."""


def positive_definite(
    information: FloatArray,
    rows: Rows,
    repair: InformationRepair | None,
    diagnostics: Diagnostics,
) -> FloatArray:
    """The information matrices, those that are not positive definite repaired.

    Args:
        information: (M, k, k) symmetric: translation, then rotation.
        rows: of the file, for messages.
        repair: what stands in for them; None refuses them.
        diagnostics: counts `pose_graph_information_repaired`.

    Raises:
        DataError: if there are some and no repair is asked for, or they cannot be repaired.
    """
    bad = _not_positive_definite(information)
    if len(bad) == 0:
        return information
    if repair is None:
        smallest = np.linalg.eigvalsh(information[bad])[:, 0]
        edge = int(bad[np.argmin(smallest)])
        many = f", nor are those of {len(bad) - 1} other edges" if len(bad) > 1 else ""
        raise DataError(
            f"{rows.where(edge)}: the information matrix is not positive definite (smallest "
            f"eigenvalue {smallest.min():.3g}){many}; --information nearest or isotropic repairs "
            "such matrices"
        )
    made = (_nearest if repair == "nearest" else _isotropic)(information[bad])
    left = _not_positive_definite(made)
    if len(left):
        many = f"; nor can those of {len(left) - 1} other edges" if len(left) > 1 else ""
        raise DataError(
            f"{rows.where(int(bad[left[0]]))}: the information matrix cannot be repaired by "
            f"'{repair}', as there is none in it{many}"
        )
    for edge in bad.tolist():
        diagnostics.warn(
            "pose_graph_information_repaired",
            f"{rows.where(edge)}: the information matrix is not positive definite; {repair} taken",
        )
    repaired = information.copy()
    repaired[bad] = made
    return repaired


def _not_positive_definite(information: FloatArray) -> IntArray:
    """The rows of matrices that have no Cholesky factor."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        pass
    else:
        return np.zeros(0, np.int64)
    return np.array([row for row, one in enumerate(information) if not _has_factor(one)], np.int64)


def _has_factor(matrix: FloatArray) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _nearest(information: FloatArray) -> FloatArray:
    """The nearest matrices whose eigenvalues are not below `_LEAST` of the largest."""
    values, vectors = np.linalg.eigh(information)
    raised = np.maximum(values, _LEAST * values[:, -1:])
    nearest: FloatArray = (vectors * raised[:, None, :]) @ vectors.transpose(0, 2, 1)
    return 0.5 * (nearest + nearest.transpose(0, 2, 1))


def _isotropic(information: FloatArray) -> FloatArray:
    """For translation and rotation the isotropic information of the same mean variance.

    It is zero, which is no repair, where a block is not positive definite itself.
    """
    k = information.shape[1]
    d = 2 if k == 3 else 3
    made = np.zeros_like(information)
    for part in (slice(0, d), slice(d, k)):
        values = np.linalg.eigvalsh(information[:, part, part])
        with np.errstate(divide="ignore"):
            mean = np.where(values[:, 0] > 0, 1.0 / np.mean(1.0 / values, axis=1), 0.0)
        made[:, part, part] = mean[:, None, None] * np.eye(part.stop - part.start)
    return made
