# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Square-root information against dense linear algebra."""

import numpy as np
import pytest

from slam_graph.arrays import FloatArray
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.triangles import transposed_inverse, upper_part

DIMS = {10: 3, 11: 6, 12: 1, 13: 3, 14: 2}
SIZE = sum(DIMS.values())
SEEDS = range(5)


def random_rows(rng: np.random.Generator, count: int, size: int = SIZE) -> FloatArray:
    return rng.normal(size=(count, size + 1))


def gaussian(rng: np.random.Generator) -> SquareRootInformation:
    Rd = triangularize(random_rows(rng, 2 * SIZE))
    return SquareRootInformation(Layout(DIMS), Rd)


def cost_at(gauss: SquareRootInformation, x: FloatArray) -> float:
    """The whole least-squares cost, with the part that no increment can remove."""
    return float(np.sum((gauss.R @ x - gauss.d) ** 2) + gauss.Rd[-1, -1] ** 2)


def dense(*blocks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of stacked rows by a textbook least squares."""
    rows = np.concatenate(blocks)
    A, b = rows[:, :-1], rows[:, -1]
    mean = np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], dtype=np.float64)
    return mean, np.asarray(np.linalg.inv(A.T @ A), dtype=np.float64)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("count", [0, 1, SIZE, 2 * SIZE, 2 * SIZE + 1, 20 * SIZE])
def test_an_update_is_least_squares_of_all_rows(seed: int, count: int) -> None:
    """Also for more rows than twice the columns, which are compressed first."""
    rng = np.random.default_rng(seed)
    prior, rows = gaussian(rng), random_rows(rng, count)
    posterior = prior.updated(rows)
    mean, covariance = dense(prior.Rd, rows)
    np.testing.assert_allclose(posterior.solution(), mean, atol=1e-9)
    np.testing.assert_allclose(posterior.covariance(), covariance, atol=1e-9)
    root = posterior.root_covariance()
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-9)
    x = rng.normal(size=SIZE)
    stacked = np.concatenate([prior.Rd, rows])
    expected = np.sum((stacked[:, :-1] @ x - stacked[:, -1]) ** 2)
    np.testing.assert_allclose(cost_at(posterior, x), expected, rtol=1e-10)


def test_a_tall_update_equals_the_same_rows_in_pieces() -> None:
    rng = np.random.default_rng(0)
    prior, rows = gaussian(rng), random_rows(rng, 7 * SIZE)
    whole = prior.updated(rows)
    pieces = prior
    for part in np.array_split(rows, 9):
        pieces = pieces.updated(part)
    np.testing.assert_allclose(whole.solution(), pieces.solution(), atol=1e-9)
    np.testing.assert_allclose(whole.R.T @ whole.R, pieces.R.T @ pieces.R, atol=1e-9)
    assert np.all(np.tril(whole.Rd, -1) == 0.0)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_noise_of_the_leading_variables_adds_to_their_covariance(count: int) -> None:
    rng, dims = np.random.default_rng(count), {1: 3, 2: 3, 3: 3, 4: 6, 5: 1}
    size = sum(dims.values())
    before = SquareRootInformation(Layout(dims), triangularize(random_rows(rng, 40, size)))
    roots = rng.normal(size=(count, 3, 2))  # of rank two
    after = before.with_noise(roots @ roots.transpose(0, 2, 1))
    expected = before.covariance()
    for k, root in enumerate(roots):
        expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += root @ root.T
    np.testing.assert_allclose(after.covariance(), expected, atol=1e-12)
    np.testing.assert_allclose(after.solution(), before.solution(), atol=1e-12)
    assert after.residual == before.residual
    assert np.all(np.tril(after.Rd, -1) == 0.0)


@pytest.mark.parametrize("first", [0, 2])
def test_zeros_that_are_left_out_change_nothing(first: int) -> None:
    """Staggered rows say the same in reverse order, in which none of their zeros is left out."""
    rng = np.random.default_rng(5)
    prior, rows = gaussian(rng), np.zeros((SIZE - first, SIZE + 1))
    rows[:, first:] = np.triu(random_rows(rng, SIZE - first)[:, first:])
    posterior, expected = prior.updated(rows), prior.updated(rows[::-1])
    np.testing.assert_allclose(posterior.solution(), expected.solution(), atol=1e-12)
    np.testing.assert_allclose(posterior.R.T @ posterior.R, expected.R.T @ expected.R, atol=1e-12)


def test_an_update_leaves_the_prior_and_the_rows_alone() -> None:
    rng = np.random.default_rng(1)
    prior, rows = gaussian(rng), np.asfortranarray(random_rows(rng, SIZE))
    before = prior.Rd.copy(), rows.copy()
    prior.updated(rows)
    np.testing.assert_array_equal(prior.Rd, before[0])
    np.testing.assert_array_equal(rows, before[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_marginal_is_the_schur_complement(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gauss = gaussian(rng)
    keys = rng.permutation(list(DIMS)).tolist()
    keep, gone = keys[:3], keys[3:]
    marginal = gauss.marginal(keep)
    information, vector = gauss.R.T @ gauss.R, gauss.R.T @ gauss.d
    k, g = gauss.layout.indices(keep), gauss.layout.indices(gone)
    gain = information[np.ix_(k, g)] @ np.linalg.inv(information[np.ix_(g, g)])
    schur = information[np.ix_(k, k)] - gain @ information[np.ix_(g, k)]
    assert list(marginal.layout.dims) == keep
    np.testing.assert_allclose(marginal.R.T @ marginal.R, schur, atol=1e-9)
    np.testing.assert_allclose(marginal.R.T @ marginal.d, vector[k] - gain @ vector[g], atol=1e-9)
    np.testing.assert_allclose(marginal.solution(), gauss.solution()[k], atol=1e-9)
    np.testing.assert_allclose(marginal.covariance(), gauss.covariance()[np.ix_(k, k)], atol=1e-9)
    best = gauss.solution()
    np.testing.assert_allclose(cost_at(marginal, best[k]), cost_at(gauss, best), rtol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("unmoved", [1, 15, 16, 17, 47, 60])
def test_what_stands_before_an_eliminated_variable_stays_in_place(seed: int, unmoved: int) -> None:
    """However many rows that is: they are worked on in blocks."""
    rng = np.random.default_rng(seed)
    layout = Layout({**dict.fromkeys(range(unmoved), 3), **{100 + k: 6 for k in range(5)}})
    gauss = SquareRootInformation(
        layout, triangularize(random_rows(rng, 2 * layout.size, layout.size))
    )
    keep = [*range(unmoved), *rng.permutation([100, 102, 103]).tolist()]
    marginal, k = gauss.marginal(keep), layout.indices(keep)
    assert list(marginal.layout.dims) == keep
    assert np.all(np.tril(marginal.Rd, -1) == 0.0)
    np.testing.assert_allclose(marginal.solution(), gauss.solution()[k], atol=1e-9)
    np.testing.assert_allclose(marginal.covariance(), gauss.covariance()[np.ix_(k, k)], atol=1e-9)
    best = gauss.solution()
    np.testing.assert_allclose(cost_at(marginal, best[k]), cost_at(gauss, best), rtol=1e-9)


def test_a_marginal_over_all_variables_only_reorders() -> None:
    gauss = gaussian(np.random.default_rng(2))
    keys = list(DIMS)[::-1]
    again = gauss.marginal(keys).marginal(list(DIMS))
    np.testing.assert_allclose(again.R.T @ again.R, gauss.R.T @ gauss.R, atol=1e-9)
    assert gauss.marginal([]).layout.size == 0


def test_what_is_not_determined_is_not_made_up() -> None:
    gauss = gaussian(np.random.default_rng(3)).extended({99: 3})
    kept = gauss.marginal([99, 10])
    np.testing.assert_allclose(kept.R[:3, :3], 0.0, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        gauss.solution()
    with pytest.raises(np.linalg.LinAlgError):
        gauss.covariance()


def test_a_shift_moves_the_argument() -> None:
    rng = np.random.default_rng(4)
    gauss, delta, x = gaussian(rng), rng.normal(size=SIZE), rng.normal(size=SIZE)
    shifted = gauss.shifted(delta)
    np.testing.assert_allclose(cost_at(shifted, x), cost_at(gauss, x + delta), rtol=1e-10)
    np.testing.assert_allclose(shifted.solution(), gauss.solution() - delta, atol=1e-9)
    np.testing.assert_array_equal(shifted.R, gauss.R)


def test_an_extension_adds_variables_of_which_nothing_is_known() -> None:
    rng = np.random.default_rng(5)
    gauss = gaussian(rng)
    wide = gauss.extended({20: 2, 21: 3})
    assert list(wide.layout.dims) == [*DIMS, 20, 21]
    x = rng.normal(size=SIZE + 5)
    np.testing.assert_allclose(cost_at(wide, x), cost_at(gauss, x[:SIZE]), rtol=1e-12)
    rows = random_rows(rng, 12, SIZE + 5)
    padded = np.insert(gauss.Rd, [SIZE] * 5, 0.0, axis=1)
    mean, covariance = dense(padded, rows)
    np.testing.assert_allclose(wide.updated(rows).solution(), mean, atol=1e-9)
    np.testing.assert_allclose(wide.updated(rows).covariance(), covariance, atol=1e-9)
    assert gauss.extended({}) is gauss
    with pytest.raises(ValueError, match="other variables first"):
        gauss.over(Layout({20: 2, **DIMS}))
    with pytest.raises(ValueError, match="appended twice"):
        gauss.layout.extended({next(iter(DIMS)): 6, 20: 2})


def test_a_copy_has_its_own_memory() -> None:
    gauss = gaussian(np.random.default_rng(6))
    before = gauss.Rd.copy()
    for layout in (gauss.layout, gauss.layout.extended({20: 2})):
        gauss.over(layout, copy=True).Rd[:] = 7.0
    np.testing.assert_array_equal(gauss.Rd, before)


@pytest.mark.parametrize("shape", [(3, 7), (7, 7), (0, 4)])
def test_upper_parts_whatever_is_below(shape: tuple[int, int]) -> None:
    values = np.asfortranarray(np.random.default_rng(7).normal(size=shape))
    expected = np.triu(values)
    values[np.tril_indices(len(values), -1, shape[1])] = np.nan
    assert np.array_equal(upper_part(values), expected)


def test_knowledge_can_grow_from_nothing() -> None:
    empty = SquareRootInformation.empty()
    assert empty.layout.size == 0
    grown = empty.extended({7: 2}).updated(np.array([[2.0, 0.0, 4.0], [0.0, 1.0, 3.0]]))
    np.testing.assert_allclose(grown.solution(), [2.0, 3.0])


@pytest.mark.parametrize("shape", [(3, 7), (7, 7), (40, 7)])
def test_a_triangle_has_the_same_normal_equations(shape: tuple[int, int]) -> None:
    rows = np.random.default_rng(6).normal(size=shape)
    R = triangularize(rows)
    assert R.shape == (7, 7)
    assert np.all(np.tril(R, -1) == 0.0)
    np.testing.assert_allclose(R.T @ R, rows.T @ rows, atol=1e-9)


@pytest.mark.parametrize("size", [1, 64, 65, 200])
def test_covariance_is_the_inverse_of_the_information(size: int) -> None:
    rng = np.random.default_rng(size)
    layout = Layout(dict.fromkeys(range(size), 1))
    prior = SquareRootInformation(layout, triangularize(rng.normal(size=(2 * size + 2, size + 1))))
    information = prior.R.T @ prior.R
    np.testing.assert_allclose(prior.covariance() @ information, np.eye(size), atol=1e-9)
    some = [*range(0, size, 2)]
    np.testing.assert_allclose(
        prior.covariance_of(some),
        np.linalg.inv(information)[np.ix_(some, some)],
        rtol=1e-9,
        atol=1e-12,
    )


@pytest.mark.parametrize("n", [1, 40, 64, 65, 150])
def test_the_inverse_of_a_triangle_is_one(n: int) -> None:
    """Whatever is below the diagonal."""
    values = np.asfortranarray(np.random.default_rng(n).normal(size=(n, n)) + 9.0 * np.eye(n))
    inverse = transposed_inverse(values)
    np.testing.assert_allclose(inverse.T @ np.triu(values), np.eye(n), atol=1e-12)
    np.testing.assert_array_equal(inverse, np.tril(inverse))
