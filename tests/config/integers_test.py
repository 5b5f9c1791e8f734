"""Tests for the check of integers that users give."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.config import integers


@pytest.mark.parametrize('given', [1, np.int64(1), np.uint8(1)])
def test_integers_of_python_and_numpy_become_integers_of_python(given):
  checked = integers.check('number', given, 1, 2)
  assert checked == 1
  assert type(checked) is int


@pytest.mark.parametrize(
    'given', [True, np.True_, 1.0, '1', None, 0, 3, np.int8(-1), [1], 2**63]
)
def test_anything_else_is_refused(given):
  with pytest.raises(
      errors.SpecError, match=r'number: .*; must be an integer from 1 to 2$'
  ):
    integers.check('number', given, 1, 2)


def test_the_error_names_other_allowed_values_and_has_the_given_class():
  with pytest.raises(
      errors.ResultsError, match='number: -1; must be an integer from 0, or x'
  ):
    integers.check('number', -1, 0, more=', or x', error=errors.ResultsError)
