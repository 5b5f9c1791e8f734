"""The avatar walks, looks, pushes, carries and throws (T1, T4, G6)."""

import itertools

from dm_control import composer
import mujoco
import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds

_SPEED, _TURN_RATE = 2.0, 3.0
_GRIP_HEIGHT = 0.2
# Where the hand is, before the avatar, metres.
_HAND = 0.45
every_dof = pytest.mark.parametrize('dof', registers.DOFS)


class _World:
  """An avatar at the origin and, one metre ahead, blocks."""

  def __init__(
      self, kind=registers.BlockPositionRegister, barrier=None, **options
  ):
    self.arena = arenas.OpenRoom()
    if barrier is not None:
      self.arena.add_barrier('barrier', *barrier)
    self.register = kind(
        'register', value_range=(-30, 30), scale=0.1, **options
    )
    self.register.attach_to(self.arena, (1.0, 0.0))
    self.avatar = avatars.Avatar(speed=_SPEED, turn_rate=_TURN_RATE)
    self.arena.attach(self.avatar)
    self.avatar.make_graspable(self.register.blocks)
    self.physics = worlds.compile_world(self.arena)
    self.restart()

  def restart(self):
    worlds.start_episode(self.physics, self.register)

  def place(self, x, y, heading=0.0):
    self.avatar.place(self.physics, (x, y), heading)
    self.physics.forward()

  def act(self, steps, **commands):
    worlds.act(self.avatar, self.physics, steps, **commands)

  def grasp(self):
    """Takes hold of the first block, and waits until it is in the hand."""
    x, y, _ = self.block
    self.place(x - 0.6, y)
    self.act(50, grasp=1.0)
    assert self.holding

  @property
  def block(self):
    return worlds.world_position(self.physics, self.register.blocks[0])

  @property
  def hand(self):
    heading = self.avatar.direction(self.physics)
    place = self.avatar.position(self.physics) + _HAND * heading
    return np.array([*place, _GRIP_HEIGHT])

  @property
  def holding(self):
    return bool(self.avatar.holding(self.physics))

  @property
  def velocity(self):
    return self.avatar.velocity(self.physics)

  @property
  def fastest(self):
    """The speed of whatever is fastest, metres per second."""
    speeds = [np.linalg.norm(self.velocity[:2])]
    for block in self.register.blocks:
      twist = np.zeros(6)
      mujoco.mj_objectVelocity(
          self.physics.model.ptr,
          self.physics.data.ptr,
          mujoco.mjtObj.mjOBJ_BODY,
          worlds.body_of(self.physics, block),
          twist,
          0,
      )
      speeds.append(np.linalg.norm(twist[3:]))
    return max(speeds)


@pytest.fixture(name='world')
def fixture_world():
  return _World()


# ---- Walking and looking -----------------------------------------------------


@pytest.mark.parametrize(
    ('commands', 'expected'),
    [
        ({'forward': 1.0}, (_SPEED, 0, 0)),
        ({'forward': -1.0}, (-_SPEED, 0, 0)),
        ({'forward': 0.5}, (_SPEED / 2, 0, 0)),
        ({'strafe': 1.0}, (0, _SPEED, 0)),
        ({'strafe': -0.5}, (0, -_SPEED / 2, 0)),
        ({'turn': 1.0}, (0, 0, _TURN_RATE)),
        ({'turn': -0.5}, (0, 0, -_TURN_RATE / 2)),
        ({}, (0, 0, 0)),
    ],
)
@pytest.mark.parametrize('heading', [0.0, 2.0])
def test_the_avatar_moves_as_fast_as_it_is_told(
    world, commands, expected, heading
):
  world.place(-1.0, 0.0, heading)
  world.act(50, **commands)
  np.testing.assert_allclose(world.velocity, expected, atol=0.1 * _SPEED)


