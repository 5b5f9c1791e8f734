"""Tests of the networks of learners."""

import jax
import numpy as np
import pytest

from realab_suite.lab.agents import networks


@pytest.mark.parametrize(
    ('height', 'width', 'stride'),
    [(13, 22, 4), (3, 64, 4), (9, 8, 2), (1, 1, 2)],
)
def test_a_convolution_is_that_of_jax(height, width, stride):
  rng = np.random.default_rng(0)
  x = rng.normal(size=(2, height, width, 3)).astype(np.float32)
  size = 2 * stride
  kernel = rng.normal(size=(size, size, 3, 5)).astype(np.float32)
  expected = jax.lax.conv_general_dilated(
      x, kernel, (stride, stride), 'SAME',
      dimension_numbers=('NHWC', 'HWIO', 'NHWC'),
  )  # fmt: skip
  found = networks.convolve(x, kernel)
  assert found.shape == expected.shape
  np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
