"""Robust spreads: laws of the median absolute deviation, and normal errors with outliers."""

from dataclasses import dataclass

import numpy as np
import pytest

from uwblite.arrays import (
    MAD_TO_SIGMA,
    concatenated,
    renumbered,
    rms_length,
    row_medians,
    runs_of,
    sigma_of_median,
    spread,
    spread_about_median,
    unique_rows,
)


def test_the_factor_is_that_of_normal_errors():
    # 1 / (0.75 quantile of the standard normal distribution).
    assert pytest.approx(1.0 / 0.6744897501960817, abs=5e-5) == MAD_TO_SIGMA


def test_spreads_by_hand():
    assert spread(np.array([-1.0, 2.0, 4.0])) == pytest.approx(2.0 * 1.4826)
    assert spread_about_median(np.array([9.0, 10.0, 13.0])) == pytest.approx(1.4826)
    # sqrt(pi / 2) = 1.2533 times the standard deviation of a mean of four values.
    assert sigma_of_median(np.array([-1.0, -1.0, 1.0, 1.0])) == pytest.approx(1.4826 * np.sqrt(np.pi / 2.0) / 2.0, rel=1e-4)


def test_half_of_the_errors_may_be_outliers():
    errors = np.random.default_rng(1).normal(0.0, 0.2, 20_000)
    assert spread(errors) == pytest.approx(0.2, rel=0.03)
    errors[:4000] = 1e6
    # The median size is then the 0.5 / 0.8 = 0.625 quantile of the sizes, 0.887 standard deviations.
    assert spread(errors) == pytest.approx(0.2 * 0.887 * 1.4826, rel=0.03)


def test_the_median_of_many_samples_scatters_as_stated():
    samples = np.random.default_rng(2).normal(3.0, 0.5, (2000, 101))
    medians = np.median(samples, axis=1)
    assert np.mean([sigma_of_median(row) for row in samples]) == pytest.approx(medians.std(), rel=0.06)


def test_lengths_of_vectors_not_of_their_parts_are_averaged():
    assert rms_length(np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 5.0]])) == pytest.approx(np.sqrt(50.0 / 3.0))


def test_renumbered_values_are_those_of_either_array_once():
    used, one, other = renumbered(np.array([7, 3, 7]), np.array([9, 3, 3]))
    assert used.tolist() == [3, 7, 9]
    assert (used[one].tolist(), used[other].tolist()) == ([7, 3, 7], [9, 3, 3])
    assert [a.size for a in renumbered(np.zeros(0, int), np.zeros(0, int))] == [0, 0, 0]


@pytest.mark.parametrize("columns", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_unique_rows_are_numpys(count, columns):
    rows = np.random.default_rng(3).integers(-3, 4, (count, columns))
    for table in (rows, np.floor(rows / 2.0)):
        found, number = unique_rows(table)
        expected, where = np.unique(table, axis=0, return_inverse=True)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(number, where.reshape(-1))


def test_runs_are_those_of_set_flags():
    assert runs_of(np.array([True, False, True, True])) == [(0, 1), (2, 4)]
    assert runs_of(np.zeros(3, dtype=bool)) == runs_of(np.zeros(0, dtype=bool)) == []


@pytest.mark.parametrize("columns", [1, 2, 3, 8, 99, 100])
def test_medians_of_rows_are_numpys_to_the_last_bit(columns):
    values = np.random.default_rng(columns).normal(size=(40, columns))
    assert np.array_equal(row_medians(values), np.median(values, axis=1))


def test_dataclasses_of_arrays_are_concatenated_field_by_field():
    @dataclass(frozen=True)
    class Inner:
        rows: np.ndarray

    @dataclass(frozen=True)
    class Outer:
        inner: Inner
        flags: np.ndarray

    parts = [Outer(Inner(np.full((n, 2), n)), np.full(n, n > 1)) for n in (1, 0, 2)]
    whole = concatenated(parts)
    assert whole.inner.rows.tolist() == [[1, 1], [2, 2], [2, 2]]
    assert whole.flags.tolist() == [False, True, True]
