"""Campaign C27 in small, and that it can fail."""

from typing import Any

import numpy as np
import pytest

from campaigns import actions_campaign
from realab_suite import errors
from tests.engine import helpers

_NUMBER = 250


@pytest.mark.parametrize(
    'case', actions_campaign.CASES, ids=lambda case: case.name
)
def test_hostile_actions_are_refused_without_a_trace(
    case: actions_campaign.Case,
):
  found = actions_campaign.play(case, _NUMBER, seed=5)
  assert not found.first
  assert found.refused == _NUMBER
  assert found.pending
  assert found.kinds >= {'no numbers', 'shape', 'number', 'barely outside'}
  assert found.changed == found.differing == found.unclear == 0


def _clip(env: Any, action: Any) -> Any:
  """Does what dm_control does with numbers out of bounds."""
  spec = env.action_spec()
  try:
    values = np.asarray(action, float)
  except Exception as error:
    raise errors.ActionError('no') from error
  if values.shape != spec.shape or np.isnan(values).any():
    raise errors.ActionError('no')
  return env.step(np.clip(values, spec.minimum, spec.maximum))


def _move_then_refuse(env: Any, action: Any) -> Any:
  env.step(helpers.no_op(env))
  raise errors.ActionError('too late')


def _count(env: Any, action: Any) -> Any:
  env._episode += 1
  raise errors.ActionError('it was counted')


def _two_lines(env: Any, action: Any) -> Any:
  raise errors.ActionError('two\nlines')


def _fail(env: Any, action: Any) -> Any:
  raise TypeError('Cannot cast')


@pytest.mark.parametrize(
    ('refuse', 'figures'),
    [
        (_clip, ('accepted', 'changed', 'differing')),
        (_move_then_refuse, ('changed', 'differing')),
        (_count, ('changed', 'differing')),
        (_two_lines, ('unclear',)),
        (_fail, ('other_errors',)),
    ],
)
def test_an_environment_that_leaves_a_trace_is_caught(
    refuse: Any, figures: tuple[str, ...]
):
  found = actions_campaign.play(
      actions_campaign.CASES[0], 60, seed=5, refuse=refuse
  )
  for figure in figures:
    assert getattr(found, figure), figure


def test_a_number_too_large_for_an_action_is_refused_without_a_warning():
  env = actions_campaign.CASES[0].load(0)
  env.reset()
  action = np.zeros(env.action_spec().shape, np.longdouble)
  action[0] = np.longdouble('1e4000')
  with pytest.raises(errors.ActionError, match='= inf outside'):
    env.step(action)
  env.close()
