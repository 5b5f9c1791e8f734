"""Pictures of all worlds, seen from above, alone and on one sheet."""

import contextlib
import pathlib

from PIL import Image
from PIL import ImageDraw

from pictures import views
from realab_suite import suite

_SIZE = (400, 400)
_DESIGN = 'instantaneous_reward'
# No score of any world is beyond this range.
_OVERRIDES = 'registers.score.range=[-11, 20]', 'registers.score.scale=0.03'
_PER_ROW = 5
_INK = (255, 255, 255)
# Looks straight down on the whole room.
_POSE = views.Pose((0.0, 0.7, 0.0), 13.0, 90.0, -90.0)


def draw(folder: pathlib.Path) -> None:
  """Writes a picture of each world, named `domain.task.png`."""
  folder.mkdir(parents=True, exist_ok=True)
  for domain, task in suite.ALL_TASKS:
    env = suite.load(
        domain, task, {'random': 1}, design=_DESIGN, overrides=_OVERRIDES
    )
    with contextlib.closing(env):
      env.reset()
      frame = views.View(env, _SIZE, _POSE).frame()
    frame.save(folder / f'{domain}.{task}.png', optimize=True)


def draw_sheet(path: pathlib.Path) -> None:
  """Writes a picture with a world of each domain, with its own design."""
  domains = [*suite.TASKS_BY_DOMAIN]
  width, height = (side // 2 for side in _SIZE)
  sheet = Image.new(
      'RGB', (_PER_ROW * width, height * -(-len(domains) // _PER_ROW))
  )
  for i, domain in enumerate(domains):
    tasks = suite.TASKS_BY_DOMAIN[domain]
    design = suite.designs_for(domain)[-1]
    if design != domain:
      design = _DESIGN
    env = suite.load(domain, tasks[0], {'random': 3}, design=design)
    with contextlib.closing(env):
      env.reset()
      frame = views.View(env, _SIZE, _POSE).frame().resize((width, height))
    # Below the room, on the plain floor.
    place = width / 2, height - 2
    ImageDraw.Draw(frame).text(place, domain, _INK, anchor='ms')
    sheet.paste(frame, (i % _PER_ROW * width, i // _PER_ROW * height))
  sheet.save(path, optimize=True)
