"""Tests of numbers of one world and arrays of many."""

import numpy as np
import pytest

from realab_suite.entities import axes


def test_scalars_and_arrays_give_the_same_bits() -> None:
  numbers = np.random.default_rng(0).normal(size=(100, 3))
  one, other, _ = numbers.T
  many = np.cos(one) * other
  for row, expected in zip(numbers, many, strict=True):
    one, other, _ = row.T
    assert (np.cos(one) * other).tobytes() == expected.tobytes()


@pytest.mark.parametrize('value', [1.0, -0.0, np.nan, np.inf, -np.inf])
def test_finite_values_of_one_world_and_of_many(value) -> None:
  expected = value in (1.0, 0.0)
  for kind in (float, np.float64, np.array):
    assert axes.is_finite(kind(value)) == expected
  many = axes.is_finite(np.array([0.0, value]))
  np.testing.assert_array_equal(many, [True, expected])


@pytest.mark.parametrize(
    ('condition', 'anywhere', 'everywhere'),
    [
        ([True, True], True, True),
        ([True, False], True, False),
        ([False, False], False, False),
    ],
)
def test_conditions_of_many_worlds(condition, anywhere, everywhere) -> None:
  assert axes.anywhere(np.array(condition)) is anywhere
  assert axes.everywhere(np.array(condition)) is everywhere


@pytest.mark.parametrize('kind', [np.bool_, np.array])
@pytest.mark.parametrize('condition', [True, False])
def test_a_condition_of_one_world(kind, condition) -> None:
  assert axes.anywhere(kind(condition)) is condition
  assert axes.everywhere(kind(condition)) is condition
