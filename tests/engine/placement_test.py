"""Registers are refused where something stands that nothing can push."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import moving
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds
from realab_suite.tasks import collect_apples
from tests.engine import helpers

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
        ('block_position', 'secure', 'planar', 0.7),
        ('block_orientation', 'embedded', 'planar', 0.7),
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


# ---- Each other's way --------------------------------------------------------


def _two(first, second):
  return _named(a=_register(**first), b=_register(**second))


@pytest.mark.parametrize(
    ('second', 'is_refused'),
    [
        # Beside the path, inside of the rectangle about it, and across it.
        ({'place': [0.6, 2.9], 'range': [0, 1]}, False),
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


# ---- Kinds of one's own, and worlds of anybody's -----------------------------


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


class _OfOneWorld(_Rod):
  """Cannot compute with the values of several worlds."""

  def _places(self, physics, value):
    float(value[0])
    return super()._places(physics, value)


def test_a_kind_that_serves_one_world_alone_is_refused():
  with helpers.registered(
      register_kinds.REGISTER_KINDS, 'test_rod', _OfOneWorld
  ):
    with pytest.raises(
        errors.SpecError,
        match=r"register 'value': _OfOneWorld cannot be posed at several values"
        r' at once: .*; its methods must accept values `\(\.\.\.\)`',
    ):
      _embed(_room_with(), [0.0, 2.0], kind='test_rod', range=[-1, 4])


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
}  # fmt: skip


@pytest.mark.parametrize(
    ('geom', 'is_refused'), _FOREIGN.values(), ids=list(_FOREIGN)
)
def test_obstacles_of_foreign_worlds_are_checked(geom, is_refused):
  place = {'position': [0.0, 0.0], 'spread': [0.5, 0.5]}
  assert is_refused == _is_refused(_foreign(**geom), place)
