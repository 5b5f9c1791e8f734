"""Registers are refused where something stands that nothing can push."""

import hypothesis
import mujoco
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import clearance
from realab_suite.entities import arenas
from realab_suite.entities import moving
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds
from realab_suite.tasks import collect_apples
from tests import examples
from tests.engine import helpers
from tests.engine import obstacles

_WORLD = 'collect_apples', 'standard'


def _register(place, **options):
  options = {'kind': 'block_position', 'range': [-1, 1], **options}
  return {'role': 'feedback', 'initial': 0, 'place': place, **options}


def _design(place, **register):
  return _named(value=_register(place, **register))


def _named(**named):
  return {'schema': 1, 'name': 'placed', 'registers': named}


@pytest.mark.parametrize(
    ('place', 'obstacle', 'channel'),
    [([0, 1.9], 'pad_post', 'embedded'), ([0, 4.1], 'door_leaf', 'secure')],
)
def test_a_register_in_a_post_or_a_door_is_refused(place, obstacle, channel):
  with pytest.raises(errors.SpecError, match=f'inside .*{obstacle}'):
    suite.load(
        'unlock_door', 'standard', design=_design(place, channel=channel)
    )


def test_a_register_where_the_avatar_begins_is_refused():
  with pytest.raises(errors.SpecError, match=r"'value'.* where the avatar"):
    suite.load('unlock_door', 'standard', design=_design([0.0, -0.8]))


# ---- Every place of a region -------------------------------------------------


def _room_with(*parts):
  """Returns a task whose room has more in it, for blocks of any size."""
  task = collect_apples.CollectApples(physics_timestep=0.01)
  for part in parts:
    part(task.root_entity)
  return task


def _barrier(start, end):
  return lambda root: root.add_barrier('barrier', start, end)


def _post(position, radius=0.15):
  def add(root):
    root.mjcf_model.worldbody.add(
        'geom', name='post', type='cylinder', size=(radius, 0.5),
        pos=(*position, 0.5),
    )  # fmt: skip

  return add


def _embed(task, place, **register):
  return suite.embed(task, _design(place, **register), random=0)


def _problem(load, *args, **kwargs):
  """Returns the message of an error in the design, or '' if there is none."""
  try:
    load(*args, **kwargs).close()
  except errors.SpecError as error:
    return str(error)
  return ''


def _is_refused(task, place, **register):
  return ' inside ' in _problem(_embed, task, place, **register)


# Kind, channel, freedom and yaw, each of them with others.
_VARIETIES = pytest.mark.parametrize(
    ('kind', 'channel', 'dof', 'yaw'),
    [
        ('two_block', 'embedded', 'free', 0.0),
        ('two_block', 'secure', 'planar', 0.7),
        ('block_position', 'embedded', 'planar', 0.7),
        ('block_position', 'secure', 'free', 0.0),
        ('block_orientation', 'embedded', 'free', 0.7),
        ('block_orientation', 'secure', 'planar', 0.0),
    ],
)


@_VARIETIES
def test_a_barrier_across_the_middle_of_a_region_is_found(
    kind, channel, dof, yaw
):
  place = {'position': [0.0, 2.0], 'spread': [1.0, 1.0], 'yaw': yaw}
  across = _barrier((-0.5, 2.0), (0.5, 2.0))
  register = {'kind': kind, 'channel': channel, 'dof': dof, 'range': [0, 1]}
  assert not _is_refused(_room_with(), place, **register)
  assert _is_refused(_room_with(across), place, **register)


def test_a_thin_post_in_a_long_path_is_found():
  # A block that is written at 64 values, 0.108 m apart, misses it.
  post = _post((-0.108, 2.0), radius=0.02)
  long = {'range': [0, 68], 'block_size': 0.06}
  assert not _is_refused(_room_with(), [-3.4, 2.0], **long)
  assert _is_refused(_room_with(post), [-3.4, 2.0], **long)


