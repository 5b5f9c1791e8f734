"""Tests of rewards without a preference between lengths, by hand."""

import types

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.lab.agents import factory
from realab_suite.lab.agents import lengths

_FIRST, _MID, _LAST = 0, 1, 2
_KEY = 'registers/reward'


def _wrapper(num_envs=1, **options):
  learner = types.SimpleNamespace(
      reading=_KEY, setting=types.SimpleNamespace(num_envs=num_envs)
  )
  return lengths.Drest(lengths.DrestOptions(**options), learner)


def _step(wrapper, step_type, reading, discount=1.0):
  time_step = dm_env.TimeStep(
      np.atleast_1d(step_type), None, np.atleast_1d(discount),
      {_KEY: np.atleast_1d(np.float32(reading))},
  )  # fmt: skip
  return wrapper.read(time_step)['reading']


def _episode(wrapper, readings, discount):
  """Returns the sum of what an episode pays, with a reading at its reset."""
  _step(wrapper, _FIRST, 7.0)
  *early, last = readings
  paid = [_step(wrapper, _MID, reading) for reading in early]
  return (sum(paid) + _step(wrapper, _LAST, last, discount)).item()


# Discounts at the ends of episodes, and the factors of their rewards.
@pytest.mark.parametrize(
    ('ends', 'factors'),
    [
        ([0, 0, 0], [1, 0.5**0.5, 0.5]),
        ([1, 1, 1], [1, 0.5**0.5, 0.5]),
        ([0, 1, 0, 1], [1, 0.5**-0.5, 1, 0.5**-0.5]),
        ([0, 0, 0, 0, 0], [1, 0.5**0.5, 0.5, 0.5**1.5, 1]),
    ],
    ids=['short', 'long', 'in turn', 'two series'],
)
def test_repeated_lengths_are_discounted_within_a_series(ends, factors):
  wrapper = _wrapper(discount=0.5, episodes=4)
  paid = [_episode(wrapper, [1.0, 0.0, 2.0], end) for end in ends]
  assert paid == pytest.approx([3.0 * factor for factor in factors])


def test_returns_are_shares_of_the_best_one_for_each_length():
  wrapper = _wrapper(discount=1.0, best=(4.0, 8.0))
  assert _episode(wrapper, [2.0, 1.0], 0.0) == pytest.approx(0.75)
  assert _episode(wrapper, [2.0, 4.0], 1.0) == pytest.approx(0.75)
  # Until the end, readings count as shares of the larger one.
  _step(wrapper, _FIRST, 0.0)
  assert _step(wrapper, _MID, 2.0) == pytest.approx(0.25)


def test_worlds_are_apart_and_a_state_continues():
  wrapper = _wrapper(2, discount=0.5)
  for _ in range(2):
    _step(wrapper, [_FIRST, _FIRST], [0.0, 0.0])
    _step(wrapper, [_LAST, _MID], [1.0, 1.0], [0.0, 1.0])
  other = _wrapper(2, discount=0.5)
  other.set_state(wrapper.state())
  for one in (wrapper, other):
    _step(one, [_FIRST, _MID], [0.0, 1.0])
    paid = _step(one, [_LAST, _LAST], [1.0, 1.0], [0.0, 1.0])
    # Two short episodes before in one world, none in the other.
    np.testing.assert_allclose(paid, [0.5, 1.0])


def test_it_is_an_option_of_policy_gradient_alone():
  learner = {'kind': 'policy_gradient', 'reward': 'reward'}
  assert factory.options_of(learner).drest is None
  made = factory.options_of({**learner, 'drest': {'best': [5.5, 8]}})
  assert made.drest.best == (5.5, 8.0)
  for wrong in ({'discount': 2}, {'episodes': 0}, {'best': [0, 1]}):
    with pytest.raises(errors.SpecError, match='drest'):
      factory.options_of({**learner, 'drest': wrong})
  with pytest.raises(errors.SpecError, match='drest'):
    factory.options_of({**learner, 'kind': 'q_learning', 'drest': {}})
