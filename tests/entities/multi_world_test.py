"""One rulebook: many worlds at once are what each of them is alone.

The same script is run on three worlds one at a time and on the three stacked,
with other numbers in each. States and everything returned have to be equal to
the last bit.
"""

import dataclasses

import numpy as np
import pytest

from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import doors
from realab_suite.entities import meters
from realab_suite.entities import pads
from realab_suite.entities import registers
from tests import fake_batch
from tests import worlds

_WORLDS = 3
_CONTROL_STEPS = 24
_KINDS = (
    registers.TwoBlockRegister,
    registers.BlockPositionRegister,
    registers.BlockOrientationRegister,
)


class _Parts:
  """Everything that there is, in one world."""

  def __init__(self):
    self.arena = arenas.TwoRooms()
    self.registers = []
    for i, kind in enumerate(_KINDS):
      for j, (channel, dof) in enumerate(
          [
              ('embedded', 'free'),
              ('embedded', 'planar'),
              ('welded', 'free'),
              ('secure', 'free'),
          ]
      ):
        register = kind(
            f'register_{i}_{j}',
            value_range=(-3, 4),
            initial=1.0,
            channel=channel,
            dof=dof,
        )
        register.attach_to(
            self.arena, (-3.0 + 1.7 * j, -3.2 + 1.1 * i), 0.7 * (j % 2)
        )
        self.registers.append(register)
    self.apples = apple_group.Apples(number=4)
    self.apples.attach_to(self.arena)
    self.pad = pads.PressurePad()
    self.pad.attach_to(self.arena, (-2.5, 2.5))
    self.door = doors.SlidingDoor()
    self.door.attach_to(self.arena, self.arena.places['doorway'].position)
    self.avatar = avatars.Avatar(num_rays=9)
    self.arena.attach(self.avatar)
    self.avatar.make_graspable(
        [block for register in self.registers for block in register.blocks]
    )
    self.meter = meters.Meter(self.apples.num_eaten, self.registers[0])

  def fresh_world(self):
    physics = worlds.compile_world(self.arena)
    with physics.reset_context():
      pass
    return physics


@dataclasses.dataclass
class _Plan:
  """What happens in each world, with a leading axis of worlds."""

  starts: np.ndarray
  headings: np.ndarray
  apples: np.ndarray
  actions: np.ndarray
  values: np.ndarray

  def of(self, world):
    """Returns the plan of one world, without the axis."""
    return _Plan(
        **{
            field.name: getattr(self, field.name)[world]
            for field in dataclasses.fields(self)
        }
    )


def _plan():
  random_state = np.random.RandomState(0)
  actions = random_state.uniform(-1, 1, (_WORLDS, _CONTROL_STEPS, 6))
  # The first two worlds take a block and carry it; the first throws it.
  actions[:, :, 5] = -1.0
  actions[:, :, 4] = 0.0
  actions[:, :8, :3] = 0.0
  actions[:2, 1, 4] = 1.0
  actions[0, 6, 5] = 1.0
  actions[1, 8, 4] = -1.0
  # Before a block, before a block, and on the pad.
  starts = np.array([(-3.0, -3.8), (-3.4, -2.15), (-2.0, 2.5)])
  apples = random_state.uniform(1.0, 3.5, (_WORLDS, 4, 2))
  apples[0, 1] = starts[0] + [0.3, 0.3]
  apples[2, 0] = starts[2] + [0.1, 0.4]
  apples[2, 3] = starts[2] + [0.3, 0.0]
  return _Plan(
      starts=starts,
      headings=np.array([np.pi / 2, 0.0, 2.0]),
      apples=apples,
      actions=actions,
      values=random_state.uniform(-4, 5, (_WORLDS, _CONTROL_STEPS)),
  )