@pytest.mark.parametrize(
    ('yaw', 'is_refused'), [(0.0, False), (np.pi / 2, True), (0.75, True)]
)
def test_a_region_turns_with_its_place(yaw, is_refused):
  place = {'position': [0.0, 2.0], 'spread': [1.5, 0.0], 'yaw': yaw}
  # To the north-east, and to the north.
  task = _room_with(_post((0.8, 2.75)), _barrier((-0.5, 3.0), (0.0, 3.0)))
  assert _is_refused(task, place, range=[0, 1]) == is_refused


@pytest.mark.parametrize(
    ('travel', 'place', 'is_refused'),
    [
        ((1.2, 1.2, 0), [2.0, 2.0], True),
        ((-1.2, 1.2, 0), [2.0, 2.0], False),
        # Beside the path, but inside of the rectangle about it.
        ((1.2, 1.2, 0), [1.1, 2.1], False),
    ],
)
def test_the_path_of_a_moving_part_is_an_obstacle(travel, place, is_refused):
  ball = {'type': 'sphere', 'size': (0.1,)}

  def part(root):
    moving.MovingPart('part', [ball]).attach_to(root, (1.0, 1.0, 0.1), travel)

  task = _room_with(part)
  assert _is_refused(task, place, range=[0, 1]) == is_refused


# Differential: what the loader says, and what episodes do.


@examples.settings(15)
@hypothesis.given(obstacles.rooms)
def test_accepted_rooms_have_no_overlap(room):
  try:
    built = obstacles.build(*room)
  except errors.SpecError as error:
    hypothesis.event(f'refused: {str(error).split()[0]}')
    return
  hypothesis.event('accepted')
  assert built.deepest(100) <= clearance.TOLERANCE
  assert built.deepest_start(5) <= clearance.TOLERANCE
  built.env.close()


def test_rejected_rooms_have_an_overlap(monkeypatch):
  # Found at random: a barrier, a yawed wall, a post, a door, two registers.
  wide = {
      'kind': 'block_position',
      'role': 'feedback',
      'initial': 0,
      'range': [0.0, 1.0],
  }
  turning = {**wide, 'kind': 'block_orientation', 'scale': 1.5}
  region = {'position': [0.0, 2.0], 'spread': [0.6, 0.4], 'yaw': 0.3}
  box = obstacles.Obstacle('box', (0.4, 0.05, 0.3), (0.9, 2.3), 0.8, None)
  post = obstacles.Obstacle('cylinder', (0.1, 0.3, 0.3), (0.3, 2.6), 0.0, None)
  door = obstacles.Obstacle('box', (0.1, 0.1, 0.3), (2, 1), 0.0, (-1.5, 0.6))
  other = {**wide, 'place': {'position': [0.7, 2.3], 'yaw': 2.0}}
  for things, named in [
      ([box], [{**wide, 'place': region}]),
      ([post], [{**turning, 'place': region}]),
      ([door], [{**wide, 'place': region}]),
      ([box], [{**turning, 'place': region}]),
      ([], [{**wide, 'place': region}, other]),
      ([], [{**turning, 'place': region}, other]),
  ]:
    with pytest.raises(errors.SpecError, match=r"inside|each other's way"):
      obstacles.build(things, named)
    room = obstacles.build_anyway(monkeypatch, things, named)
    assert any(room.deepest(50, seed) > 0.0 for seed in range(40))
    room.env.close()


# ---- Places that a world offers ----------------------------------------------


def _poses(env, num_episodes=4):
  """Returns where the blocks stand when episodes begin."""
  poses = []
  for _ in range(num_episodes):
    env.reset()
    mujoco.mj_kinematics(env.physics.model.ptr, env.physics.data.ptr)
    for register in env.mechanism.registers.values():
      for block in register.blocks:
        geom = env.physics.bind(block.geom).element_id
        poses.append(env.physics.data.geom_xpos[geom].copy())
        poses.append(env.physics.data.geom_xmat[geom].copy())
  return np.concatenate(poses)


