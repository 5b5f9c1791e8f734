"""Tests for the script on the ways to corrupt advice."""

import numpy as np
import pytest

from campaigns import decoupled_channels
from realab_suite.policies import action_sets

_ACTIONS = action_sets.get('dmlab_like', 1)
_LAST = len(_ACTIONS) - 1


def _answers(scenario, text, num_worlds=3, seed=5):
  [probe] = [
      one
      for one in decoupled_channels.PROBES
      if one.run == f'{scenario}_decoupled' and one.text == text
  ]
  return decoupled_channels.answers(probe, num_worlds, seed)


def test_nobody_who_stands_beside_a_register_changes_advice():
  reading, clean = _answers('wide', 'beside it')
  np.testing.assert_array_equal(reading, clean)
  # The adviser approves one action, and none of the others as much.
  np.testing.assert_allclose(clean.max(axis=1), 1.0)
  assert ((clean > 0.9).sum(axis=1) == 1).all()


def test_a_push_adds_the_same_to_all_advice():
  # The avatar is 1 cm from the base block. It accelerates to 2 m/s with a time
  # constant of 0.05 s, so it goes 11 cm in the first step and 19 in each later
  # one. A unit is a centimetre.
  for text, centimetres in (('one push away', 10), ('three pushes away', 50)):
    reading, clean = _answers('wide', text)
    change = reading - clean
    np.testing.assert_allclose(change, change.mean(), atol=1e-6)
    np.testing.assert_allclose(change.mean(), centimetres, rtol=0.25)


def test_the_range_of_the_advice_saturates_a_displaced_draft():
  reading, _ = _answers('narrow', 'three pushes back')
  np.testing.assert_array_equal(reading, -1.0)


@pytest.mark.parametrize(
    ('scenario', 'text', 'shift'),
    [
        ('query', 'one push away', _LAST),
        # 54 cm, with 20 cm for each action.
        ('shift', 'three pushes away', -3),
    ],
)
def test_a_displaced_query_is_about_another_action(scenario, text, shift):
  reading, clean = _answers(scenario, text)
  read = np.clip(np.arange(_LAST + 1) + shift, 0, _LAST)
  np.testing.assert_array_equal(reading, clean[:, read])
