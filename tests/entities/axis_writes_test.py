"""A write changes the coordinate that carries the value, and nothing else."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import worlds
from tests.entities import avatar_worlds
from tests.entities import register_worlds

every_dof = pytest.mark.parametrize('dof', registers.DOFS)
every_kind = pytest.mark.parametrize('kind', register_worlds.KINDS)
_SCALE = 0.1


def _written(register: registers.Register) -> Any:
  """Returns the block that a write moves."""
  return register.blocks[-1]


def _make(kind: str, **options: Any) -> avatar_worlds.World:
  return avatar_worlds.World(register_worlds.KINDS[kind], **options)


def _tumble(world: avatar_worlds.World) -> None:
  """Pushes the written block into the air, where it turns."""
  worlds.shove(
      world.physics, _written(world.register), (30, 50, 40), (0.2, 0.1, 0.3)
  )
  world.physics.forward()


@every_dof
@every_kind
def test_a_write_leaves_everything_else_as_it_is(kind, dof):
  value = 5.5
  world = _make(kind, dof=dof, yaw=0.7)
  _tumble(world)
  physics, block = world.physics, _written(world.register)
  before = _pose(physics, block)
  velocities = np.array(physics.data.qvel)
  others = np.array(
      physics.bind(world.avatar.mjcf_model.find_all('joint')).qpos
  )
  world.register.write(physics, value)
  physics.forward()
  after = _pose(physics, block)
  assert float(world.register.read(physics)) == pytest.approx(value, abs=1e-9)
  np.testing.assert_array_equal(physics.data.qvel, velocities)
  np.testing.assert_array_equal(
      physics.bind(world.avatar.mjcf_model.find_all('joint')).qpos, others
  )
  if kind == 'block_orientation':
    np.testing.assert_array_equal(after['position'], before['position'])
    # A turn about the vertical does not tilt.
    np.testing.assert_allclose(after['up'], before['up'], atol=1e-12)
  else:
    np.testing.assert_array_equal(after['position'][1:], before['position'][1:])
    np.testing.assert_array_equal(after['matrix'], before['matrix'])


@pytest.mark.parametrize(
    ('axis', 'quarters'), [((1, 0, 0), 1), ((0, 1, 0), 2), ((0, 1, 0), 3)]
)
def test_a_toppled_block_at_rest_holds_its_orientation(axis, quarters):
  # A heading that is undefined for one of these faces would read noise there.
  world = _make('block_orientation', dof='free')
  physics, block = world.physics, _written(world.register)
  rotation = world.register.mjcf_model.find('joint', f'{block.body.name}_ball')
  half = quarters * np.pi / 4
  physics.bind(rotation).qpos = [np.cos(half), *np.sin(half) * np.array(axis)]
  physics.step(300)
  for step in range(20):
    value = 0.5 * step
    world.register.write(physics, value)
    physics.step(10)
    assert float(world.register.read(physics)) == pytest.approx(value, abs=1e-9)


def _pose(physics: Any, block: Any) -> dict[str, np.ndarray]:
  matrix = np.array(physics.bind(block.geom).xmat).reshape(3, 3)
  return {
      'position': np.array(block.position(physics)),
      'matrix': matrix,
      'up': matrix[2],
  }


@pytest.mark.parametrize(
    ('kind', 'dof'), [('two_block', 'free'), ('block_position', 'planar')]
)
def test_a_held_block_can_be_written_and_carried(kind, dof):
  world = _make(kind, dof=dof, yaw=0.0)
  physics, register = world.physics, world.register
  block = _written(register)
  x, y, _ = worlds.world_position(physics, block)
  world.place(x - 0.6, y)
  world.act(50, grasp=1.0)
  for command in ({'forward': -1.0}, {'strafe': 0.7}, {'turn': 1.0}, {}):
    for _ in range(5):
      world.act(6, **command)
      register.write(physics, 12.0)
      written = float(block.along(physics))
      worlds.step(physics, 4)  # The hand acts once per control step.
      read = register.inspect(physics)
      moved = (float(block.along(physics)) - written) / _SCALE
      assert world.holding
      assert abs(read.temporary) > 1e-3
      assert read.temporary == pytest.approx(moved, abs=1e-9)
      assert float(read.obstruction) == 0.0
  # Let go of at rest, and clear of the avatar, it stays where it is written. A
  # free block still has to fall.
  register.write(physics, 12.0)
  world.act(100)
  left = []
  for _ in range(6):
    world.act(6, grasp=-1.0)
    register.write(physics, 12.0)
    worlds.step(physics, 4)
    left.append(abs(float(register.inspect(physics).temporary)))
  assert not world.holding
  assert left[0] < (1e-5 if dof == 'planar' else 0.3)
  assert left[-1] < (1e-6 if dof == 'planar' else 1e-2)


@every_dof
def test_a_block_that_returns_to_the_hand_does_not_rush(dof):
  speeds = {}
  for value in (-12.0, 4.0):
    world = _make('block_position', dof=dof)
    world.grasp()
    world.register.write(world.physics, value)
    assert world.holding
    speeds[value] = 0.0
    for _ in range(100):
      world.act(2)
      speeds[value] = max(speeds[value], world.fastest)
  assert max(speeds.values()) <= 2.0
  assert min(speeds.values()) > 0.3


def _room(
    yaw: float = 0.0, dof: str = 'free', at: Any = (0.0, 0.0), **options: Any
) -> tuple[Any, registers.Register]:
  arena = arenas.TwoRooms()
  arena.add_barrier('barrier', (-2.0, 2.0), (1.0, 2.0))
  register = registers.BlockPositionRegister(
      'r', value_range=(-40, 40), dof=dof, **options
  )
  register.attach_to(arena, at, yaw)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  return physics, register


@pytest.mark.parametrize(
    ('dof', 'yaw'), [('free', 0.0), ('planar', math.pi / 2), ('free', 0.4)]
)
def test_a_block_written_into_a_barrier_gets_the_nearest_free_place(dof, yaw):
  physics, register = _room(yaw, dof)
  (block,) = register.blocks
  turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
  num_obstructed = 0
  for x, y in [(-0.5, 2.0), (-1.95, 2.05), (0.9, 1.95), (0.0, 1.0), (0.0, 2.2)]:
    along, aside = turn @ [x, y]
    # In the same room, clear of the barrier.
    from_here = 3.4 if x < 0 and yaw < 1 else -3.4
    start = np.array([along + from_here, aside, 0.1])
    block.put(physics, start)
    value = float(along) / _SCALE
    register.write(physics, value)
    read = register.inspect(physics)
    obstruction = float(read.obstruction)
    is_inside = abs(y - 2.0) < 0.15 and -2.15 < x < 1.15
    assert (abs(obstruction) > 0) == is_inside
    assert float(read.reading) == pytest.approx(value + obstruction, abs=1e-9)
    assert float(read.temporary) == pytest.approx(0.0, abs=1e-9)
    assert _depth(physics, block) < 0.07
    if is_inside:
      num_obstructed += 1
      # A nearer place is not free.
      for nearer in np.linspace(0.0, 0.9, 10):
        position = start.copy()
        position[0] = (value + nearer * obstruction) * _SCALE
        block.put(physics, position)
        assert _depth(physics, block) > 0.01
    # The next write, without an obstacle, corrects it.
    block.put(physics, [0.0, 0.0, block.rest_height])
    register.write(physics, 1.0)
    assert float(register.inspect(physics).obstruction) == 0.0
  assert num_obstructed == 3


def _depth(physics: Any, block: Any) -> float:
  """Returns the depth of a block in walls and barriers, in m."""
  mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
  geom = int(physics.bind(block.geom).element_id)
  deepest = 0.0
  for contact in physics.data.contact[: physics.data.ncon]:
    pair = {int(contact.geom[0]), int(contact.geom[1])}
    names = {physics.model.id2name(g, 'geom') for g in pair - {geom}}
    if geom in pair and not names & {'floor', 'lid'}:
      deepest = max(deepest, -float(contact.dist))
  return deepest


def test_a_block_carried_to_another_room_stays_in_it():
  physics, register = _room()
  (block,) = register.blocks
  for value in (-40.0, -14.0, 0.0, 14.0, 40.0):
    block.put(physics, [0.0, 5.5, block.rest_height])
    register.write(physics, value)
    x = float(block.position(physics)[0])
    assert abs(x) <= 1.3
    assert x == pytest.approx(np.clip(value * _SCALE, -1.25, 1.25), abs=1e-3)


def test_a_secure_register_is_never_obstructed():
  physics, register = _room(channel='secure')
  register.blocks[0].put(physics, [0.0, 2.0, 0.1])
  register.write(physics, -5.0)
  read = register.inspect(physics)
  assert float(read.reading) == -5.0
  assert float(read.obstruction) == 0.0
