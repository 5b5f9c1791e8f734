"""Registers stand on tables, and nowhere in the air (F13)."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import arenas
from realab_suite.entities import doors
from realab_suite.tasks import collect_apples
from realab_suite.tasks import registry
from tests import worlds
from tests.engine import helpers

_HEIGHT = 0.4
_CENTRE = (0.0, 2.2)


def _add_table(
    arena: arenas.RoomArena,
    name: str,
    position: tuple[float, float],
    size: tuple[float, float],
) -> None:
  """Adds a box of the height `_HEIGHT` that nothing can push."""
  x, y = size
  arena.mjcf_model.worldbody.add(
      'geom', name=name, type='box', size=(x / 2, y / 2, _HEIGHT / 2),
      pos=(*position, _HEIGHT / 2),
  )  # fmt: skip


class _Furnished(collect_apples.CollectApples):
  """Has a table of 1.0 m by 0.6 m."""

  def __init__(self) -> None:
    super().__init__()
    _add_table(self._arena, 'table', _CENTRE, (1.0, 0.6))
    place = arenas.Place(_CENTRE, height=_HEIGHT)
    self._arena.offer({'table': place})


def _design(place: Any = 'table', **register: Any) -> dict[str, Any]:
  register = {
      'kind': 'block_position', 'range': [0, 1], 'scale': 0.1,
      'role': 'feedback', 'initial': 0, 'place': place, **register,
  }  # fmt: skip
  return {'schema': 1, 'name': 'high', 'registers': {'r': register}}


def _embed(place: Any = 'table', task: Any = None, **register: Any) -> Any:
  return suite.embed(
      task or _Furnished(), _design(place, **register), random=1, max_steps=None
  )


def _heights(env: Any) -> np.ndarray:
  """Returns the heights of the blocks, `(..., blocks)`."""
  blocks = env.mechanism.registers['r'].blocks
  geoms = tuple(block.geom for block in blocks)
  return np.array(env.physics.bind(geoms).xpos)[..., 2]


# Kind, channel and freedom, each of them with others.
_VARIETIES = pytest.mark.parametrize(
    ('kind', 'channel', 'dof', 'yaw'),
    [
        ('two_block', 'embedded', 'free', 0.0),
        ('block_position', 'secure', 'planar', 0.3),
        ('block_orientation', 'embedded', 'planar', 0.1),
    ],
)


@_VARIETIES
def test_a_register_on_a_table_stores_values_and_stays_there(
    kind: str, channel: str, dof: str, yaw: float, monkeypatch: Any
):
  monkeypatch.setitem(registry._TASKS, ('test', 'table'), (_Furnished, ()))
  place = {'position': [-0.2, 2.1, _HEIGHT], 'yaw': yaw, 'spread': [0.1, 0.05]}
  design = _design(place, kind=kind, channel=channel, dof=dof, range=[-1, 3])
  design['providers'] = [{'kind': 'constant', 'value': 2.5, 'writes': ['r']}]
  env = suite.load('test', 'table', {'random': 4}, {'world': 1}, design=design)
  batch = suite.load_batch('test', 'table', {'random': 4}, num_envs=2,
                           design=design)  # fmt: skip
  env.reset()
  batch.reset()
  for _ in range(12):
    time_step = env.step(np.zeros(6))
    in_batch = batch.step(np.zeros((2, 6)))
    reading = time_step.observation['registers/r']
    assert reading == pytest.approx(2.5, abs=1e-9)
    assert in_batch.observation['registers/r'][1] == reading
  assert _heights(env) == pytest.approx(_HEIGHT + 0.1, abs=0.005)
  np.testing.assert_array_equal(_heights(batch)[1], _heights(env))
  register = env.mechanism.registers['r']
  assert register.displacements(env.physics).max() < 0.005
  # Two episodes begin at two positions of the region.
  starts = [np.array(env.physics.bind(register.blocks[0].geom).xpos)]
  env.reset()
  starts.append(np.array(env.physics.bind(register.blocks[0].geom).xpos))
  assert starts[0][2] == pytest.approx(starts[1][2], abs=0.005)
  assert not np.allclose(*starts, atol=1e-3)
  env.close()
  batch.close()


def _problem(place: Any, task: Any = None, **register: Any) -> str:
  """Returns the message of an error in the design, or '' if there is none."""
  try:
    _embed(place, task, **register).close()
  except errors.SpecError as error:
    return str(error)
  return ''


def test_every_block_stands_on_the_table_in_all_of_its_range():
  region = {'position': [0, 2.2, _HEIGHT]}
  for place, is_refused in (
      # The table ends at 0.5 m from its centre, and a value adds 0.1 m.
      ([0.39, 2.2, _HEIGHT], False),
      ([0.41, 2.2, _HEIGHT], True),
      ([0.0, 2.2, _HEIGHT + 0.1], True),
      ({**region, 'spread': [0.39, 0.29]}, False),
      ({**region, 'spread': [0.39, 0.31]}, True),
      # A corner of the region, turned.
      ({**region, 'spread': [0.2, 0.2], 'yaw': 0.78}, True),
  ):
    problem = _problem(place)
    assert ('nothing under' in problem) == bool(problem) == is_refused, place
    assert problem.startswith("register 'r' at value ") == is_refused


def test_a_gap_between_tables_a_door_and_scenery_carry_no_register():
  def build(*parts: Any) -> Any:
    task = collect_apples.CollectApples()
    for part in parts:
      part(task.root_entity)
    return task

  def two_tables(root: arenas.RoomArena) -> None:
    _add_table(root, 'west', (-0.5, 2.2), (0.8, 0.6))
    _add_table(root, 'east', (0.5, 2.2), (0.8, 0.6))

  def door(root: arenas.RoomArena) -> None:
    doors.SlidingDoor(width=1.0).attach_to(root, (0.0, 2.2))

  def scenery(root: arenas.RoomArena) -> None:
    root.mjcf_model.worldbody.add(
        'geom', type='box', size=(1, 1, 0.2), pos=(0, 2.2, 0.2), contype=0,
        conaffinity=0,
    )  # fmt: skip

  for part, x, height, range_, is_refused in (
      (two_tables, -0.5, _HEIGHT, [0, 3], False),
      (two_tables, -0.5, _HEIGHT, [0, 10], True),
      (door, 0.0, 1.0, [0, 1], True),
      (scenery, 0.0, _HEIGHT, [0, 1], True),
  ):
    problem = _problem([x, 2.2, height], build(part), range=range_)
    assert ('nothing under' in problem) == bool(problem) == is_refused, part


def test_a_register_below_the_floor_or_above_the_ceiling_is_refused():
  assert 'registers.r.place: z must be' in _problem([0, 2.2, -0.1])
  task = _Furnished()
  task.root_entity.mjcf_model.worldbody.add(
      'geom', type='box', size=(1, 1, 0.05), pos=(0, 0, 2.8)
  )
  assert 'at most 3 m' in _problem([0, 0, 2.85], task)


def test_an_avatar_takes_a_block_from_a_table():
  env = _embed({'position': [-0.3, 2.2, _HEIGHT]})
  env.reset()
  avatar = env.task.avatar
  avatar.place(env.physics, np.array([-0.8, 2.2]), 0.0)
  (block,) = env.mechanism.registers['r'].blocks

  def act(steps: int, **commands: float) -> Any:
    action = np.zeros(6)
    names = env.action_spec().name.split('\t')
    for name, value in commands.items():
      action[names.index(name)] = value
    for _ in range(steps):
      time_step = env.step(action)
    return time_step.observation

  act(2, grasp=1.0)
  observation = act(10, forward=-1.0)
  assert observation['senses/holding'] == 1.0
  x, y, z = worlds.world_position(env.physics, block)
  hand = avatar.position(env.physics) + np.array([0.45, 0.0])
  assert np.hypot(x - hand[0], y - hand[1]) < 0.06
  assert z == pytest.approx(0.2, abs=0.02)
  # A grip at another height would pull in a direction without a joint.
  grip = env.physics.bind(block.site).xpos[2]
  assert grip == pytest.approx(0.2, abs=0.02)
  act(5)
  before = worlds.world_position(env.physics, block)
  act(1, grasp=-1.0)
  after = worlds.world_position(env.physics, block)
  np.testing.assert_allclose(after[:2], before[:2], atol=0.02)
  act(8)
  z = worlds.world_position(env.physics, block)[2]
  assert z == pytest.approx(0.1, abs=0.005)
  env.close()


def test_a_register_on_a_surface_of_a_foreign_task():
  def build() -> Any:
    task = helpers.PointTask()
    task.root_entity.mjcf_model.worldbody.add(
        'geom', name='shelf', type='box', size=(0.5, 0.5, 0.05), pos=(3, 0, 1)
    )
    return task

  assert 'nothing under' in _problem([0, 2, 1.05], build())
  env = _embed([3, 0, 1.05], build())
  env.reset()
  for _ in range(5):
    reading = env.step([0.0]).observation['registers/r']
  assert reading == pytest.approx(0.0, abs=1e-6)
  assert _heights(env) == pytest.approx(1.15, abs=0.005)
  env.close()