def _run(parts, physics, step, plan):
  """Plays a plan, and returns everything that entities said."""
  said = []

  def note(*results):
    said.extend(np.array(result) for result in results)

  avatar = parts.avatar
  for register in parts.registers:
    register.settle(physics, np.array([0.1, -0.05]))
  avatar.place(physics, plan.starts, plan.headings)
  parts.apples.place(physics, plan.apples)
  for t in range(_CONTROL_STEPS):
    avatar.apply_action(physics, plan.actions[..., t, :])
    step(3)
    where = avatar.position(physics)
    note(parts.apples.eat(physics, where, 0.8))
    parts.pad.press(physics, where)
    parts.door.advance(physics, parts.pad.pressed(physics), 0.1)
    if t % 5 == 2:
      for i, register in enumerate(parts.registers):
        note(register.write(physics, plan.values[..., t] + 0.1 * i))
    if t % 5 == 4:
      note(*parts.meter.update(physics))
    step(3)
    for register in parts.registers:
      found = register.inspect(physics)
      note(
          register.read(physics),
          register.applied(physics),
          found.permanent,
          found.temporary,
      )
    note(
        where,
        avatar.angle(physics),
        avatar.direction(physics),
        avatar.velocity(physics),
        avatar.pitch(physics),
        avatar.holding(physics),
        *avatar.rays.sense(physics),
        parts.apples.num_eaten(physics),
        parts.pad.pressed(physics),
        parts.door.openness(physics),
    )
  return said


@pytest.fixture(scope='module', name='parts')
def fixture_parts():
  return _Parts()


def _alone(parts, plan):
  said, states, held = [], [], []
  for i in range(_WORLDS):
    physics = parts.fresh_world()

    def step(steps, physics=physics):
      worlds.step(physics, steps)
      held.append(float(parts.avatar.holding(physics)[0]))

    said.append(_run(parts, physics, step, plan.of(i)))
    states.append(worlds.state_bytes(physics))
  return said, states, np.reshape(held, (_WORLDS, -1))


def test_many_worlds_are_what_each_is_alone(parts):
  plan = _plan()
  alone, states, _ = _alone(parts, plan)
  batch = fake_batch.FakeBatch([parts.fresh_world() for _ in range(_WORLDS)])
  together = _run(parts, batch, batch.step, plan)
  batch.flush()
  for i in range(_WORLDS):
    for one, many in zip(alone[i], together, strict=True):
      assert many.shape == (_WORLDS, *one.shape)
      assert many.dtype == one.dtype
      np.testing.assert_array_equal(many[i], one)
    assert worlds.state_bytes(batch.worlds[i]) == states[i]


def test_the_plan_does_something_else_in_every_world(parts):
  # What makes the test above worth having.
  plan = _plan()
  _, states, held = _alone(parts, plan)
  assert len(set(states)) == _WORLDS
  assert held[0].any()
  assert not held[0, -1]
  assert held[1].any()
  assert not held[2].any()
  batch = fake_batch.FakeBatch([parts.fresh_world() for _ in range(_WORLDS)])
  _run(parts, batch, batch.step, plan)
  assert parts.apples.num_eaten(batch).tolist() == [1, 0, 2]
  pressed = parts.pad.pressed(batch)
  assert pressed.tolist() == [False, False, True]
  assert (parts.door.openness(batch) > 0).tolist() == pressed.tolist()


def test_what_happens_in_one_world_undoes_nothing_in_another(parts):
  batch = fake_batch.FakeBatch([parts.fresh_world() for _ in range(_WORLDS)])
  on, off = (-2.5, 2.5), (3.0, 3.0)
  places = np.broadcast_to([on, off, off, on], (_WORLDS, 4, 2))
  parts.apples.place(batch, places)
  for here, expected in [
      ([on, off, off], [True, False, False]),
      ([off, off, on], [True, False, True]),
      ([off, off, off], [True, False, True]),
  ]:
    where = np.array(here)
    parts.pad.press(batch, where)
    parts.apples.eat(batch, where, 0.5)
    assert parts.pad.pressed(batch).tolist() == expected
  assert parts.apples.num_eaten(batch).tolist() == [4, 2, 4]


def test_a_bad_value_in_one_world_is_written_in_none(parts):
  batch = fake_batch.FakeBatch([parts.fresh_world() for _ in range(_WORLDS)])
  register = parts.registers[0]
  before = [worlds.state_bytes(world) for world in batch.worlds]
  with pytest.raises(ValueError, match='nan'):
    register.write(batch, np.array([1.0, np.nan, 2.0]))
  batch.flush()
  assert [worlds.state_bytes(world) for world in batch.worlds] == before


def test_the_fake_refuses_writes_that_would_be_lost(parts):
  batch = fake_batch.FakeBatch([parts.fresh_world()])
  block = parts.registers[0].blocks[0]
  bound = batch.bind(block.body)
  with pytest.raises(ValueError, match='read-only'):
    bound.xpos[...] = 0.0
