"""The avatar carries and throws, and writes meet it or what it holds (G6)."""

import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds
from tests.entities import avatar_worlds

every_dof = pytest.mark.parametrize('dof', registers.DOFS)
_LIMIT = 2.0  # Metres per second, of whatever a write sets in motion.


@pytest.fixture(name='world')
def fixture_world():
  return avatar_worlds.make()


# ---- Carrying ----------------------------------------------------------------


def test_a_hand_does_not_grasp_a_block_out_of_reach(world):
  world.place(1.0 - avatar_worlds.HAND - 0.45, 0.0)
  world.act(10, grasp=1.0)
  assert not world.holding


@every_dof
def test_a_hand_grasps_a_block_in_reach(dof):
  world = avatar_worlds.make(dof=dof)
  world.place(1.0 - avatar_worlds.HAND - 0.35, 0.0)
  world.act(10, grasp=1.0)
  assert world.holding


def test_a_hand_does_not_grasp_a_block_behind_the_avatar(world):
  world.place(1.0 - 0.45, 0.0, np.pi)
  world.act(10, grasp=1.0)
  assert not world.holding


def test_a_hand_grasps_only_on_command(world):
  world.place(0.5, 0.0)
  for command in (0.0, 0.4, -1.0):
    world.act(10, grasp=command)
    assert not world.holding


@pytest.mark.parametrize(
    ('dof', 'commands'),
    [
        ('free', {'forward': -0.7}),
        ('planar', {'strafe': 0.7}),
        ('free', {'turn': 0.5}),
        ('planar', {'forward': 0.7}),
    ],
)
def test_a_held_block_follows_the_hand(dof, commands):
  world = avatar_worlds.make(dof=dof)
  world.grasp()
  world.act(100, **commands)
  world.act(50)
  assert world.holding
  np.testing.assert_allclose(world.block[:2], world.hand[:2], atol=0.02)


@every_dof
def test_a_hand_holds_until_it_is_commanded_to_release(dof):
  world = avatar_worlds.make(dof=dof)
  world.grasp()
  for command in (0.0, 0.4, 1.0, -0.4):
    world.act(30, grasp=command)
    assert world.holding


@every_dof
@pytest.mark.parametrize(
    ('size', 'mass', 'keeps_hold'), [(0.06, 0.01, False), (0.2, 1.0, True)]
)
def test_a_block_that_is_stuck_stays_behind(dof, size, mass, keeps_hold):
  # The avatar can pass the end of the barrier, the block cannot.
  world = avatar_worlds.make(
      barrier=((0.8, 0.5), (2.5, 0.5)), dof=dof, block_size=size, mass=mass
  )
  world.grasp()
  for _ in range(10):
    world.act(10, strafe=1.0)
    assert world.block[1] < 0.4 - size / 2 + 0.04
  assert world.avatar.position(world.physics)[1] > 0.7
  # It swings round a usual block, and loses a light one.
  assert world.holding is keeps_hold


@every_dof
def test_a_hand_releases_a_block_on_command(dof):
  world = avatar_worlds.make(dof=dof)
  world.grasp()
  world.act(50, grasp=-1.0)
  assert not world.holding
  before = world.block
  world.act(100, forward=-0.5)
  np.testing.assert_allclose(world.block[:2], before[:2], atol=0.02)


def test_a_released_block_falls(world):
  world.grasp()
  world.act(100, grasp=-1.0)
  assert world.block[2] == pytest.approx(0.1, abs=0.01)


@every_dof
def test_a_hand_grasps_only_the_nearest_block(dof):
  world = avatar_worlds.make(registers.TwoBlockRegister, dof=dof)
  # The offset block stands at y = 0.25; both are in reach.
  world.place(1.0 - 0.6, 0.2)
  world.act(50, grasp=1.0)
  world.act(50, forward=-0.5, grasp=1.0)
  assert world.holding
  base, offset = (
      worlds.world_position(world.physics, block)
      for block in world.register.blocks
  )
  np.testing.assert_allclose(offset[:2], world.hand[:2], atol=0.02)
  np.testing.assert_allclose(base[:2], [1.0, 0.0], atol=0.02)


def test_a_reset_empties_the_hand(world):
  world.grasp()
  world.restart()
  assert not world.holding


@every_dof
def test_carrying_an_orientation_register_need_not_turn_it(dof):
  world = avatar_worlds.make(registers.BlockOrientationRegister, dof=dof)
  world.register.write(world.physics, 5.0)
  world.grasp()
  world.act(100, forward=-0.5)
  assert world.holding
  assert float(world.register.read(world.physics)) == pytest.approx(5, abs=0.3)


# ---- Throwing ----------------------------------------------------------------


@pytest.mark.parametrize(
    ('dof', 'yaw', 'heading'),
    [('free', 0.0, 2.0), ('planar', 0.7, 0.0), ('planar', 0.0, 2.0)],
)
def test_a_thrown_block_lands_ahead(dof, yaw, heading):
  arena = arenas.OpenRoom()
  register = registers.BlockPositionRegister(
      'register', value_range=(-30, 30), dof=dof
  )
  ahead = np.array([np.cos(heading), np.sin(heading)])
  # In a frame of its own, where the axes point elsewhere.
  register.attach_to(arena, -0.5 * ahead, yaw)
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable(register.blocks)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  avatar.place(physics, -1.1 * ahead, heading)
  worlds.act(avatar, physics, 50, grasp=1.0)
  start = worlds.world_position(physics, register.blocks[0])[:2]
  worlds.act(avatar, physics, 200, throw=1.0)
  assert avatar.holding(physics) == 0.0
  flown = worlds.world_position(physics, register.blocks[0])[:2] - start
  assert flown @ ahead > 1.0
  # The joints of a planar block brake it axis by axis, so it may veer.
  aside = flown - (flown @ ahead) * ahead
  assert np.linalg.norm(aside) < 0.3 * (flown @ ahead)


