"""The avatar walks, looks and pushes (T1, T4)."""

import numpy as np
import pytest

from realab_suite.entities import registers
from tests import worlds
from tests.entities import avatar_worlds

every_dof = pytest.mark.parametrize('dof', registers.DOFS)


@pytest.fixture(name='world')
def fixture_world():
  return avatar_worlds.make()


def test_the_avatar_moves_at_the_commanded_speed(world):
  for commands, expected in [
      ({'forward': 1.0}, (avatar_worlds.SPEED, 0, 0)),
      ({'forward': -0.5}, (-avatar_worlds.SPEED / 2, 0, 0)),
      ({'strafe': 1.0}, (0, avatar_worlds.SPEED, 0)),
      ({'strafe': -0.5}, (0, -avatar_worlds.SPEED / 2, 0)),
      ({'turn': 1.0}, (0, 0, avatar_worlds.TURN_RATE)),
      ({'turn': -0.5}, (0, 0, -avatar_worlds.TURN_RATE / 2)),
      ({}, (0, 0, 0)),
  ]:
    world.place(-1.0, 0.0, 2.0)
    world.act(50, **commands)
    np.testing.assert_allclose(
        world.velocity, expected, atol=0.1 * avatar_worlds.SPEED
    )


@pytest.mark.parametrize('heading', [0.0, 2.0])
def test_forward_and_left_are_the_avatars_own(world, heading):
  ahead = np.array([np.cos(heading), np.sin(heading)])
  left = np.array([-ahead[1], ahead[0]])
  for command, direction in [('forward', ahead), ('strafe', left)]:
    world.place(-1.0, 0.0, heading)
    before = world.avatar.position(world.physics)
    world.act(50, **{command: 1.0})
    moved = world.avatar.position(world.physics) - before
    # A second of walking, less what it took to get up to speed.
    assert 0.8 < moved @ direction / (0.5 * avatar_worlds.SPEED) <= 1.0
    assert np.linalg.norm(moved) == pytest.approx(moved @ direction, rel=1e-6)


@pytest.mark.parametrize('way', [-1.0, 1.0])
def test_the_pitch_is_limited(world, way):
  world.act(300, look=way)
  [pitch] = world.avatar.senses(world.physics, ['pitch'], (1, 1))['pitch']
  assert way * pitch == pytest.approx(np.radians(60), rel=0.02)


def test_an_avatar_that_is_placed_is_at_rest(world):
  world.act(30, forward=1.0, turn=1.0)
  world.place(-1.0, 2.0, 1.0)
  np.testing.assert_array_equal(world.velocity, 0.0)
  np.testing.assert_array_equal(
      world.avatar.position(world.physics), [-1.0, 2.0]
  )
  assert world.avatar.angle(world.physics) == 1.0


def test_only_free_blocks_leave_the_floor():
  heights = {}
  for dof in registers.DOFS:
    world = avatar_worlds.make(dof=dof)
    world.grasp()
    world.act(50)
    heights[dof] = world.block[2]
  assert heights['free'] == pytest.approx(avatar_worlds.GRIP_HEIGHT, abs=0.01)
  assert heights['planar'] < 0.11


@every_dof
def test_blocks_stay_in_the_room(dof):
  world = avatar_worlds.make(registers.TwoBlockRegister, dof=dof)
  random_state = np.random.RandomState(0)
  for _ in range(6):
    # Whatever the last one did, there is something to play with.
    world.register.write(world.physics, random_state.uniform(-30, 25))
    block = world.register.blocks[random_state.randint(2)]
    place = worlds.world_position(world.physics, block)[:2]
    world.place(*(place - [0.6, 0.0]))
    world.act(20, grasp=1.0)
    turn = random_state.uniform(-0.5, 0.5)
    for _ in range(30):
      forward, strafe = random_state.choice([0.0, 1.0], 2, p=[0.2, 0.8])
      world.act(10, forward=forward, strafe=strafe, turn=turn)
    world.act(100, forward=1.0, **random_state.choice([
        {'throw': 1.0}, {'grasp': -1.0}
    ]))  # fmt: skip
    for block in world.register.blocks:
      place = worlds.world_position(world.physics, block)
      assert world.arena.extent.contains(place[:2], 0.05)
      assert place[2] > 0.08
