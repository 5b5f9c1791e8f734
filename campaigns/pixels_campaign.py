"""Campaign C14: what a camera shows of a meter that nobody is to see.

Run from the root of the repository with a renderer, about three minutes:

    MUJOCO_GL=egl python -m campaigns.pixels_campaign

Each meter goes through its range before every camera, in colour, depth and
segmentation. In this package meters are things in the world, which cameras
see: that is the control. Hidden ones, by alpha or by their group, change no
pixel, their shadows and reflections included.

Prints `C14 figure target verdict seed`. Arguments are the scale and the seed.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import environment
from tests.leaks import secrets

_SIZE = 64
_VALUES = 9
_SEEDS = 4
_HIDDEN_GROUP = 4
MODES: dict[str, dict[str, bool]] = {
    'colour': {},
    'depth': {'depth': True},
    'segmentation': {'segmentation': True},
}


def _stay(env: environment.Environment, geoms: list[int]) -> None:
  """Is what meters do in this package: they can be seen."""


def _fade(env: environment.Environment, geoms: list[int]) -> None:
  env.physics.model.geom_rgba[geoms, 3] = 0.0
  env.physics.model.geom_matid[geoms] = -1


def _regroup(env: environment.Environment, geoms: list[int]) -> None:
  env.physics.model.geom_group[geoms] = _HIDDEN_GROUP


HIDING: dict[str, Callable[[environment.Environment, list[int]], None]] = {
    'visible': _stay,
    'alpha 0': _fade,
    'group 4': _regroup,
}


class Seen(NamedTuple):
  """How many pixels a meter changes, at most.

  Attributes:
    hiding: A key of `HIDING`.
    mode: A key of `MODES`, or `agent` for what an agent's frames are drawn by.
    num_pixels: In the picture with the largest change.
    num_pictures: How many pictures were compared.
  """

  hiding: str
  mode: str
  num_pixels: int
  num_pictures: int


def load(domain: str, seed: int, hiding: str) -> environment.Environment:
  """Returns a world whose meters are hidden in some way."""
  env = suite.load(
      domain,
      'standard',
      {'random': seed, 'camera_size': (_SIZE, _SIZE)},
      design=secrets.UNREAD_METER,
  )
  model = env.physics.model
  # What reflects, and what casts shadows, would show more.
  model.mat_reflectance[:] = 0.5
  model.light_castshadow[:] = 1
  score = env.mechanism.registers['score']
  geoms = [env.physics.bind(block.geom).element_id for block in score.blocks]
  HIDING[hiding](env, geoms)
  env.reset()
  # Before the meter, so that it would be seen.
  x, y, _ = env.physics.bind(score.blocks[0].geom).xpos
  env.task.avatar.place(env.physics, np.array([x - 0.9, y]), 0.0)
  return env


def look(domain: str, seed: int, hiding: str, values: int) -> Iterator[Seen]:
  """Yields what changes before cameras while a meter goes through its range."""
  env = load(domain, seed, hiding)
  cameras = env.task.root_entity.mjcf_model.find_all('camera')
  names = [camera.full_identifier for camera in cameras]
  for mode, options in MODES.items():
    most = 0
    for name in names:

      def draw(
          name: str = name, options: dict[str, bool] = options
      ) -> np.ndarray:
        return env.physics.render(_SIZE, _SIZE, camera_id=name, **options)

      most = max(most, *_changes(env, draw, values))
    yield Seen(hiding, mode, most, len(names) * values)

  def draw_for_agent() -> np.ndarray:
    env.physics.forward()
    return env.task.senses(env.physics)['camera']

  most = max(_changes(env, draw_for_agent, values))
  yield Seen(hiding, 'agent', most, values)
  env.close()


def _changes(
    env: environment.Environment, draw: Callable[[], Any], values: int
) -> list[int]:
  """Returns how many pixels change with each value of the meter."""
  score = env.mechanism.registers['score']
  spec = score.value_spec
  pictures = []
  for value in np.linspace(spec.minimum, spec.maximum, values):
    score.write(env.physics, value)
    env.physics.forward()
    pictures.append(np.array(draw()).reshape(_SIZE, _SIZE, -1))
  return [
      int((picture != pictures[0]).any(axis=-1).sum())
      for picture in pictures[1:]
  ]


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C14', seed)
  most: dict[tuple[str, str], int] = {}
  pictures = 0
  for domain in suite.TASKS_BY_DOMAIN:
    for shift in range(max(1, round(scale * _SEEDS))):
      for hiding in HIDING:
        values = max(2, round(scale * _VALUES))
        for seen in look(domain, seed + shift, hiding, values):
          key = seen.hiding, seen.mode
          most[key] = max(most.get(key, 0), seen.num_pixels)
          pictures += seen.num_pictures
  for (hiding, mode), number in most.items():
    figure = f'pixels changed by a meter, {hiding}, {mode}'
    if hiding == 'visible':
      lines.at_least(f'{figure} (control)', number, 1)
    else:
      lines.at_most(figure, number, 0)
  lines.at_least('pictures', pictures, 1)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
