"""Tests of a person at the keyboard."""

import pytest

from realab_suite.interop.browser import keyboards
from realab_suite.policies import action_sets


@pytest.mark.parametrize(
    ('keys', 'name'),
    [
        ([], 'wait'),
        (['KeyW'], 'forward'),
        (['ArrowUp', 'ArrowLeft'], 'forward_turn_left'),
        (['KeyA', 'KeyW'], 'forward_turn_left'),
        (['KeyW', 'KeyG'], 'grasp'),
        (['KeyA', 'KeyD'], 'wait'),
        (['KeyT'], 'throw'),
    ],
)
def test_keys_choose_an_action(keys, name):
  index = keyboards.action(keys, action_sets.DMLAB_LIKE)
  assert action_sets.DMLAB_LIKE.actions[index][0] == name


def test_a_key_that_was_tapped_between_two_steps_counts_once():
  keys = keyboards.Keys()
  keys.press('KeyG')
  keys.release('KeyG')
  assert keys.take() == ['KeyG']
  assert keys.take() == []


def test_a_key_that_is_held_counts_in_every_step():
  keys = keyboards.Keys()
  keys.press('KeyW')
  keys.press('Escape')
  assert [keys.take(), keys.take()] == [['KeyW'], ['KeyW']]
  keys.release_all()
  assert keys.take() == []
