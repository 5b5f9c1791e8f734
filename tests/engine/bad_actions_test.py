"""Bad actions are rejected by name and value, and the world does not change.

`machine_test.py` sends them among other calls in any order.
"""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from tests import worlds
from tests.engine import helpers

_NAN, _INF = float('nan'), float('inf')
_INDEX = ('action_set={name: dmlab_like, version: 1}',)


def _load(overrides: tuple[str, ...] = ()) -> Any:
  return suite.load(
      'collect_apples', 'standard', {'random': 7}, {'max_steps': 10_000},
      design='instantaneous_reward', overrides=overrides,
  )  # fmt: skip


def _with(index: int, value: float) -> np.ndarray:
  action = np.zeros(6)
  action[index] = value
  return action


_BAD_ACTIONS: dict[str, tuple[Any, str]] = {
    'nan': (_with(0, _NAN), 'action[0] (forward) is nan'),
    'inf': (_with(2, _INF), 'action[2] (turn) = inf outside [-1, 1]'),
    'barely': (_with(1, np.nextafter(1, 2)), 'action[1] (strafe) = 1.0000'),
    'int': (_with(4, -2).astype(int), 'action[4] (grasp) = -2.0 outside'),
    'scalar': (0.5, 'shape (), expected (6,)'),
    'number': (3, 'expected (6,); the number of an action needs'),
    'shape (1, 6)': (np.zeros((1, 6)), 'shape (1, 6), expected (6,)'),
    'bool': (np.zeros(6, bool), 'dtype bool'),
    'None': (None, 'dtype object'),
    'ragged': ([[1.0], [1.0, 2.0]], 'action: '),
    'masked': (np.ma.zeros(6), 'masked'),
}


def _refuse(env: Any, action: Any) -> str:
  """Returns the message for an action; the world must not change."""
  before = worlds.state_bytes(env.physics)
  with pytest.raises(errors.ActionError) as caught:
    env.step(action)
  assert worlds.state_bytes(env.physics) == before
  assert '\n' not in str(caught.value)
  return str(caught.value)


@pytest.fixture(scope='module')
def running() -> Any:
  """One environment in the middle of an episode, for all bad actions."""
  env = _load()
  env.reset()
  for action in helpers.random_actions(env, 3):
    env.step(action)
  return env


@pytest.mark.parametrize(
    ('action', 'message'), _BAD_ACTIONS.values(), ids=_BAD_ACTIONS
)
def test_a_bad_action_is_rejected(running: Any, action: Any, message: str):
  assert message in _refuse(running, action)
  assert running.step(helpers.no_op(running)).mid()


@pytest.fixture(scope='module', name='twin')
def fixture_twin() -> Any:
  return _load()


@pytest.fixture(name='pair')
def fixture_pair(running: Any, twin: Any) -> tuple[Any, Any]:
  """Two equal environments whose episodes have begun."""
  for env in (running, twin):
    env.rewind()
    env.reset()
  return running, twin


@pytest.mark.parametrize('dtype', [np.float32, np.int8])
def test_other_number_types_are_cast(pair: Any, dtype: Any):
  env, twin = pair
  action = np.array([1, 0, 1, 0, 0, 0])
  for given in (action.astype(dtype), action.tolist()):
    expected = helpers.to_bytes(twin.step(action.astype(float)))
    assert helpers.to_bytes(env.step(given)) == expected


def test_an_action_is_neither_kept_nor_changed(pair: Any):
  env, twin = pair
  action = np.array([0.5, 0, 0.3, 0, 0, 0])
  first = env.step(action)
  np.testing.assert_array_equal(action, [0.5, 0, 0.3, 0, 0, 0])
  assert helpers.to_bytes(first) == helpers.to_bytes(twin.step(action.copy()))
  action[:] = _NAN  # The caller may write to its own array.
  second = env.step(np.zeros(6))
  assert helpers.to_bytes(second) == helpers.to_bytes(twin.step(np.zeros(6)))


def test_an_index_applies_its_row_of_the_action_set(pair: Any):
  env, (_, twin) = _load(_INDEX), pair
  env.reset()
  for index, controls in ((1, [1, 0, 0]), (8, [1, 0, -1]), (0, [0, 0, 0])):
    found = helpers.to_bytes(env.step(index))
    assert found == helpers.to_bytes(twin.step([*controls, 0, 0, 0]))
  for index in (-1, 14, 0.5, np.nan):
    assert 'action' in _refuse(env, index)