@pytest.mark.parametrize('heading', [0.0, 2.0, -1.0])
def test_forward_and_left_are_the_avatars_own(world, heading):
  world.place(-1.0, 0.0, heading)
  ahead = np.array([np.cos(heading), np.sin(heading)])
  left = np.array([-ahead[1], ahead[0]])
  for command, direction in [('forward', ahead), ('strafe', left)]:
    world.place(-1.0, 0.0, heading)
    before = world.avatar.position(world.physics)
    world.act(50, **{command: 1.0})
    moved = world.avatar.position(world.physics) - before
    # A second of walking, less what it took to get up to speed.
    assert 0.8 < moved @ direction / (0.5 * _SPEED) <= 1.0
    assert np.linalg.norm(moved) == pytest.approx(moved @ direction, rel=1e-6)


def test_an_avatar_walks_a_curve(world):
  world.place(-2.0, 0.0)
  world.act(100, forward=0.5, turn=0.5)
  np.testing.assert_allclose(
      world.velocity, (_SPEED / 2, 0, _TURN_RATE / 2), atol=0.2
  )


def test_an_avatar_stops_when_it_is_told_nothing(world):
  world.place(-2.0, 0.0)
  world.act(50, forward=1.0, turn=1.0)
  world.act(50)
  np.testing.assert_allclose(world.velocity, 0.0, atol=1e-3)


def test_the_direction_is_that_of_the_angle(world):
  world.place(0.0, 0.0, 2.5)
  assert world.avatar.angle(world.physics) == 2.5
  np.testing.assert_allclose(
      world.avatar.direction(world.physics), [np.cos(2.5), np.sin(2.5)]
  )


def test_turning_left_turns_to_the_left(world):
  world.act(20, turn=1.0)
  assert world.avatar.direction(world.physics)[1] > 0.3


@pytest.mark.parametrize('way', [-1.0, 1.0])
def test_the_pitch_is_limited(world, way):
  world.act(300, look=way)
  pitch = float(world.avatar.pitch(world.physics)[0])
  assert way * pitch == pytest.approx(np.radians(60), rel=0.02)


def test_looking_up_raises_the_view(world):
  world.act(30, look=1.0)
  assert world.avatar.pitch(world.physics) > 0.3
  # A camera looks against its z axis.
  view = -np.array(world.physics.bind(world.avatar.camera).xmat)[[2, 5, 8]]
  assert view[2] == pytest.approx(
      np.sin(world.avatar.pitch(world.physics)[0]), abs=1e-6
  )
  assert view[0] > 0.0


def test_the_pitch_stays_where_it_was_left(world):
  world.act(30, look=1.0)
  world.act(30)
  before = world.avatar.pitch(world.physics)
  world.act(200)
  np.testing.assert_allclose(
      world.avatar.pitch(world.physics), before, atol=0.01
  )


def test_an_avatar_that_is_placed_is_at_rest(world):
  world.act(30, forward=1.0, turn=1.0)
  world.place(-1.0, 2.0, 1.0)
  np.testing.assert_array_equal(world.velocity, 0.0)
  np.testing.assert_array_equal(
      world.avatar.position(world.physics), [-1.0, 2.0]
  )
  assert world.avatar.angle(world.physics) == 1.0


@pytest.mark.parametrize(
    'quality',
    ['position', 'angle', 'direction', 'velocity', 'pitch', 'holding'],
)
def test_what_was_known_stays_what_it_was(world, quality):
  look = getattr(world.avatar, quality)
  known = look(world.physics)
  before = np.array(known)
  world.place(0.4, 0.0)
  world.act(40, forward=0.5, turn=0.3, look=1.0, grasp=1.0)
  now = look(world.physics)
  assert not np.allclose(now, before)
  np.testing.assert_array_equal(known, before)


def test_the_action_spec_names_what_an_action_is_made_of(world):
  spec = world.avatar.action_spec
  assert spec.shape == (6,)
  assert spec.name.split('\t') == list(avatars.ACTIONS)
  assert (spec.minimum == -1).all()
  assert (spec.maximum == 1).all()


def test_observables_have_the_shapes_that_they_say(world):
  observables = world.avatar.observables
  observables.enable_all()
  observables.egocentric_camera.enabled = False
  environment = composer.Environment(
      composer.NullTask(world.arena), random_state=0
  )
  observation = environment.reset().observation
  shapes = {
      name.rpartition('/')[2]: np.squeeze(value).shape
      for name, value in observation.items()
      if name.startswith('avatar/') and 'rays' not in name
  }
  assert shapes == {
      'velocity': (3,),
      'position': (2,),
      'heading': (2,),
      'pitch': (),
      'holding': (),
  }
  assert len(observables.proprioception) == len(shapes)


