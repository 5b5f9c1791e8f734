"""Cameras show the blocks of a meter unless they are hidden.

The meter goes through its range before every camera, in colour, depth and
segmentation. Hidden blocks change no pixel, also not by shadows or reflections.
"""

from collections.abc import Callable
import contextlib
from typing import Any

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import environment
from tests import examples
from tests.leaks import secrets

_SIZE = 64
_HIDDEN_GROUP = 4
_MODES: dict[str, dict[str, bool]] = {
    'colour': {},
    'depth': {'depth': True},
    'segmentation': {'segmentation': True},
}


def _stay(env: environment.Environment, geoms: list[int]) -> None:
  """Leaves meters visible, as they are in this package."""


def _fade(env: environment.Environment, geoms: list[int]) -> None:
  env.physics.model.geom_rgba[geoms, 3] = 0.0
  env.physics.model.geom_matid[geoms] = -1


def _regroup(env: environment.Environment, geoms: list[int]) -> None:
  env.physics.model.geom_group[geoms] = _HIDDEN_GROUP


_HIDING: dict[str, Callable[[environment.Environment, list[int]], None]] = {
    'visible': _stay,
    'alpha 0': _fade,
    'group 4': _regroup,
}


def _load(domain: str, seed: int, hiding: str) -> environment.Environment:
  """Returns a world with a meter before the avatar, hidden in some way."""
  env = suite.load(
      domain,
      suite.TASKS_BY_DOMAIN[domain][0],
      {'random': seed, 'camera_size': (_SIZE, _SIZE)},
      design=secrets.UNREAD_METER,
  )
  model = env.physics.model
  # What reflects, and what casts shadows, would show more.
  model.mat_reflectance[:] = 0.5
  model.light_castshadow[:] = 1
  model.vis.quality.shadowsize = 1024  # Many for pictures of 64 x 64 pixels.
  score = env.mechanism.registers['score']
  geoms = [env.physics.bind(block.geom).element_id for block in score.blocks]
  _HIDING[hiding](env, geoms)
  env.reset()
  # Before the meter, so that it would be seen.
  x, y, _ = env.physics.bind(score.blocks[0].geom).xpos
  env.task.avatar.place(env.physics, np.array([x - 0.9, y]), 0.0)
  return env


def _changes(
    env: environment.Environment, draw: Callable[[], Any], values: int = 2
) -> int:
  """Returns the most pixels that change with the value of the meter."""
  score = env.mechanism.registers['score']
  spec = score.value_spec
  pictures = []
  for value in np.linspace(spec.minimum, spec.maximum, values):
    score.write(env.physics, value)
    env.physics.forward()
    pictures.append(np.array(draw()).reshape(_SIZE, _SIZE, -1))
  return max(
      int((picture != pictures[0]).any(axis=-1).sum())
      for picture in pictures[1:]
  )


@pytest.mark.camera
@pytest.mark.parametrize('hiding', _HIDING)
@pytest.mark.parametrize('domain', suite.TASKS_BY_DOMAIN)
def test_a_camera_shows_a_meter_unless_it_is_hidden(domain: str, hiding: str):
  for seed in range(examples.settings(1).max_examples // 10 + 1):
    with contextlib.closing(_load(domain, seed, hiding)) as env:
      _check(env, hiding == 'visible')


def _check(env: environment.Environment, is_visible: bool) -> None:
  found = env.task.root_entity.mjcf_model.find_all('camera')
  names = [camera.full_identifier for camera in found]
  for options in _MODES.values():

    def draw(name: str, options: dict[str, bool] = options) -> np.ndarray:
      return env.physics.render(_SIZE, _SIZE, camera_id=name, **options)

    most = max(_changes(env, lambda name=name: draw(name)) for name in names)
    assert (most > 0) == is_visible, options

  def draw_for_agent() -> np.ndarray:
    env.physics.forward()
    return env.task.senses(env.physics, ['camera'])['camera']

  assert (_changes(env, draw_for_agent) > 0) == is_visible
