"""Slots: an episode's state is in the physics, and nowhere else."""

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import state
from tests import worlds

_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


class _Counter(composer.Entity):
  """Keeps a scalar and a vector."""

  def _build(self, name='counter', size=3):
    self._mjcf_root = mjcf.RootElement(model=name)
    self.scalar = state.Slot(self._mjcf_root, 'scalar')
    self.vector = state.Slot(self._mjcf_root, 'vector', size)

  @property
  def mjcf_model(self):
    return self._mjcf_root


def _world(*sizes):
  arena = composer.Arena()
  counters = [_Counter(f'counter_{i}', size) for i, size in enumerate(sizes)]
  for counter in counters:
    arena.attach(counter)
  return arena, counters


def _get_state(physics):
  model, data = physics.model.ptr, physics.data.ptr
  stored = np.empty(mujoco.mj_stateSize(model, _INTEGRATION))
  mujoco.mj_getState(model, data, stored, _INTEGRATION)
  return stored


def test_a_slot_keeps_its_value_until_a_reset():
  arena, (counter,) = _world(3)
  physics = worlds.compile_world(arena)
  counter.scalar.set(physics, 1.5)
  counter.vector.set(physics, [1.0, 2.0, 3.0])
  assert counter.scalar.get(physics).shape == ()
  assert counter.scalar.get(physics) == 1.5
  np.testing.assert_array_equal(counter.vector.get(physics), [1, 2, 3])
  counter.vector.set(physics, 2.0)
  np.testing.assert_array_equal(counter.vector.get(physics), [2, 2, 2])
  assert counter.scalar.get(physics) == 1.5
  physics.reset()
  np.testing.assert_array_equal(counter.vector.get(physics), 0.0)


def test_a_copy_of_the_integration_state_holds_the_slots():
  arena, (counter,) = _world(2)
  physics, twin = worlds.compile_world(arena), worlds.compile_world(arena)
  counter.vector.set(physics, [1.0, 2.0])
  snapshot = _get_state(physics)
  counter.vector.set(physics, 9.0)
  for world in (physics, twin):
    mujoco.mj_setState(world.model.ptr, world.data.ptr, snapshot, _INTEGRATION)
    np.testing.assert_array_equal(counter.vector.get(world), [1.0, 2.0])


def test_one_entity_serves_many_worlds():
  arena, (counter,) = _world(2)
  first = worlds.compile_world(arena)
  # In the second, the same slots have other places.
  arena.attach(_Counter('newcomer', 5))
  second = worlds.compile_world(arena)
  for _ in range(2):
    counter.scalar.set(first, 1.0)
    counter.scalar.set(second, 2.0)
    assert counter.scalar.get(first) == 1.0
    assert counter.scalar.get(second) == 2.0


def test_a_slot_attached_after_compiling_is_an_error():
  arena, _ = _world(2)
  physics = worlds.compile_world(arena)
  late = _Counter('late')
  arena.attach(late)
  with pytest.raises(
      errors.StateLayoutError, match=r'late/userdata.scalar: not in the comp'
  ):
    late.scalar.get(physics)


def test_more_slots_than_there_is_room_for_are_refused():
  arena, (counter, _) = _world(state.CAPACITY - 3, 2)
  arena.mjcf_model.size.nuserdata = state.CAPACITY
  physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
  with pytest.raises(
      errors.StateLayoutError,
      match=rf'4 slots need {state.CAPACITY + 1} numbers .* {state.CAPACITY}',
  ):
    counter.scalar.get(physics)


def test_entities_can_be_attached_to_a_world_that_had_room():
  number = 60
  arena, counters = _world(*[9] * number)
  with state.room_for_slots(arena.mjcf_model):
    worlds.compile_world(arena)
  last = _Counter('last')
  arena.attach(last)
  counters[0].detach()
  arena.attach(counters[0])
  with state.room_for_slots(arena.mjcf_model):
    physics = worlds.compile_world(arena)
  for counter in (*counters, last):
    counter.scalar.set(physics, 1.0)
  assert physics.data.userdata.sum() == number + 1
