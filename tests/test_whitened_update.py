# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""An update of whitened variables is that of the square-root information."""

import numpy as np
import pytest

from slam_graph.backend.cost.gating import distances_of_rows, squared_mahalanobis
from slam_graph.backend.cost.whitened_update import TailRoot, WhitenedUpdate, gated_rows
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation


def test_mean_and_covariance_are_those_of_an_update_by_qr() -> None:
    rng, first = np.random.default_rng(0), 30
    Rd = np.asfortranarray(np.triu(rng.normal(size=(101, 101))) + 5.0 * np.eye(101))
    before = SquareRootInformation(Layout(dict.fromkeys(range(10), 10)), Rd)
    Ab = np.zeros((40, 101))
    Ab[:, first:] = rng.normal(size=(40, 71))
    root = TailRoot.of(before, first)
    update = WhitenedUpdate(before, root, Ab[:, first:-1] @ root.W.T, Ab[:, -1])
    after = before.updated(Ab)
    columns = np.array([95, 31, 60])
    expected = after.covariance()[np.ix_(columns, columns)]
    np.testing.assert_allclose(
        update.covariance(root.last_rows(columns)), expected, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(update.solution()[first:], after.solution()[first:], atol=1e-12)
    np.testing.assert_allclose(root.W.T @ update.mean, after.solution()[first:], atol=1e-12)


def test_distances_by_rows_are_those_by_the_covariance() -> None:
    rng = np.random.default_rng(1)
    Rd = np.asfortranarray(np.triu(rng.normal(size=(81, 81))) + 5.0 * np.eye(81))
    before = SquareRootInformation(Layout(dict.fromkeys(range(8), 10)), Rd)
    columns = np.array([rng.choice(np.arange(20, 80), 9, replace=False) for _ in range(12)])
    H, r = rng.normal(size=(12, 2, 9)), rng.normal(size=(12, 2))
    known = gated_rows(before, columns, np.arange(70, 80), H)
    assert known.tail.first == columns.min()
    A = np.zeros((12, 2, 81))
    A[np.arange(12)[:, None], :, columns] = H.transpose(0, 2, 1)
    A[:, :, -1] = r
    of_some = known.rows[:5].reshape(10, -1)
    update = WhitenedUpdate(before, known.tail, of_some, r[:5].ravel())
    reduction = update.reduction(known.rows.reshape(24, -1)).reshape(12, 2, -1)
    after = before.updated(A[:5].reshape(10, -1))
    for gaussian, found in (
        (before, distances_of_rows(r, known.rows)),
        (after, distances_of_rows(r, known.rows, reduction)),
    ):
        P = gaussian.covariance()[columns[:, :, None], columns[:, None, :]]
        np.testing.assert_allclose(found, squared_mahalanobis(r, H, P), rtol=1e-9)
    root = known.pose_root  # without the rows that are zero
    assert len(root) < len(known.tail.W)
    np.testing.assert_allclose(root.T @ root, before.covariance()[70:, 70:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        update.covariance(root), after.covariance()[70:, 70:], rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("where", ["rows", "right-hand side", "Gaussian"])
def test_what_is_not_finite_is_refused(where: str) -> None:
    Rd = np.asfortranarray(np.eye(5))
    Y, b = np.ones((2, 4)), np.ones(2)
    {"rows": Y[0], "right-hand side": b, "Gaussian": Rd[:4, 4]}[where][1] = np.nan
    before = SquareRootInformation(Layout({0: 4}), Rd)
    with pytest.raises(np.linalg.LinAlgError):
        WhitenedUpdate(before, TailRoot.of(before, 0), Y, b)
