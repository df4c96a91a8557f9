# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""An update of whitened variables is that of the square-root information."""

import numpy as np
import pytest

from slam_graph.backend.cost.whitened_update import TailRoot, WhitenedUpdate
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
    np.testing.assert_allclose(update.covariance(columns), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(update.solution()[first:], after.solution()[first:], atol=1e-12)
    np.testing.assert_array_equal(root.from_column(50), root.W[20:, 20:])


@pytest.mark.parametrize("where", ["rows", "right-hand side", "Gaussian"])
def test_what_is_not_finite_is_refused(where: str) -> None:
    Rd = np.asfortranarray(np.eye(5))
    Y, b = np.ones((2, 4)), np.ones(2)
    {"rows": Y[0], "right-hand side": b, "Gaussian": Rd[:4, 4]}[where][1] = np.nan
    before = SquareRootInformation(Layout({0: 4}), Rd)
    with pytest.raises(np.linalg.LinAlgError):
        WhitenedUpdate(before, TailRoot.of(before, 0), Y, b)