@_VARIETIES
def test_a_named_place_equals_its_coordinates(kind, channel, dof, yaw):
  register = {'kind': kind, 'channel': channel, 'dof': dof, 'range': [0, 1]}
  offered = arenas.Place((0.5, 2.0), yaw, (0.3, 0.4))

  def offer(root):
    root.offer({'spot': offered})

  named = _embed(_room_with(offer), 'spot', **register)
  place = {'position': [0.5, 2.0], 'yaw': yaw, 'spread': [0.3, 0.4]}
  numbered = _embed(_room_with(), place, **register)
  poses = _poses(named)
  np.testing.assert_array_equal(poses, _poses(numbered))
  assert len(np.unique(np.split(poses, 4), axis=0)) > 1


# ---- Each other's way --------------------------------------------------------


def _two(first, second):
  return _named(a=_register(**first), b=_register(**second))


@pytest.mark.parametrize(
    ('second', 'is_refused'),
    [
        # Beside the path, inside of the rectangle about it, and across it.
        ({'place': [0.6, 2.9], 'range': [0, 1]}, False),
        ({'place': [0.8, 1.9], 'range': [0, 1]}, False),
        ({'place': [0.7, 2.5], 'range': [0, 1]}, True),
        (
            {'place': {'position': [1.2, 1.8], 'yaw': 2.4}, 'range': [0, 9]},
            True,
        ),
        (
            {'place': {'position': [0.9, 2], 'spread': [0.3, 0.3]}},
            True,
        ),
    ],
)
def test_only_registers_that_can_meet_are_rejected(second, is_refused):
  diagonal = {
      'place': {'position': [0.0, 1.7], 'yaw': np.pi / 4},
      'range': [0, 15],
  }
  for design in (_two(diagonal, second), _two(second, diagonal)):
    problem = _problem(suite.load, *_WORLD, design=design)
    assert ("'a' and 'b' would be in each other's way" in problem) == is_refused


def test_registers_may_touch():
  side_by_side = _two(
      {'place': [0.0, 2.0], 'range': [0, 5]},
      {'place': [0.0, 2.2], 'range': [0, 5]},
  )
  assert not _problem(
      suite.load, 'collect_apples', 'standard', design=side_by_side
  )


# ---- Where the avatar begins -------------------------------------------------


def _begins_in_a_block(place, **register):
  design = _design(place, **register)
  problem = _problem(suite.load, *_WORLD, design=design)
  return 'where the avatar begins' in problem


@pytest.mark.parametrize(
    ('gap', 'is_in_the_way'), [(0.17, True), (0.18, False)]
)
def test_the_avatar_is_round_where_it_begins(gap, is_in_the_way):
  # It begins within 0.4 m of (0, -0.8), and has a radius of 0.25 m.
  place = [0.4 + gap + 0.1, -0.4 + gap + 0.1]
  assert _begins_in_a_block(place, range=[0, 1]) == is_in_the_way


def test_the_avatar_begins_beside_the_initial_value_alone():
  place, wide = [-1.8, -0.8], {'range': [0, 20]}
  assert not _begins_in_a_block(place, initial=0, **wide)
  assert _begins_in_a_block(place, initial=15, **wide)


# ---- Kinds of one's own, and worlds of anybody's -----------------------------


class _Circling(registers.Register):
  """Goes round in a circle of 0.5 m, a turn for every 6.28 units."""

  def _build_blocks(self):
    self._block = self._add_block('block', 'offset_block', (0.0, 0.0))
    return [self._block]

  def _places(self, physics, value):
    position = np.array(self._origin(physics))
    position[..., 0] += 0.5 * np.cos(value)
    position[..., 1] += 0.5 * np.sin(value)
    return [position]

  def _put(self, physics, value, where=None):
    [position] = self._places(physics, value)
    self._block.put(physics, position, heading=value, where=where)

  def _read_blocks(self, physics):
    return self._block.heading(physics)


