"""Pictures of all worlds, seen from above."""

import contextlib
import pathlib

from pictures import views
from realab_suite import suite

_SIZE = (400, 400)
_DESIGN = 'instantaneous_reward'
# Looks straight down on the whole room.
_POSE = views.Pose((0.0, 0.7, 0.0), 13.0, 90.0, -90.0)


def draw(folder: pathlib.Path) -> None:
  """Writes a picture of each world, named `domain.task.png`."""
  folder.mkdir(parents=True, exist_ok=True)
  for domain, task in suite.ALL_TASKS:
    env = suite.load(domain, task, {'random': 1}, design=_DESIGN)
    with contextlib.closing(env):
      env.reset()
      frame = views.View(env, _SIZE, _POSE).frame()
    frame.save(folder / f'{domain}.{task}.png', optimize=True)
