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


@pytest.mark.parametrize(
    ('distance', 'heading', 'command', 'holds'),
    [
        (0.35, 0.0, 1.0, True),
        (0.45, 0.0, 1.0, False),
        # Behind the avatar.
        (0.0, np.pi, 1.0, False),
        (0.0, 0.0, 0.4, False),
    ],
)
def test_a_hand_grasps_what_is_ahead_in_reach_on_command(
    world, distance, heading, command, holds
):
  world.place(1.0 - avatar_worlds.HAND - distance, 0.0, heading)
  world.act(10, grasp=command)
  assert world.holding is holds


@pytest.mark.parametrize(
    ('dof', 'commands'),
    [('free', {'forward': -0.7}), ('planar', {'strafe': 0.7})],
)
def test_a_held_block_follows_the_hand_until_it_is_released(dof, commands):
  world = avatar_worlds.make(dof=dof)
  world.grasp()
  world.act(100, grasp=-0.4, **commands)
  world.act(50)
  assert world.holding
  np.testing.assert_allclose(world.block[:2], world.hand[:2], atol=0.02)
  world.act(50, grasp=-1.0)
  assert not world.holding
  before = world.block
  assert before[2] == pytest.approx(0.1, abs=0.01)
  world.act(100, forward=-0.5)
  np.testing.assert_allclose(world.block[:2], before[:2], atol=0.02)


@pytest.mark.parametrize(
    ('dof', 'size', 'mass', 'keeps_hold'),
    [('free', 0.06, 0.01, False), ('planar', 0.2, 1.0, True)],
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


def _turned(angle: float) -> float:
  """Returns an angle within half a turn."""
  return float(np.arctan2(np.sin(angle), np.cos(angle)))


@every_dof
@pytest.mark.parametrize('written', [0.0, 15.0, -28.0])
def test_a_held_block_whose_heading_is_read_turns_with_the_hand(dof, written):
  world = avatar_worlds.make(registers.BlockOrientationRegister, dof=dof)
  register, physics = world.register, world.physics
  world.grasp()
  assert np.linalg.norm((world.block - world.hand)[:2]) < 0.05
  register.write(physics, written)
  yaws = []
  for steps, commands in (
      (50, {'turn': 1.0}),
      # Carried around, and turned back by more than half a turn.
      (100, {'turn': -1.0, 'strafe': 0.5}),
      (60, {'turn': -1.0}),
  ):
    heading = 0.1 * float(register.read(physics))
    yaw = float(world.avatar.angle(physics))
    for _ in range(steps // 10):
      world.act(10, **commands)
    # It comes to rest with the hand.
    world.act(30)
    assert world.holding
    yaws.append(float(world.avatar.angle(physics)) - yaw)
    turned = 0.1 * float(register.read(physics)) - heading
    assert _turned(turned - yaws[-1]) == pytest.approx(0.0, abs=0.2)
  assert yaws[0] > 1.0
  assert yaws[1] + yaws[2] < -np.pi
  read = register.inspect(physics)
  assert abs(read.temporary) > 1.0
  assert read.permanent == 0.0
  # A write sets the angle, and the hand turns the block on from there.
  register.write(physics, written)
  assert float(register.read(physics)) == pytest.approx(written, abs=1e-9)
  yaw = float(world.avatar.angle(physics))
  world.act(20, turn=1.0)
  yaw = float(world.avatar.angle(physics)) - yaw
  assert yaw > 0.4
  turned = 0.1 * (float(register.read(physics)) - written)
  assert _turned(turned - yaw) == pytest.approx(0.0, abs=0.1)
  # Released, it stays; grasped anew, it turns again.
  world.act(60, grasp=-1.0)
  before = float(register.read(physics))
  world.act(60, turn=-1.0)
  assert 0.1 * abs(float(register.read(physics)) - before) < 0.02
  world.grasp()
  before = float(register.read(physics))
  world.act(60, turn=1.0)
  turned = 0.1 * (float(register.read(physics)) - before)
  assert abs(_turned(turned)) > 1.0


def test_a_held_block_of_other_kinds_does_not_turn_with_the_hand():
  world = avatar_worlds.make(dof='planar')
  world.grasp()
  world.act(50, turn=1.0)
  assert abs(float(world.register.blocks[0].heading(world.physics))) < 0.1


def test_a_held_block_that_cannot_turn_does_not_lock_the_avatar():
  world = avatar_worlds.World(registers.BlockOrientationRegister, dof='planar')
  world.grasp()
  physics = world.physics
  hinge = world.register.mjcf_model.find('joint', 'block_hinge')
  physics.bind(hinge).damping = 1e4
  yaw = float(world.avatar.angle(physics))
  world.act(100, turn=1.0)
  assert float(world.avatar.angle(physics)) - yaw > 2.0
  assert abs(float(world.register.read(physics))) < 0.1


def test_a_hand_grasps_only_the_nearest_block():
  world = avatar_worlds.make(registers.TwoBlockRegister)
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


def test_a_block_that_is_put_elsewhere_leaves_the_hand(world):
  world.grasp()
  block = world.register.blocks[0]
  block.put(world.physics, np.array([2.0, 2.0, block.rest_height]))
  assert not world.holding


def test_a_reset_empties_the_hand(world):
  world.grasp()
  world.restart()
  assert not world.holding


@pytest.mark.parametrize(
    ('dof', 'yaw', 'heading'),
    [('free', 0.0, 2.0), ('planar', 0.7, 0.0)],
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


def test_a_write_does_not_release_another_block():
  world = avatar_worlds.make(registers.TwoBlockRegister)
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


@pytest.mark.parametrize(('dof', 'overlap'), [('free', 0.7), ('planar', 0.1)])
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
    [('planar', 'free', 0.1), ('free', 'planar', 1.0)],
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


@pytest.mark.parametrize(('dof', 'overlap'), [('free', 1.0), ('planar', 0.2)])
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