# ---- Pushing -----------------------------------------------------------------


@every_dof
def test_an_avatar_pushes_a_block(dof):
  world = _World(dof=dof)
  world.act(100, forward=1.0)
  assert world.block[0] > 1.3
  assert float(world.register.read(world.physics)) > 3.0


@every_dof
def test_a_block_that_nobody_pushes_comes_to_rest(dof):
  world = _World(dof=dof)
  world.act(60, forward=1.0)
  world.act(200)
  before = world.block
  world.act(100)
  np.testing.assert_allclose(world.block, before, atol=1e-3)


def test_only_free_blocks_leave_the_floor():
  heights = {}
  for dof in registers.DOFS:
    world = _World(dof=dof)
    world.grasp()
    heights[dof] = world.block[2]
  assert heights['free'] == pytest.approx(_GRIP_HEIGHT, abs=0.01)
  assert heights['planar'] < 0.11


def test_a_planar_block_does_not_touch_the_floor():
  # Its contacts would cost more than all the rest of it.
  world = _World(dof='planar')
  world.place(-2.0, 0.0)
  world.act(50)
  assert world.physics.data.ncon == 0


@every_dof
@pytest.mark.parametrize('seed', range(6))
def test_whatever_an_avatar_does_blocks_stay_in_the_room(dof, seed):
  # Campaign C30.
  world = _World(registers.TwoBlockRegister, dof=dof)
  random_state = np.random.RandomState(seed)
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


# ---- Carrying ----------------------------------------------------------------


def test_a_hand_takes_nothing_out_of_reach(world):
  world.place(1.0 - _HAND - 0.45, 0.0)
  world.act(10, grasp=1.0)
  assert not world.holding


@every_dof
def test_a_hand_takes_a_block_in_reach(dof):
  world = _World(dof=dof)
  world.place(1.0 - _HAND - 0.35, 0.0)
  world.act(10, grasp=1.0)
  assert world.holding


def test_a_hand_does_not_take_what_is_behind(world):
  world.place(1.0 - 0.45, 0.0, np.pi)
  world.act(10, grasp=1.0)
  assert not world.holding


@pytest.mark.parametrize('command', [0.0, 0.4, -1.0])
def test_a_hand_takes_nothing_unless_it_is_told_to(world, command):
  world.place(0.5, 0.0)
  world.act(10, grasp=command)
  assert not world.holding


@every_dof
@pytest.mark.parametrize(
    'commands',
    [{'forward': -0.7}, {'strafe': 0.7}, {'turn': 0.5}, {'forward': 0.7}],
)
def test_a_held_block_follows_the_hand(dof, commands):
  world = _World(dof=dof)
  world.grasp()
  world.act(100, **commands)
  world.act(50)
  assert world.holding
  np.testing.assert_allclose(world.block[:2], world.hand[:2], atol=0.02)


def test_a_free_block_is_lifted_while_it_is_held(world):
  world.grasp()
  world.act(100, forward=-0.5)
  assert world.block[2] == pytest.approx(_GRIP_HEIGHT, abs=0.01)


@every_dof
@pytest.mark.parametrize('command', [0.0, 0.4, 1.0, -0.4])
def test_a_hand_keeps_hold_until_it_is_told_otherwise(dof, command):
  world = _World(dof=dof)
  world.grasp()
  world.act(50, grasp=command)
  assert world.holding


@every_dof
@pytest.mark.parametrize(
    ('size', 'mass', 'keeps_hold'), [(0.06, 0.01, False), (0.2, 1.0, True)]
)
def test_a_block_that_is_stuck_stays_behind(dof, size, mass, keeps_hold):
  # The avatar can pass the end of the barrier, the block cannot.
  world = _World(
      barrier=[(0.8, 0.5), (2.5, 0.5)], dof=dof, block_size=size, mass=mass
  )
  world.grasp()
  for _ in range(10):
    world.act(10, strafe=1.0)
    assert world.block[1] < 0.4 - size / 2 + 0.03
  assert world.avatar.position(world.physics)[1] > 0.7
  # It swings round a usual block, and loses a light one.
  assert world.holding is keeps_hold


