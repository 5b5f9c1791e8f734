"""As many registers as a design may have load and step; more are refused."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from tests.engine import helpers

pytestmark = pytest.mark.slow

_WORLD = 'collect_apples', 'standard'
# The substeps that the small blocks need.
_SHORT = {'random': 1, 'physics_timestep': 0.01}
_COLUMNS = 20


def _place(index):
  """Returns a place of a grid that leaves room where the avatar begins."""
  row, column = divmod(index, _COLUMNS)
  return [-3.8 + 0.39 * column, 3.7 - 0.25 * row]


def _design(number, place=_place, **register):
  names = [f'r{i}' for i in range(number)]
  return {
      'schema': 1,
      'name': 'many',
      'registers': {
          name: {
              'kind': 'two_block',
              'role': 'feedback',
              'place': place(i),
              'range': [0, 1],
              'block_size': 0.06,
              **register,
          }
          for i, name in enumerate(names)
      },
      'providers': [{'kind': 'constant', 'value': 0.5, 'writes': names}],
  }


def _readings(time_step):
  return np.array([
      value
      for key, value in time_step.observation.items()
      if key.startswith('registers/')
  ])  # fmt: skip


def test_the_largest_design_works():
  env = suite.load(*_WORLD, _SHORT, design=_design(specs.MAX_REGISTERS))
  assert (_readings(env.reset()) == 0.0).all()
  readings = _readings(env.step(helpers.no_op(env)))
  assert readings.shape == (specs.MAX_REGISTERS,)
  np.testing.assert_allclose(readings, 0.5, atol=1e-6)


@pytest.mark.parametrize('number', [specs.MAX_REGISTERS + 1])
def test_more_are_refused_before_anything_is_built(number, monkeypatch):
  def build(*args, **kwargs):
    raise AssertionError('something was built')

  monkeypatch.setattr(mechanisms.FeedbackMechanism, '_build', build)
  monkeypatch.setattr(environment.Environment, '__init__', build)
  message = (
      rf'design: registers: {number} are given; there must be at most'
      rf' {specs.MAX_REGISTERS}$'
  )
  for load in (
      lambda design: suite.load(*_WORLD, design=design),
      lambda design: suite.load_batch(*_WORLD, num_envs=2, design=design),
      specs.load,
  ):
    with pytest.raises(errors.SpecError, match=message):
      load(_design(number))
