"""Slopes in blocks of rows: as the whole of them, zeros written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.fitting.slopes import SlopeBlock, Slopes, joined


def drawn(seed, lengths=(700, 1500, 30), shared=3, own=2, q=2):
    """Blocks of records that share coordinates and have starts of their own, and residuals."""
    rng, n_free = np.random.default_rng(seed), shared + own * len(lengths)
    ends, blocks = np.cumsum(lengths).tolist(), []
    for k, (end, n) in enumerate(zip(ends, lengths, strict=True)):
        columns = np.array([*range(shared), *(shared + own * k + np.arange(own))])
        # Walls of a valley a hundred million times as steep as its floor.
        values = rng.standard_normal((n, q, len(columns))) * 10.0 ** rng.uniform(
            -4, 4, len(columns)
        )
        blocks.append(SlopeBlock(slice(end - n, end), columns, values))
    return Slopes(tuple(blocks), n_free), rng.standard_normal((ends[-1], q))


@given(seed=st.integers(0, 1000), c=st.tuples(st.floats(0.1, 10.0), st.floats(0.0, 10.0)))
def test_the_triangle_is_that_of_all_rows(seed, c):
    slopes, residual = drawn(seed)
    root, right = slopes.triangle(residual, np.array(c))
    weights = np.sqrt(c)[:, None]
    dense = (slopes.dense * weights).reshape(-1, slopes.n_free)
    scale = np.linalg.norm(dense, axis=0)
    expected = np.linalg.qr(dense, mode="r")
    signs = np.sign(np.diag(expected) * np.diag(root))
    np.testing.assert_allclose(signs[:, None] * root / scale, expected / scale, atol=1e-12)
    push = dense.T @ (residual * weights[:, 0]).ravel() / scale
    np.testing.assert_allclose(root.T @ right / scale, push, atol=1e-10 * np.abs(push).max())


@given(seed=st.integers(0, 1000), c=st.tuples(st.floats(0.1, 10.0), st.floats(0.0, 10.0)))
def test_sums_of_products_tell_the_same(seed, c):
    slopes, residual = drawn(seed)
    triangle, toward = slopes.triangle(residual, np.array(c))
    root, right = slopes.root(residual, np.array(c))
    scale = np.linalg.norm(triangle, axis=0)
    np.testing.assert_allclose(
        root.T @ root / np.outer(scale, scale), triangle.T @ triangle / np.outer(scale, scale),
        atol=1e-12,
    )  # fmt: skip
    push = triangle.T @ toward / scale
    np.testing.assert_allclose(root.T @ right / scale, push, atol=1e-10 * np.abs(push).max())


def test_of_a_tie_sums_of_products_tell_nothing():
    values = np.random.default_rng(4).standard_normal((50, 1, 3))
    values[..., 2] = 2.0 * values[..., 0] - values[..., 1]
    root, right = Slopes.of(values).root(values[:, :, 0].copy(), np.ones(1))
    assert np.flatnonzero(root.any(axis=1)).tolist() == [1, 2]
    assert right[0] == 0.0


def test_products_are_those_of_all_rows():
    slopes, residual = drawn(1)
    rng = np.random.default_rng(2)
    steps, errors = rng.standard_normal((4, 9)), rng.standard_normal((4, len(residual)))
    for j in range(2):
        dense = slopes.dense[:, j]
        np.testing.assert_allclose(slopes.along(steps, j), steps @ dense.T, rtol=1e-12, atol=1e-9)
        pushes = slopes.pushes(errors, j)
        np.testing.assert_allclose(pushes, errors @ dense, rtol=1e-9, atol=1e-12)


def test_what_is_no_number_counts_as_nothing_and_is_told():
    slopes, residual = drawn(3)
    slopes.blocks[1].values[5, 0, 1] = np.nan
    slopes.blocks[2].values[0, 1, -1] = np.inf
    assert np.flatnonzero(~slopes.finite).tolist() == [1, 8]
    for way in (slopes.triangle, slopes.root):
        assert np.isfinite(np.concatenate([*map(np.ravel, way(residual, np.ones(2)))])).all()
    none = slopes.without(~slopes.finite)
    assert none.finite.all()
    assert not none.dense[..., [1, 8]].any() and none.dense[..., 0] == pytest.approx(
        slopes.dense[..., 0]
    )
    assert not none.triangle(residual, np.ones(2))[0][:, [1, 8]].any()


def test_a_row_more():
    slopes, _ = drawn(4)
    row = np.arange(18.0).reshape(2, 9)
    np.testing.assert_array_equal(
        joined(slopes, row).dense, np.concatenate([slopes.dense, row[None]])
    )
