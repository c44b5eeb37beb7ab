"""Matrices of which half is kept: products, sums over groups and scales as those of the whole."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radiosity.form_factors._symmetric import SymmetricMatrix
from radiosity.form_factors.matrix import close_rows

MANY = 300


def _whole(rng: np.random.Generator, n: int) -> np.ndarray:
    half = rng.random((n, n)) * rng.choice([1e-3, 1.0], (n, n))
    return half + half.T


@settings(max_examples=40, deadline=None)
@given(st.integers(1, MANY), st.integers(0, 1000))
def test_it_is_the_whole_matrix(n, seed):
    rng = np.random.default_rng(seed)
    whole, x = _whole(rng, n), rng.random((n, 2))
    kept = SymmetricMatrix.of_dense(whole)
    assert kept @ x == pytest.approx(whole @ x, rel=1e-12)
    assert kept @ x[:, 0] == pytest.approx(whole @ x[:, 0], rel=1e-12)
    assert kept.diagonal() == pytest.approx(np.diag(whole), rel=1e-15)
    assert kept.max() == whole.max()
    first = np.unique(np.concatenate([[0], rng.integers(0, n, 1 + n // 4)]))
    groups = np.add.reduceat(np.add.reduceat(whole, first, axis=0), first, axis=1)
    assert kept.summed(np.append(first, n)) @ np.eye(len(first)) == pytest.approx(groups, rel=1e-12)
    factors = 1.0 + rng.random(n)
    assert kept.scale_by(factors) == pytest.approx((np.outer(factors, factors) * whole - whole).max(), rel=1e-12)
    assert kept @ x == pytest.approx((np.outer(factors, factors) * whole) @ x, rel=1e-12)
    assert kept.diagonal() == pytest.approx(factors**2 * np.diag(whole), rel=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, MANY), st.integers(0, 1000))
def test_pairs_add_up_to_it_in_any_order(n, seed):
    rng = np.random.default_rng(seed)
    whole = _whole(rng, n)
    row, column = np.triu_indices(n)
    value = np.where(row == column, 0.5, 1.0) * whole[row, column]
    order, turned = rng.permutation(len(row)), rng.random(len(row)) < 0.5
    first, second = (np.where(turned, a, b)[order].astype(np.int32) for a, b in ((row, column), (column, row)))
    found = SymmetricMatrix.empty(n)
    half = len(order) // 2
    for part in (slice(0, half), slice(half, None)):
        found.add(first[part], second[part], value[order][part])
    assert found @ np.eye(n) == pytest.approx(whole, rel=1e-6)


def test_half_an_entry_takes_two_bytes():
    assert SymmetricMatrix.empty(5000)._kept.nbytes < 1.05 * 2 * 5000**2


def test_faces_of_a_narrow_gap_close_in_few_products():
    """They see next to nothing but each other, so what one row has too much the other cannot take up."""
    rng = np.random.default_rng(1)
    n, products = 200, 0
    whole = _whole(rng, n) / n
    pair = np.arange(20)
    far = 10.0 ** -rng.uniform(3.0, 9.0, 20)
    for side in (pair, pair + 20):
        whole[side] *= far[:, None]
        whole[:, side] *= far
    whole[pair, pair + 20] = whole[pair + 20, pair] = 1.0
    wanted = whole.sum(axis=1) * (1.0 + 0.01 * rng.standard_normal(n))
    kept = SymmetricMatrix.of_dense(whole)

    class Counted:
        def __matmul__(self, x):
            nonlocal products
            products += 1
            return kept @ x

    wanted[pair + 20] = wanted[pair]
    x = close_rows(Counted(), wanted, 1e-6, over_area=True)
    assert np.abs(x * (kept @ x) - wanted).sum() < 1e-6 * wanted.sum()
    assert products < 200