@every_dof
def test_a_hand_lets_go_when_it_is_told_to(dof):
  world = _World(dof=dof)
  world.grasp()
  world.act(50, grasp=-1.0)
  assert not world.holding
  before = world.block
  world.act(100, forward=-0.5)
  np.testing.assert_allclose(world.block[:2], before[:2], atol=0.02)


def test_what_is_let_go_falls(world):
  world.grasp()
  world.act(100, grasp=-1.0)
  assert world.block[2] == pytest.approx(0.1, abs=0.01)


@every_dof
def test_a_hand_takes_one_block_and_that_is_the_nearest(dof):
  world = _World(registers.TwoBlockRegister, dof=dof)
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
  world = _World(registers.BlockOrientationRegister, dof=dof)
  world.register.write(world.physics, 5.0)
  world.grasp()
  world.act(100, forward=-0.5)
  assert world.holding
  assert float(world.register.read(world.physics)) == pytest.approx(5, abs=0.3)


# ---- Throwing ----------------------------------------------------------------


@every_dof
@pytest.mark.parametrize('yaw', [0.0, 0.7])
@pytest.mark.parametrize('heading', [0.0, 2.0])
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


def test_a_free_block_flies(world):
  world.grasp()
  world.act(10, throw=1.0)
  assert world.block[2] > 0.3


@every_dof
def test_throwing_with_an_empty_hand_does_nothing(dof):
  world = _World(dof=dof)
  world.place(0.5, 0.0)
  twin = _World(dof=dof)
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
  target.attach_to(arena, (1.6, 0.0))
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
def test_a_hand_lets_go_of_what_is_written(dof):
  world = _World(dof=dof)
  world.grasp()
  world.act(50, forward=-0.5)
  world.register.write(world.physics, 4.0)
  assert not world.holding
  fastest = 0.0
  for _ in range(50):
    world.act(1)
    fastest = max(fastest, world.fastest)
  assert float(world.register.read(world.physics)) == pytest.approx(4, abs=1e-9)
  # What it had of its walk, and of settling on the floor.
  assert fastest < 1.1


@every_dof
def test_a_write_to_one_block_takes_no_other_out_of_the_hand(dof):
  world = _World(registers.TwoBlockRegister, dof=dof)
  world.place(0.4, -0.2)
  world.act(50, grasp=1.0)
  assert world.holding
  world.register.write(world.physics, 4.0)
  assert world.holding
  world.act(50, forward=-0.5)
  np.testing.assert_allclose(world.block[:2], world.hand[:2], atol=0.02)


def test_a_welded_block_cannot_be_held():
  world = _World(channel='welded')
  world.place(0.4, 0.0)
  world.act(20, grasp=1.0)
  assert not world.holding
  assert world.block[0] == 1.0


def _circle(middle, radius, poses=10):
  """Places on a circle, and a heading at each."""
  for angle in np.linspace(0.05, 2 * np.pi, poses, endpoint=False):
    yield middle + radius * np.array([np.cos(angle), np.sin(angle)]), angle


@every_dof
@pytest.mark.parametrize('overlap', np.linspace(0.1, 1.0, 10))
def test_a_block_that_is_written_into_the_avatar_kicks_nothing(dof, overlap):
  # Campaign C31.
  world = _World(registers.TwoBlockRegister, dof=dof)
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
  assert max(kicks) <= 2.0


@pytest.mark.parametrize('overlap', [0.1, 0.25, 0.5, 0.75, 0.9, 1.0])
@pytest.mark.parametrize(
    ('dof', 'other_dof'),
    list(itertools.product(registers.DOFS, registers.DOFS)),
)
def test_a_block_that_is_written_into_another_kicks_nothing(
    dof, other_dof, overlap
):
  # Campaign C31.
  world = _World(registers.TwoBlockRegister, dof=dof)
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
  assert max(kicks) <= 2.0


@every_dof
@pytest.mark.parametrize('overlap', [0.2, 0.5, 1.0])
def test_a_block_that_is_written_into_the_avatar_does_not_stay_there(
    dof, overlap
):
  world = _World(registers.TwoBlockRegister, dof=dof)
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
