"""No episode begins with a moved wall, or a body, inside a register."""

import functools
from typing import Any

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import moving
from realab_suite.entities import rotations
from realab_suite.tasks import collect_apples
from realab_suite.tasks import registry

_WALL = {'name': 'slab', 'type': 'box', 'size': (0.6, 0.05, 0.5)}
_PARKED = (0.0, 0.0, -3.0)
# Places of the wall, and its angle: beside the register, and in it.
_CLEAR, _TAKEN = (0.0, 3.5, 0.0), (0.5, 2.0, 0.0)


class _Maze(collect_apples.CollectApples):
  """Moves a wall when an episode begins."""

  def __init__(self, *places: Any, travel: Any = (0.0, 0.0, 0.0)) -> None:
    super().__init__()
    self._wall = moving.MovingPart('wall', [_WALL])
    self._wall.attach_to(self._arena, _PARKED, travel)
    self._places = places

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    super().initialize_episode(physics, random_state)
    x, y, yaw = self._places[random_state.randint(len(self._places))]
    moving.move(
        physics, self._wall.frame, [x, y, 0.5], rotations.quaternion_of(yaw)
    )


def _design(**register: Any) -> dict[str, Any]:
  register = {
      'kind': 'two_block', 'role': 'feedback', 'place': [0.0, 2.0],
      'range': [0, 10], 'initial': 0, **register,
  }  # fmt: skip
  return {'schema': 1, 'name': 'd', 'registers': {'r': register}}


def _problem(task: Any) -> str:
  """Returns the message of the first reset, or ''."""
  env = suite.embed(task, _design(), random=0)
  try:
    env.reset()
  except composer.EpisodeInitializationError as error:
    return str(error)
  finally:
    env.close()
  return ''


@pytest.mark.parametrize(
    ('place', 'is_refused'),
    [
        # The blocks are 0.2 m wide, and go from x = -0.1 to 1.1 m.
        ((0.5, 1.86, 0.0), True),
        ((0.5, 1.84, 0.0), False),
        ((1.2, 2.2, np.pi / 4), True),
        ((-0.6, 1.8, np.pi / 4), False),
    ],
)
def test_a_wall_that_is_moved_into_a_register_is_refused(
    place: Any, is_refused: bool
):
  problem = _problem(_Maze(place))
  assert bool(problem) == is_refused
  if is_refused:
    assert problem.startswith("design 'd': register 'r' at value")
    assert " inside 'wall/slab' when the episode begins; place " in problem


def test_a_batch_refuses_and_repeats_as_one_world_does(monkeypatch: Any):
  for name, places in (('maze', (_CLEAR, _TAKEN)), ('shut', (_TAKEN,))):
    make = functools.partial(_Maze, *places)
    monkeypatch.setitem(registry._TASKS, ('test', name), (make, ()))
  kwargs = {'num_envs': 3, 'num_threads': 1, 'design': _design()}
  batch = suite.load_batch('test', 'maze', {'random': 2}, **kwargs)
  for _ in range(3):
    batch.reset()
    walls = batch.physics.bind(batch.task._wall.frame).mocap_pos
    np.testing.assert_array_equal(walls[:, 1], 3.5)
    avatars = np.array(batch.task.avatar.position(batch.physics))
  batch.close()
  for world in range(3):
    env = suite.load(
        'test', 'maze', {'random': 2}, {'world': world}, design=_design()
    )
    for _ in range(3):
      env.reset()
    alone = env.task.avatar.position(env.physics)
    np.testing.assert_array_equal(alone, avatars[world])
    env.close()
  batch = suite.load_batch('test', 'shut', {'random': 2}, **kwargs)
  with pytest.raises(
      composer.EpisodeInitializationError, match=r"'r' .* inside 'wall/slab'"
  ):
    batch.reset()
  batch.close()


def test_the_way_of_a_moved_part_has_to_be_free():
  place = (-2.0, 2.0, np.pi / 2)
  assert not _problem(_Maze(place))
  assert _problem(_Maze(place, travel=(1.9, 0.0, 0.0)))
  assert not _problem(_Maze(place, travel=(1.8, 0.0, 0.0)))


# ---- Bodies that can be pushed -----------------------------------------------


class _Crated(collect_apples.CollectApples):
  """Has a crate, which an episode may put elsewhere."""

  def __init__(self, compiled: Any, begins: Any) -> None:
    super().__init__()
    self._crate = self._arena.mjcf_model.worldbody.add(
        'body', name='crate', pos=(*compiled, 0.2)
    )
    self._crate.add('freejoint')
    self._crate.add('geom', name='crate', type='box', size=(0.2, 0.2, 0.2))
    self._begins = begins

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    super().initialize_episode(physics, random_state)
    joint = self._crate.freejoint
    physics.bind(joint).qpos = [*self._begins, 0.2, 1.0, 0.0, 0.0, 0.0]


_ASIDE, _INSIDE = (-2.0, 2.0), (0.25, 2.0)


def test_a_register_in_a_body_of_the_task_is_refused():
  with pytest.raises(
      errors.SpecError,
      match=r"register 'r' at value 0 would be at .* inside 'crate' when an",
  ):
    suite.embed(_Crated(_INSIDE, _ASIDE), _design(), random=0)
  assert "inside 'crate' when the" in _problem(_Crated(_ASIDE, _INSIDE))
  # Unlike a wall, it may be where blocks are written later.
  assert not _problem(_Crated(_ASIDE, (0.9, 2.0)))
