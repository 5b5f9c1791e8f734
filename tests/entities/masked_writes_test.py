"""A write with a mask changes the worlds of the mask, and no other world."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics
from realab_suite.entities import axes
from tests.entities import register_worlds

_NUM_ENVS = 3
_WHERE = np.array([False, True, False])


@pytest.fixture(name='world')
def fixture_world():
  """Returns worlds in which every block has been moved and moves on."""
  made = register_worlds.make_world(single_physics.ThinPhysics)
  physics = batch_physics.BatchPhysics(made.physics, _NUM_ENVS, 1)
  for register in made.registers.values():
    for i in range(_NUM_ENVS):
      register.initialize_episode(physics.world(i), np.random.RandomState(0))
  state = physics.state
  state += np.random.default_rng(0).uniform(0, 0.05, state.shape)
  physics.mark_as_dirty()
  return register_worlds.World(physics, made.registers)


def test_a_masked_write_changes_the_worlds_of_the_mask_only(world):
  physics = world.physics
  values = np.array([np.nan, 2.5, np.inf])
  for register in world.registers.values():
    before, reading = physics.state.copy(), register.read(physics)
    last = register.applied(physics)
    applied = register.write(physics, values, _WHERE)
    assert applied[1] == 2.5
    np.testing.assert_array_equal(applied[~_WHERE], last[~_WHERE])
    np.testing.assert_array_equal(register.applied(physics), applied)
    masked = physics.state.copy()
    np.testing.assert_array_equal(masked[~_WHERE], before[~_WHERE])
    np.testing.assert_array_equal(
        register.read(physics)[~_WHERE], reading[~_WHERE]
    )
    # The world of the mask is as after a write to all worlds.
    physics.state[:] = before
    physics.mark_as_dirty()
    register.write(physics, np.full(_NUM_ENVS, 2.5))
    np.testing.assert_array_equal(physics.state[1], masked[1])
    assert not np.array_equal(physics.state[0], before[0])


def test_a_value_that_cannot_be_stored_names_a_world_of_the_mask(world):
  register = next(iter(world.registers.values()))
  with pytest.raises(errors.RegisterValueError) as caught:
    register.write(world.physics, np.full(_NUM_ENVS, np.nan), _WHERE)
  assert caught.value.world == 1


def test_masks_are_combined_and_none_stands_for_all_worlds():
  some, none = np.array([True, False]), np.zeros(2, bool)
  assert axes.both(None, None) is None
  assert axes.both(None, np.ones(2, bool)) is None
  assert axes.both(some, None).tolist() == [True, False]
  assert axes.both(some, ~some).tolist() == [False, False]
  assert axes.both(np.True_, None) is None
  assert [axes.nowhere(m) for m in (None, some, none)] == [False, False, True]
  assert axes.nowhere(np.False_)
  old = np.zeros((2, 3))
  assert axes.merge(some, 1.0, old).tolist() == [[1.0] * 3, [0.0] * 3]
  assert axes.merge(None, 1.0, old) == 1.0
