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


@pytest.mark.parametrize('name', ['scalar', 'vector'])
def test_a_copy_of_a_slot_does_not_change(name):
  arena, (counter,) = _world(3)
  physics = worlds.compile_world(arena)
  slot = getattr(counter, name)
  slot.set(physics, 1.0)
  copied = slot.copy(physics)
  slot.set(physics, 2.0)
  np.testing.assert_array_equal(copied, np.ones_like(slot.get(physics)))


def test_a_vector_is_live_and_a_scalar_of_one_world_is_a_number():
  arena, (counter,) = _world(3)
  physics = worlds.compile_world(arena)
  live, number = counter.vector.get(physics), counter.scalar.get(physics)
  counter.vector.set(physics, 4.0)
  counter.scalar.set(physics, 4.0)
  np.testing.assert_array_equal(live, [4, 4, 4])
  assert isinstance(number, np.float64)
  assert number == 0.0


def test_the_layout_names_every_slot_and_leaves_no_gaps():
  arena, _ = _world(3, 5)
  layout = state.layout(worlds.compile_world(arena).model)
  assert layout == {
      'counter_0/userdata.scalar': 0,
      'counter_0/userdata.vector': 1,
      'counter_1/userdata.scalar': 4,
      'counter_1/userdata.vector': 5,
  }


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


def test_slots_survive_a_recompilation():
  arena, (counter,) = _world(2)
  environment = composer.Environment(
      composer.NullTask(arena), recompile_mjcf_every_episode=True
  )
  for _ in range(2):
    environment.reset()
    assert counter.scalar.get(environment.physics) == 0.0
    counter.scalar.set(environment.physics, 1.0)
    assert counter.scalar.get(environment.physics) == 1.0


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
  physics = worlds.compile_world(arena)
  with pytest.raises(
      errors.StateLayoutError,
      match=rf'4 slots need {state.CAPACITY + 1} numbers .* {state.CAPACITY}',
  ):
    counter.scalar.get(physics)


def test_a_world_can_have_as_much_room_as_its_slots_need():
  arena, counters = _world(*[9] * 60)
  state.make_room(arena.mjcf_model)
  environment = composer.Environment(composer.NullTask(arena))
  for _ in range(2):
    environment.reset()  # Compiles anew.
    physics = environment.physics
    assert physics.model.nuserdata == 600
    for i, counter in enumerate(counters):
      counter.vector.set(physics, i + 1.0)
      counter.scalar.set(physics, -1.0 - i)
    for i, counter in enumerate(counters):
      np.testing.assert_array_equal(counter.vector.get(physics), i + 1.0)
      assert counter.scalar.get(physics) == -1.0 - i


@pytest.mark.parametrize('number', [1, 60])
def test_entities_can_be_attached_to_a_world_that_had_room(number):
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