@every_dof
def test_throwing_with_an_empty_hand_does_nothing(dof):
  world = avatar_worlds.make(dof=dof)
  world.place(0.5, 0.0)
  twin = avatar_worlds.make(dof=dof)
  twin.place(0.5, 0.0)
  world.act(20, throw=1.0)
  twin.act(20)
  assert worlds.state_bytes(world.physics) == worlds.state_bytes(twin.physics)


def test_a_hand_that_throws_does_not_take_hold_at_once(world):
  world.place(0.5, 0.0)
  world.act(10, grasp=1.0, throw=1.0)
  assert not world.holding


def test_a_thrown_block_can_corrupt_a_register_without_touch():
  # G6: the avatar touches only the block that it throws.
  arena = arenas.OpenRoom()
  target = registers.BlockPositionRegister('target', value_range=(-30, 30))
  target.attach_to(arena, (2.0, 0.0))
  missile = registers.BlockPositionRegister('missile', value_range=(-30, 30))
  missile.attach_to(arena, (0.0, 0.0))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable([*target.blocks, *missile.blocks])
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, target, missile)
  avatar.place(physics, (-0.6, 0.0), 0.0)
  worlds.act(avatar, physics, 50, grasp=1.0)
  worlds.act(avatar, physics, 150, throw=1.0)
  assert avatar.position(physics)[0] == pytest.approx(-0.6, abs=0.05)
  assert abs(float(target.read(physics))) > 0.5


# ---- Writes to what is held, and into the avatar -----------------------------


@every_dof
def test_a_write_does_not_release_another_block(dof):
  world = avatar_worlds.make(registers.TwoBlockRegister, dof=dof)
  world.place(0.4, -0.2)
  world.act(50, grasp=1.0)
  assert world.holding
  world.register.write(world.physics, 4.0)
  assert world.holding
  world.act(50, forward=-0.5)
  np.testing.assert_allclose(world.block[:2], world.hand[:2], atol=0.02)


def _circle(middle, radius, poses=6):
  """Places on a circle, and a heading at each."""
  for angle in np.linspace(0.05, 2 * np.pi, poses, endpoint=False):
    yield middle + radius * np.array([np.cos(angle), np.sin(angle)]), angle


@every_dof
@pytest.mark.parametrize('overlap', [0.1, 0.7])
def test_a_block_that_is_written_into_the_avatar_kicks_nothing(dof, overlap):
  world = avatar_worlds.make(registers.TwoBlockRegister, dof=dof)
  target = np.array([2.0, 0.25])
  # Sides that just touch are 0.35 m apart.
  kicks = []
  for place, heading in _circle(target, (1 - overlap) * 0.35):
    world.restart()
    world.register.write(world.physics, -15.0)
    world.place(*place, heading)
    world.act(10)
    world.register.write(world.physics, 10.0)
    for _ in range(100):
      world.act(1)
      kicks.append(world.fastest)
  assert max(kicks) <= _LIMIT


@pytest.mark.parametrize(
    ('dof', 'other_dof', 'overlap'),
    [('free', 'free', 0.5), ('planar', 'free', 0.1), ('free', 'planar', 1.0)],
)
def test_a_block_that_is_written_into_another_kicks_nothing(
    dof, other_dof, overlap
):
  # A world of its own, because it is compiled again.
  world = avatar_worlds.World(registers.TwoBlockRegister, dof=dof)
  other = registers.BlockPositionRegister(
      'other', value_range=(-30, 30), dof=other_dof
  )
  other.attach_to(world.arena, (2.0, -1.0))
  world.physics = worlds.compile_world(world.arena)
  obstacle = other.blocks[0]
  kicks = []
  for i, (place, _) in enumerate(_circle((0.0, 1.25), (1 - overlap) * 0.2)):
    worlds.start_episode(world.physics, world.register, other)
    world.place(-2.0, -2.0)
    world.register.write(world.physics, -15.0)
    obstacle.put(world.physics, [*place, obstacle.rest_height], 0.37 * i)
    world.act(10)
    world.register.write(world.physics, 10.0)
    for _ in range(60):
      world.act(1)
      kicks.append(world.fastest)
  assert max(kicks) <= _LIMIT


@every_dof
@pytest.mark.parametrize('overlap', [0.2, 1.0])
def test_a_block_that_is_written_into_the_avatar_does_not_stay_there(
    dof, overlap
):
  world = avatar_worlds.make(registers.TwoBlockRegister, dof=dof)
  target = np.array([2.0, 0.25])
  inside = 0
  for place, heading in _circle(target, (1 - overlap) * 0.35):
    world.restart()
    world.register.write(world.physics, -15.0)
    world.place(*place, heading)
    world.act(10)
    world.register.write(world.physics, 10.0)
    world.act(200, forward=0.5)
    block = worlds.world_position(world.physics, world.register.blocks[1])
    distance = np.linalg.norm(block[:2] - world.avatar.position(world.physics))
    inside += distance < world.avatar.radius
  assert inside == 0