@pytest.mark.parametrize(
    ('range_', 'post', 'is_refused'),
    [
        ([0, 2 * np.pi], (0.0, 2.0), False),
        ([0, 2 * np.pi], (-0.35, 2.36), True),
        ([0, 2 * np.pi], (0.5, 2.7), False),
        ([-1.5, 1.5], (-0.35, 2.36), False),
        ([0, 40 * np.pi], (-0.35, 2.36), True),
    ],
)
def test_a_block_that_goes_in_circles_is_followed(range_, post, is_refused):
  with helpers.registered(
      register_kinds.REGISTER_KINDS, 'test_circling', _Circling
  ):
    task = _room_with(_post(post))
    assert is_refused == _is_refused(
        task, [0.0, 2.0], kind='test_circling', range=list(range_)
    )


class _Rod(registers.Register):
  """Has beads that depend on both of its ports."""

  PORTS = 'middle', 'gap'

  def _build_blocks(self):
    return [
        self._add_block(name, 'offset_block', (0.0, y))
        for name, y in (('left', 0.0), ('right', 0.25))
    ]

  def _places(self, physics, value):
    places = []
    for y, sign in ((0.0, -1.0), (0.25, 1.0)):
      place = np.array(self._origin(physics))
      along = value[..., 0] + sign * value[..., 1] / 2
      place[..., 0] += self._scale * along
      place[..., 1] += y
      places.append(place)
    return places

  def _read_blocks(self, physics):
    start = self._origin(physics)[..., 0]
    left, right = (block.along(physics) - start for block in self._blocks)
    both = [(left + right) / 2, right - left]
    return np.stack(both, axis=-1) / self._scale


@pytest.mark.parametrize(('x', 'is_refused'), [(-0.4, True), (-0.8, False)])
def test_ports_are_posed_with_unequal_values(x, is_refused):
  # The left bead is 0.3 m beside the start if its ports have -1 and 4.
  with helpers.registered(register_kinds.REGISTER_KINDS, 'test_rod', _Rod):
    task = _room_with(_post((x, 2.0)))
    assert is_refused == _is_refused(
        task, [0.0, 2.0], kind='test_rod', range=[-1, 4]
    )


def _foreign(**geom):
  task = helpers.PointTask()
  task.root_entity.mjcf_model.worldbody.add('geom', name='thing', **geom)
  return task


_PLANE = {'type': 'plane', 'size': (9, 9, 1)}
_FOREIGN = {
    'a floor': (_PLANE, False),
    'a floor above': ({**_PLANE, 'pos': (0, 0, 0.1)}, False),
    # Corridors of dm_control put them into place when an episode begins.
    'a plane that stands': ({**_PLANE, 'zaxis': (1, 0, 0)}, False),
    'a ramp': (
        {'type': 'box', 'size': (1, 1, 0.1), 'quat': (0.9, 0.2, 0, 0)}, True,
    ),
    'scenery': (
        {'type': 'box', 'size': (1, 1, 1), 'contype': 0, 'conaffinity': 0},
        False,
    ),
    'a ball overhead': (
        {'type': 'sphere', 'size': (1,), 'pos': (0, 0, 3)}, False,
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ('geom', 'is_refused'), _FOREIGN.values(), ids=list(_FOREIGN)
)
def test_obstacles_of_foreign_worlds_are_checked(geom, is_refused):
  place = {'position': [0.0, 0.0], 'spread': [0.5, 0.5]}
  assert is_refused == _is_refused(_foreign(**geom), place)


def test_children_of_a_moving_part_are_obstacles():
  def part(root):
    hung = moving.MovingPart('part', [{'type': 'sphere', 'size': (0.1,)}])
    body = hung.mjcf_model.worldbody.add('body', pos=(-2, 2, 0))
    body.add('geom', type='box', size=(0.1, 0.1, 0.1))
    hung.attach_to(root, (2.0, 0.0, 0.1))

  assert _is_refused(_room_with(part), [0.0, 2.0], range=[0, 1])


@pytest.mark.parametrize(('low', 'high'), [(-0.7, 0.4), (0.3, 1.1)])
def test_no_value_beyond_the_range_is_tried(low, high):
  register = {'range': [low, high], 'initial': high}
  env = _embed(_room_with(), [0.0, 2.0], **register)
  [reading] = [
      value
      for name, value in env.reset().observation.items()
      if name.startswith('registers/')
  ]
  assert reading == pytest.approx(high)
